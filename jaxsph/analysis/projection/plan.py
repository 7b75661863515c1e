"""Capacities of a projection: everything that fixes a shape, counted from the particles that a camera sees.

Flow: particles, camera -> [projection_plan] -> project.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import numpy as np
from jaxtyping import Array

from jaxsph.analysis.projection.column_sums import BLOCK, subrays_of
from jaxsph.analysis.projection.pixel_lists import Placed, footprints, place
from jaxsph.engine.access.lists import TILE, ListPlan
from jaxsph.engine.access.ordering import Ordered
from jaxsph.engine.lengths import digits_to_scale, scaled, scaled_camera
from jaxsph.engine.planning.measures import Measures, measure
from jaxsph.engine.planning.plan import MAX_CAPACITY, fullest_band
from jaxsph.engine.runtime.tuning import CPU, Tuning, memory_for, tuning_for
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.snug import with_depths
from jaxsph.model.particles.particles import Particles, capacity_class
from jaxsph.model.particles.periodic import between_faces, num_ghosts, past_faces, runs_through, sees_images, unfolded
from jaxsph.numerics.checks import require_plan
from jaxsph.numerics.trees import on_host

PIXELS = ("mean", "ray")
SUBRAYS = 3  # of a pixel on each axis in means, where there are no shares: good to 3e-4 of the peak from 2 pixels a support on
SHARES = 0
"""Number of rays that stands for shares instead."""
BYTES_OF_PARTICLE, BYTES_OF_TILE_PAIR, BYTES_OF_PAIR, BYTES_OF_PIXEL = 224, 96, 8, 64  # that live at once, by reading the stages


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class ProjectionPlan:
    """Everything that fixes a shape: hashable, and shared by similar projections. A pytree without leaves.

    Attributes:
        width, height: of the image, pixels.
        num_particles: entries of the particle arrays, padding included.
        pixel: `"mean"` or `"ray"`.
        bands: horizontal bands that are projected one after the other.
        rays, shares: lists of the particles of either rule in one band; None where there is none.
        tuning: for the machine.
        images: entries for images of a periodic set; None where each particle is taken once.
        through: axis of the box that rays run along from outside through both faces, so that columns are whole; None where not.
    """

    width: int
    height: int
    num_particles: int
    pixel: str
    bands: int
    rays: ListPlan | None
    shares: ListPlan | None
    tuning: Tuning = CPU
    images: int | None = None
    through: int | None = None

    def __post_init__(self) -> None:
        if self.pixel not in PIXELS:
            raise ValueError(f"`pixel` must be {' or '.join(map(repr, PIXELS))}, got {self.pixel!r}")

    @property
    def rules(self) -> list[tuple[int, ListPlan | None]]:
        """Rays a pixel on each axis, or `SHARES`, and lists, of each rule that particles may follow."""
        return [(1, self.rays)] if self.pixel == "ray" else [(SHARES, self.shares), (SUBRAYS, self.rays)]

    @property
    def tile_rows(self) -> int:
        """Of a band."""
        rows = -(-self.height // TILE)
        return -(-rows // self.bands)

    @property
    def band_height(self) -> int:
        """Pixel rows of a band."""
        return self.tile_rows * TILE

    def chunk(self, subrays: int) -> int:
        """Bundles that are summed together: not more than there are."""
        lists = self.shares if subrays == SHARES else self.rays
        return max(min(self.tuning.samples_at_once // (BLOCK * max(subrays, 1) ** 2), lists.num_bundles if lists else 1), 1)

    def grown(self, needed: ProjectionPlan) -> ProjectionPlan:
        """This plan where it has room for all that another was made for, else the other with at least the room of this."""
        bare = [dataclasses.replace(one, rays=None, shares=None, images=one.images and 0) for one in (self, needed)]
        if bare[0] != bare[1]:
            return needed
        room = None if self.images is None else max(self.images, needed.images or 0)
        rays, shares = _larger(self.rays, needed.rays), _larger(self.shares, needed.shares)
        return dataclasses.replace(self, rays=rays, shares=shares, images=room)

    def check(self, particles: Particles, camera: Camera, pixel: str) -> None:
        """Raise `ValueError` where the plan is for other shapes than those given."""
        if self.images is not None and particles.box is None:
            raise ValueError(
                "`plan` was made for particles with a periodic box, and these have none; make one with `plan_projection`"
            )
        given = {
            "camera.width": (camera.width, self.width),
            "camera.height": (camera.height, self.height),
            "particles.capacity": (particles.capacity, self.num_particles),
            "pixel": (pixel, self.pixel),
        }
        for name, (have, planned) in given.items():
            if have != planned:
                raise ValueError(f"`plan` was made for {name} = {planned}, got {have}; make a new one with `plan_projection`")


@on_host
def plan_projection(
    particles: Particles,
    camera: Camera,
    *,
    pixel: str = "mean",
    like: ProjectionPlan | None = None,
    memory_limit: int | None = None,
) -> ProjectionPlan:
    """Measure the room that a projection needs (host side; values must be concrete).

    Args:
        particles, camera, pixel: as for `jaxsph.project`.
        like: a plan to grow: returned as it is where it has room, else with more; so that one plan, and what is compiled for it,
            serves all frames of a sequence.
        memory_limit: bytes of working memory; default 4 GiB, or half of an accelerator's.

    Raises:
        ValueError: under a trace; when even a band of one row of tiles exceeds `memory_limit`.
    """
    require_plan("like", like, ProjectionPlan, "plan_projection")
    camera = with_depths(camera, particles)
    digits, memory = digits_to_scale(particles, camera), memory_limit or memory_for(particles.support)
    made = _measured(scaled(particles, digits), scaled_camera(camera, digits), pixel, memory)
    return made if like is None else like.grown(made)


def _measured(particles: Particles, camera: Camera, pixel: str, limit: int) -> ProjectionPlan:
    """The plan with as few bands as the limit allows."""
    size, rows, bands = (camera.width, camera.height, particles.capacity), -(-camera.height // TILE), 1
    images = through = None
    if particles.box is not None and sees_images(particles, camera):
        axis = int(np.argmax(np.abs(np.asarray(camera.axes)[2])))
        through = axis if bool(runs_through(camera, particles.box, axis)) else None
        beyond = BESIDE_FACES * float(particles.box.sides.min())
        images = capacity_class(num_ghosts(particles, beyond, through))
    bare = ProjectionPlan(*size, pixel, 1, None, None, tuning_for(particles.support), images, through)
    if images is not None:
        camera, particles = _of_box(particles, camera, beyond, room=images, pixel=pixel, through=through)
    else:
        particles = particles.wrapped()
    placed = placed_by(particles, camera)
    counts = [measure(_footprints(placed, camera, subrays=n), camera, 1) for n, _ in bare.rules]  # type: ignore[arg-type]
    there = [bool(WANTED[n](placed).any()) for n, _ in bare.rules]  # be it beside the picture
    while True:
        lists = [_lists(one, camera, bands) if some else None for one, some in zip(counts, there, strict=True)]
        made = dataclasses.replace(bare, bands=bands, rays=lists[-1], shares=lists[0] if pixel == "mean" else None)
        needed = _bytes(made)
        if needed <= limit and all(one is None or one.list_capacity <= MAX_CAPACITY for one in lists):
            return made
        if made.tile_rows == 1:
            raise ValueError(
                f"`memory_limit` = {limit} bytes is too little: one band of {TILE} pixel rows needs about {needed} bytes; "
                "raise the limit, or project fewer particles or pixels"
            )
        bands = min(2 * bands, rows)


def beside(subrays: int) -> float:
    """How far from the middle of its pixel a rule looks, in pixels on either axis."""
    return 0.5 if subrays == SHARES else float(np.max(np.abs(subrays_of(subrays)[0] - 0.5)))


WANTED: dict[int, Callable[[Placed], Array]] = {
    1: lambda placed: placed.live,
    SHARES: lambda placed: placed.live & placed.small,
    SUBRAYS: lambda placed: placed.live & placed.large,
}
"""Which particles follow each rule."""
BESIDE_FACES = 1e-4  # of the shortest side of a period, that images may be away from it to be counted: rounding may take them in
DOUBT = 2  # so that what is counted is never less than what a program finds that rounds in another way
placed_by = jax.jit(functools.partial(place, doubt=DOUBT))


@functools.partial(jax.jit, static_argnames=("room", "pixel", "through"))
def _of_box(
    particles: Particles, camera: Camera, beyond: float, *, room: int, pixel: str, through: int | None
) -> tuple[Camera, Particles]:
    """What of a periodic set is projected, and what might be."""
    assert particles.box is not None
    seen = between_faces(camera, particles.box, pixel)[0] if through is None else past_faces(camera, particles.box)
    return seen, unfolded(particles, room, beyond, through)[0]


@functools.partial(jax.jit, static_argnames="subrays")
def _footprints(placed: Placed, camera: Camera, *, subrays: int) -> Ordered:
    return footprints(placed, camera, WANTED[subrays](placed), beside(subrays), DOUBT)


def _larger(one: ListPlan | None, other: ListPlan | None) -> ListPlan | None:
    if one is None or other is None:
        return one or other
    tiles, pairs = max(one.tile_capacity, other.tile_capacity), max(one.list_capacity, other.list_capacity)
    return dataclasses.replace(one, tile_capacity=tiles, list_capacity=pairs)


def _lists(counted: Measures, camera: Camera, bands: int) -> ListPlan:
    rows, columns = -(-camera.height // TILE), -(-camera.width // TILE)
    of_band = -(-rows // bands)
    pairs = [fullest_band(counts, of_band) for counts in (counted.tile_pairs, counted.bundle_pairs)]
    return ListPlan(of_band, columns, capacity_class(pairs[0]), capacity_class(pairs[1]), 1)


def _bytes(plan: ProjectionPlan) -> int:
    lists = [one for _, one in plan.rules if one is not None]
    pairs = sum(one.tile_capacity * BYTES_OF_TILE_PAIR + one.list_capacity * BYTES_OF_PAIR for one in lists)
    subrays = max((n for n, one in plan.rules if one is not None), default=1)
    of_band = plan.band_height * plan.width * BYTES_OF_PIXEL * max(subrays, 1) ** 2
    of_particles = (plan.num_particles + (plan.images or 0)) * BYTES_OF_PARTICLE
    return of_particles + pairs + of_band + plan.width * plan.height * BYTES_OF_PIXEL
