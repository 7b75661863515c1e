"""Capacities of a projection: everything that fixes a shape, counted from the particles that a camera sees.

Flow: particles, camera -> seen -> [projection_plan] -> project.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import numpy as np

from jaxsph.analysis.projection.columns import PIXELS, PLANE, Rule, nesting, rules_of
from jaxsph.analysis.projection.seen import BESIDE_FACES, Seen, see
from jaxsph.engine.access.lists import TILE, ListPlan
from jaxsph.engine.planning.plan import MAX_CAPACITY, common_class, fullest_band
from jaxsph.engine.planning.viewing import pairs_in_view
from jaxsph.engine.request import digits_to_scale, scaled
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.tuning import CPU, Tuning, memory_for, tuning_for
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.clips import inside
from jaxsph.model.particles.particles import Particles, capacity_class
from jaxsph.model.particles.periodic import num_ghosts, runs_through, sees_images
from jaxsph.model.scene import Scene
from jaxsph.numerics.checks import array_of, is_traced, require_plan
from jaxsph.numerics.trees import fitting, on_host

BYTES_OF_PARTICLE, BYTES_OF_TILE_PAIR, BYTES_OF_PAIR, BYTES_OF_PIXEL = 224, 96, 8, 64  # that live at once, by reading the stages
MAX_LEVELS = 6  # of nested lattices
DOUBT = 2.0  # so that what is counted is never less than what a program finds that rounds in another way


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ProjectionPlan:
    """Everything that fixes a shape: hashable, and shared by similar projections. A pytree without leaves.

    Attributes:
        width, height: of the image, pixels.
        num_particles: entries of the particle arrays, padding included.
        pixel: `"mean"`, `"ray"`, or `"plane"` for a slice.
        bands: horizontal bands that are projected one after the other.
        lists: of the particles of each rule, by its name, in one band; of rules that nobody follows none.
        tuning: for the machine.
        images: entries for images of a periodic set; None where each particle is taken once.
        levels, least: of nested lattices, and spacings of one that the supports on it have at least, see `columns`.
        through: axis of the box that rays run along from outside through both faces, so that columns are whole; None where not.
    """

    width: int
    height: int
    num_particles: int
    pixel: str
    bands: int
    lists: tuple[tuple[str, ListPlan], ...]
    tuning: Tuning = CPU
    images: int | None = None
    through: int | None = None
    levels: int = 0
    least: float = math.inf

    def __post_init__(self) -> None:
        if self.pixel != PLANE:
            require_pixel(self.pixel)

    @property
    def band_height(self) -> int:
        """Pixel rows of a band."""
        return -(-self.height // (TILE * self.bands)) * TILE

    def rules(self, kernel: str, perspective: bool) -> tuple[Rule, ...]:
        """That particles may follow."""
        return rules_of(kernel, perspective, self.pixel, self.levels)

    def tolerance(self, kernel: str) -> float:
        """What its lattices are off by, as a share of the peak of a particle of the least support."""
        return float(f"{nesting(kernel) * self.least**-3.5:.3g}")

    def see(self, clock: Clock, particles: Particles, amounts: Any, camera: Camera, doubt: float = 0.0) -> Seen:
        """What there is to be projected."""
        static: dict[str, Any] = {"pixel": self.pixel, "images": self.images, "through": self.through, "tuning": self.tuning}
        rules, static["least"] = self.rules(particles.kernel, camera.is_perspective), self.least
        seen: Seen = clock.one("grid", see, (particles, amounts, camera, np.float32(doubt)), rules=rules, **static)
        return seen

    def grown(self, needed: ProjectionPlan) -> ProjectionPlan:
        """This plan where it has room for all that another was made for, else the other with at least the room of this."""
        bare = [dataclasses.replace(one, lists=(), images=one.images and 0) for one in (self, needed)]
        if bare[0] != bare[1]:
            return needed
        lists, others = dict(self.lists), dict(needed.lists)
        for kind, other in others.items():
            one = lists.get(kind, other)
            tiles, pairs = max(one.tile_capacity, other.tile_capacity), max(one.list_capacity, other.list_capacity)
            lists[kind] = dataclasses.replace(one, tile_capacity=tiles, list_capacity=pairs)
        room = None if self.images is None else max(self.images, needed.images or 0)
        return dataclasses.replace(self, lists=tuple(sorted(lists.items())), images=room)

    def check(self, particles: Particles, camera: Camera, pixel: str) -> None:
        """Raise `ValueError` where the plan is for other shapes than those given."""
        if self.images is not None and particles.box is None:
            raise ValueError("`plan` was made for a periodic box, and these have none; make one with `plan_projection`")
        given: dict[str, Any] = {"camera.width": (camera.width, self.width), "camera.height": (camera.height, self.height)}
        given |= {"particles.capacity": (particles.capacity, self.num_particles), "pixel": (pixel, self.pixel)}
        for name, (have, planned) in given.items():
            if have != planned:
                raise ValueError(f"`plan` was made for {name} = {planned}, got {have}; make a new one with `plan_projection`")


def require_pixel(pixel: Any) -> None:
    """Raise `ValueError` where this is no rule of pixels that a projection may be asked for."""
    if pixel not in PIXELS:
        raise ValueError(f"`pixel` must be {' or '.join(map(repr, PIXELS))}, got {pixel!r}")


def particles_in(shown: Any) -> tuple[Particles, Particles]:
    """All particles, without a look, and those whose centres a scene's clip leaves, but for that of a width."""
    within = None
    if isinstance(shown, Scene):
        if shown.particles is None:
            raise ValueError("`particles` must be a `jaxsph.Particles`, or a `jaxsph.Scene` with some, and this scene has none")
        shown, within = shown.particles, shown.within
    particles = fitting("particles", shown, Particles)
    if within is None or getattr(within, "of_width", False):
        return particles, particles
    moved = particles.wrapped()
    if is_traced(moved, within):
        return particles, dataclasses.replace(particles, valid=particles.valid & within.contains(tuple(moved.position.T)))
    left = np.asarray(particles.valid) & inside(within, moved.exact_position())
    return particles, dataclasses.replace(particles, valid=array_of(left))


@on_host
def plan_projection(
    particles: Particles | Scene,
    camera: Camera,
    *,
    pixel: str = "mean",
    like: ProjectionPlan | None = None,
    tolerance: float = 0.0,
    memory_limit: int | None = None,
) -> ProjectionPlan:
    """Measure the room that a projection needs (host side; values must be concrete).

    Args:
        particles, camera, pixel, tolerance: as for `jaxsph.project`.
        like: a plan to grow: returned as it is where it has room, else with more; so that one serves all frames of a sequence.
        memory_limit: bytes of working memory; default 4 GiB, or half of an accelerator's.

    Raises:
        ValueError: under a trace; when even a band of one row of tiles exceeds `memory_limit`.
    """
    require_plan("like", like, ProjectionPlan, "plan_projection")
    require_pixel(pixel)
    _, particles = particles_in(particles)
    camera = with_depths(camera, particles)
    digits, memory = digits_to_scale(particles, camera), memory_limit or memory_for(particles.support)
    given = scaled(particles, digits), array_of(np.zeros((particles.capacity, 1)), particles.dtype), scaled(camera, digits)
    made, _ = planned(given, pixel, tolerance, memory, Clock(), (), DOUBT)
    return made if like is None else like.grown(made)


def in_common(given: tuple[Any, ...]) -> tuple[Any, ...]:
    """Particles and amounts in arrays as long as those of most files are made, which so share programs."""
    particles, amounts, camera = given
    room = max(min(tuning_for(particles.support).common_particles, default=0) - particles.capacity, 0)
    if room == 0:
        return given
    padded = array_of(np.pad(np.asarray(amounts), ((0, room), (0, 0))))
    return particles.padded(particles.capacity + room), padded, camera


def planned(
    given: tuple[Any, ...], pixel: str, tolerance: float, limit: int, clock: Clock, rooms: tuple[int, ...], doubt: float = 0.0
) -> tuple[ProjectionPlan, Seen]:
    """The plan of particles, amounts and a camera, and what was seen for it.

    It has as few bands as the limit allows, with `rooms` for pairs if it does. With `DOUBT` it is for other programs, too.
    """
    particles, amounts, camera = given
    size, rows, bands = (camera.width, camera.height, particles.capacity), -(-camera.height // TILE), 1
    images = through = None
    if particles.box is not None and sees_images(particles, camera):
        axis = int(np.argmax(np.abs(np.asarray(camera.axes)[2])))
        through = axis if bool(runs_through(camera, particles.box, axis)) else None
        images = capacity_class(num_ghosts(particles, BESIDE_FACES * float(particles.box.sides.min()), through))
    nested = _levels(particles, camera, tolerance)
    bare = ProjectionPlan(*size, pixel, 1, (), tuning_for(particles.support), images, through, *nested)
    seen = bare.see(clock, particles, amounts, camera, doubt)
    each = zip(bare.rules(particles.kernel, camera.is_perspective), seen.spheres, seen.there, strict=True)
    counts = {rule: pairs_in_view(one, rule.seen_by(camera))[2:] for rule, one, some in each if some}
    while True:
        # one program sorts for all that are not nested
        plain = _lists([one for rule, one in counts.items() if rule.stride == 1], camera, bands, rooms)
        coarse = {rule: _lists([one], rule.seen_by(camera), 1, rooms) for rule, one in counts.items() if rule.stride > 1}
        lists = tuple(sorted((rule.name, coarse.get(rule, plain)) for rule in counts))
        made = dataclasses.replace(bare, bands=bands, lists=lists)
        needed = _bytes(made, list(counts))
        if needed <= limit and all(one.list_capacity <= MAX_CAPACITY for _, one in made.lists):
            return made, seen
        if made.band_height == TILE and not rooms:
            wrong = f"`memory_limit` = {limit} bytes is too little: one band of {TILE} pixel rows needs about {needed} bytes;"
            raise ValueError(f"{wrong} raise the limit, or project fewer particles or pixels")
        bands, rooms = min(2 * bands, rows) if not rooms else bands, ()


def _levels(particles: Particles, camera: Camera, tolerance: float) -> tuple[int, float]:
    """How many lattices pay, and the least supports on them, in their spacings."""
    if not 0 <= tolerance < 1:
        raise ValueError(f"`tolerance` must be at least 0 and less than 1, a share of each particle's peak, got {tolerance}")
    if tolerance and camera.is_perspective:
        raise ValueError("`tolerance` is of parallel rays alone: leave it out, or give an orthographic camera")
    least = (nesting(particles.kernel) / tolerance) ** (2 / 7) if tolerance else math.inf
    largest = float(np.max(np.asarray(particles.support), where=np.asarray(particles.valid), initial=0))
    nodes = largest * camera.height / (2 * float(camera.half_height)) / least
    return (min(int(math.log2(nodes)), MAX_LEVELS) if 1 < nodes < math.inf else 0), least


def _lists(counts: list[tuple[np.ndarray, np.ndarray]], camera: Camera, bands: int, rooms: tuple[int, ...]) -> ListPlan:
    """With room for the most of several."""
    rows, columns = -(-camera.height // TILE), -(-camera.width // TILE)
    of_band = -(-rows // bands)
    pairs = [max((fullest_band(one[k], of_band) for one in counts), default=0) for k in range(2)]
    tiles, bundles = (common_class(most, rooms) if rooms else capacity_class(most) for most in pairs)
    return ListPlan(of_band, columns, tiles, bundles, 1)


def _bytes(plan: ProjectionPlan, rules: list[Rule]) -> int:
    pairs = sum(one.tile_capacity * BYTES_OF_TILE_PAIR + one.list_capacity * BYTES_OF_PAIR for _, one in plan.lists)
    of_band = plan.band_height * plan.width * BYTES_OF_PIXEL * max((rule.subrays**2 for rule in rules), default=1)
    of_particles = (plan.num_particles + (plan.images or 0)) * BYTES_OF_PARTICLE
    return of_particles + pairs + of_band + plan.width * plan.height * BYTES_OF_PIXEL
