"""Capacities of a frame: everything that fixes a shape, in classes, so that similar frames share a compiled program.

Flow: measures, settings -> [plan] -> stages.

Counting is exact, so the capacities made from it are never too small for the frame they were made for. A frame that outgrows
a reused plan raises a fault.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np

from jaxsph.engine.access.lists import TILE, ListPlan
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.control import ControlPlan, PilotPlan
from jaxsph.engine.field.schedule import FINEST, Spacing
from jaxsph.engine.planning.measures import Measures, frame_bytes, quadtree_bytes
from jaxsph.engine.request import DOUBLINGS, first_samples
from jaxsph.engine.runtime.tuning import CPU, MEMORY, Tuning, shards_at_hand
from jaxsph.engine.screen.pyramid import QuadtreePlan
from jaxsph.model import registry
from jaxsph.model.camera.camera import Camera, num_nodes
from jaxsph.model.particles.particles import capacity_class
from jaxsph.model.scene import Scene, num_spheres
from jaxsph.model.settings import Settings
from jaxsph.numerics import short

OPAQUE_BATCHES = 4  # of a frame whose rays end at a surface, over one of others: on two cores it took 0.8 of the time
MIN_PACKETS = 64  # bundles cast together, by a quadtree
MAX_CAPACITY = 1 << 30
MAX_SLABS = 1 << 27  # of a band: what sort keys have room for
SLAB_SAMPLES = (4, 8, 16)
NODE_PIXELS, NODE_SAMPLES = (FINEST.pixels, 8), (FINEST.samples, 4, 8)  # what nodes can be apart, in pixels and fine samples
MIN_NODES_REACHED = 2.5, 3  # by a support, across and in depth: with fewer, wider nodes resolve too little to pay
CROWDED = 4.0  # times as many particles around one as in a tile: of slabs that differ so much the fullest are a loop apart
COMMON_CLASSES = (1, 8, 16)  # of support, of frames that share programs
FINE_DIAMETER = 12  # pixels: supports that are smaller cannot cover a quarter of a footprint


@jax.tree_util.register_static
@dataclasses.dataclass(frozen=True)
class Plan:
    """Everything that fixes a shape: hashable, and shared by similar frames. A pytree without leaves: any argument of `jit`.

    Attributes:
        width, height: of the image, pixels.
        samples: fine samples a ray.
        num_particles: entries of the particle arrays, padding included; smaller arrays are padded to it.
        num_classes: classes of support.
        bands: horizontal bands that are rendered one after the other.
        lists: sizes of the lists of one band.
        cast: sizes of the march.
        bytes: estimate of the working memory, in bytes; of no matter to what is compiled, so plans are equal whatever it is.
        control: static choices of error control; None renders at full rate.
        integrator, screen: names of how samples become light, and of which rays are cast.
        quadtree: sizes of its refinement, where rays are chosen by one.
        step_tolerance: of integrators that have one; None of others.
    """

    width: int
    height: int
    samples: int
    num_particles: int
    num_classes: int
    bands: int
    lists: ListPlan
    cast: CastPlan
    bytes: int = dataclasses.field(compare=False)
    control: ControlPlan | PilotPlan | None = None
    integrator: str = "samples"
    screen: str = "pixels"
    quadtree: QuadtreePlan | None = None
    step_tolerance: float | None = None

    def __repr__(self) -> str:
        size = f"{self.width} x {self.height} of {self.samples} {self.integrator}", f"{self.num_particles:,} particles"
        control = None if self.control is None else type(self.control).__name__.removesuffix("Plan").lower()
        how = None if self.screen == "pixels" else self.screen, control
        return short.line("Plan", *size, None if self.bands == 1 else f"{self.bands} bands", *how, f"{self.bytes / 1e6:,.0f} MB")

    @property
    def chosen_integrator(self) -> tuple[Any, ...]:
        """Its name and what it is made with, for `registry.integrator`."""
        return (self.integrator,) if self.step_tolerance is None else (self.integrator, self.step_tolerance, self.samples)

    @property
    def band_height(self) -> int:
        """Pixel rows of a band."""
        return self.lists.tile_rows * TILE

    @property
    def choices(self) -> Choices:
        """What was chosen by the sizes of supports."""
        return Choices(
            self.cast.slab_samples,
            self.control.nodes if isinstance(self.control, PilotPlan) else None,
            self.control.coverage_subdivisions if isinstance(self.control, ControlPlan) else None,
            self.cast.crowded,
        )

    @property
    def shards(self) -> int:
        """Of a band, that this process runs side by side: of a quadtree so many as its coarse lattice has, too."""
        return shards_at_hand(self.cast.tuning, *(() if self.quadtree is not None else (self.lists.num_bundles,)))

    def dealt(self, shards: int) -> Plan:
        """With columns of tiles beyond the image such that a band's bundles can be dealt to so many shards."""
        rows, columns = self.lists.tile_rows, self.lists.tile_columns
        while 4 * rows * columns % shards:
            columns += 1
        return dataclasses.replace(self, lists=dataclasses.replace(self.lists, tile_columns=columns))

    def check(self, scene: Scene, camera: Camera, settings: Settings) -> None:
        """Raise `ValueError` where the plan is for other shapes than those given; `settings` are those kept along rays."""
        self.check_image(camera, settings)
        capacity = num_spheres(scene)
        if capacity > self.num_particles:
            raise ValueError(
                f"`plan` was made for scene.particles.capacity = {self.num_particles} at most, got {capacity}; "
                "make a new one with `jaxsph.plan`, or grow this one by its `like=`"
            )

    def check_image(self, camera: Camera, settings: Settings) -> None:
        """Raise `ValueError` where the plan is for another image, or another kind of error control."""
        given = {
            "camera.width": (camera.width, self.width),
            "camera.height": (camera.height, self.height),
            "settings.samples": (first_samples(settings), self.samples),
            "settings.integrator": (settings.integrator_used, self.integrator),
            "settings.screen": (settings.screen, self.screen),
            "settings.step_tolerance": (_step_tolerance(settings), self.step_tolerance),
        }
        if self.quadtree is not None:
            given["settings.leaf_pixels"] = (settings.leaf_pixels, self.quadtree.leaf)
        for name, (have, planned) in given.items():
            if have != planned:
                raise ValueError(f"`plan` was made for {name} = {planned}, got {have}; make a new one with `jaxsph.plan`")
        if settings.is_refined != bool(self.cast.doublings):
            kind = "a tolerance" if self.cast.doublings else "no tolerance (`tolerance=None`)"
            raise ValueError(f"`plan` was made for {kind}, but settings ask for the other; make a new one with `jaxsph.plan`")
        wanted = _kind(settings)
        if wanted != _kind_of(self.control):
            raise ValueError(
                f"`plan` was made for {_described(_kind_of(self.control))}, but settings ask for {_described(wanted)}; "
                "make a new one with `jaxsph.plan`"
            )

    def serves(self, needed: Plan) -> bool:
        """Whether this plan has room for all that another was made for, and is the same in what is no room."""
        mine, theirs = (
            dataclasses.replace(
                one,
                num_particles=1,
                num_classes=1,
                lists=dataclasses.replace(one.lists, tile_capacity=1, list_capacity=1, runs=1),
                control=dataclasses.replace(one.control, room=None) if isinstance(one.control, PilotPlan) else one.control,
                quadtree=None if one.quadtree is None else one.quadtree.with_room(1, 1),
            )
            for one in (self, needed)
        )
        return mine == theirs and all(have >= need for have, need in zip(self._rooms(), needed._rooms(), strict=True))

    def is_near(self, needed: Plan) -> bool:
        """Whether no room is more than one class larger than needed."""
        return all(have <= next_class(need) for have, need in zip(self._rooms(), needed._rooms(), strict=True))

    def grown(self, needed: Plan) -> Plan:
        """This plan if it serves, else `needed` with at least the room of this."""
        if self.serves(needed):
            return self
        rooms = [max(mine, theirs) for mine, theirs in zip(self._rooms(), needed._rooms(), strict=True)]
        lists, control = needed.lists, needed.control
        if self.bands == needed.bands:
            lists = dataclasses.replace(lists, tile_capacity=rooms[2], list_capacity=rooms[3])
        if isinstance(control, PilotPlan) and self.bands == needed.bands:
            control = dataclasses.replace(control, room=(rooms[4], rooms[5]))
        quadtree = None if needed.quadtree is None else needed.quadtree.with_room(rooms[6], rooms[7])
        return dataclasses.replace(
            needed, num_particles=rooms[0], num_classes=rooms[1], lists=lists, control=control, quadtree=quadtree
        )

    def _rooms(self) -> tuple[int, ...]:
        """All that may be larger than needed."""
        room = (self.control.room if isinstance(self.control, PilotPlan) else None) or (0, 0)
        coarse = (0, 0) if self.quadtree is None else (self.quadtree.lists.tile_capacity, self.quadtree.lists.list_capacity)
        return self.num_particles, self.num_classes, self.lists.tile_capacity, self.lists.list_capacity, *room, *coarse


@dataclasses.dataclass(frozen=True)
class Choices:
    """What is chosen by how large supports appear: close calls, that may fall the other way in the next frame of a sequence.

    Attributes:
        slab_samples: samples of a cell that share a window of particles.
        nodes: of the pilot's lattice; None without.
        coverage_subdivisions: sub-rectangles on each side of a footprint, for error bounds; None without.
        crowded: whether particles are clustered, see `CastPlan`.
    """

    slab_samples: int
    nodes: Spacing | None
    coverage_subdivisions: int | None
    crowded: bool = False


@dataclasses.dataclass(frozen=True)
class FrameShape:
    """What is known of a frame before it is measured.

    Attributes:
        num_particles: entries of the particle arrays.
        num_classes: classes of support.
        headroom: factor that the number of particles may yet grow by within those entries, and pairs with it.
        number: bytes of a number.
        opaque: whether rays end at a surface: the light of so many slabs is held that few behind it are marched.
        tuning, memory: for the device that holds the particles; the bytes that a frame may take there.
        bands: that there are to be, or more where memory needs it.
        common: whether rooms are those of few classes, see `in_common`.
    """

    width: int
    height: int
    samples: int
    num_particles: int
    num_classes: int
    headroom: float
    number: int
    tuning: Tuning = CPU
    memory: int = MEMORY
    integrator: str = "samples"
    opaque: bool = False
    bands: int = 1
    common: bool = False

    def in_common(self) -> FrameShape:
        """With rooms that frames of most files share, and so their programs, where room that is not filled costs nothing.

        Room changes no bit of an image.
        """
        if not self.tuning.common_particles:
            return self
        particles = common_class(self.num_particles, self.tuning.common_particles)
        classes = next(number for number in COMMON_CLASSES if number >= self.num_classes)
        return dataclasses.replace(self, num_particles=particles, num_classes=classes, common=True)

    def room_for(self, pairs: int) -> int:
        """Entries for pairs of particles and tiles or bundles."""
        pairs = max(int(self.headroom * pairs), pairs, 1)
        return common_class(pairs, self.tuning.common_pairs) if self.common else capacity_class(pairs)


def common_class(count: int, sizes: tuple[int, ...]) -> int:
    """The least of some sizes that holds `count`; of more, its own class."""
    return next((size for size in sizes if size >= count), capacity_class(count))


def choose(measures: Measures, settings: Settings, slab_samples: int | None = None) -> Choices:
    """What suits supports of those sizes."""
    if not slab_samples:  # deeper slabs for deeper supports: a window is the slab's depth plus a support's diameter
        slab_samples = next((size for size in SLAB_SAMPLES if measures.depth_extent <= 6 * size), SLAB_SAMPLES[-1])
    kind = _kind(settings)
    nodes = _choose_nodes(measures.depth_extent, measures.diameter, slab_samples) if kind is PilotPlan else None
    fine = 2 if measures.diameter >= FINE_DIAMETER else 4  # a support covers what is a few times narrower
    subdivisions = fine if isinstance(kind, ControlPlan) else None
    return Choices(slab_samples, nodes, subdivisions, measures.crowding > CROWDED)


def fitted(measures: Measures, shape: FrameShape, settings: Settings, choices: Choices) -> Plan:
    """The plan of a frame, in as few bands as the memory limit allows.

    Raises:
        ValueError: when even a band of one row of tiles exceeds `settings.memory_limit`; with the bytes named it does not.
    """
    limit = settings.memory_limit or shape.memory
    if (made := fitting(measures, shape, settings, choices, limit)) is not None:
        return made
    least = smallest(measures, shape, settings, choices)
    one_row = f"one band of {TILE} pixel rows"
    if least.bytes <= limit:  # then what is too little is not memory
        raise ValueError(
            f"{one_row} has room for {MAX_CAPACITY:,} pairs of particles and bundles of rays and {MAX_SLABS:,} slabs, got "
            f"{least.lists.list_capacity:,} and {_slabs(least):,}; lower the image width, the samples or the number of particles"
        )
    raise ValueError(
        f"`memory_limit` = {limit} bytes is too little: {one_row} needs about {least.bytes} bytes; raise the limit, or lower "
        "the image width, the samples or the number of particles"
    )


def fitting(measures: Measures, shape: FrameShape, settings: Settings, choices: Choices, limit: int) -> Plan | None:
    """The plan of a frame, in as few bands as so many bytes allow; None where even the smallest needs more.

    Where bands of one row of tiles need more, batches of slabs are halved, of any number of which light is the same bits.
    """
    tile_rows, bands, batch = -(-shape.height // TILE), shape.bands, None
    while True:
        made = in_bands(measures, shape, settings, choices, bands, batch)
        if made.bytes <= limit and made.lists.list_capacity <= MAX_CAPACITY and _slabs(made) < MAX_SLABS:
            return made
        if made.lists.tile_rows > 1:
            bands = min(2 * bands, tile_rows)
        elif made.cast.batch_slabs > made.cast.chunk:
            batch = made.cast.batch_slabs // 2
        else:
            return None


def smallest(measures: Measures, shape: FrameShape, settings: Settings, choices: Choices) -> Plan:
    """The plan that takes least: one row of tiles a band, and least batches."""
    return in_bands(measures, shape, settings, choices, -(-shape.height // TILE), 1)


def _slabs(plan: Plan) -> int:
    """Of a band."""
    return plan.lists.num_bundles * -(-plan.samples // plan.cast.slab_samples)


def bytes_of(plan: Plan, number: int) -> int:
    """About what a frame takes with all the room of a plan, of numbers so many bytes wide."""
    size = plan.width, plan.height, plan.samples, plan.num_particles
    needed = frame_bytes(size, plan.num_classes, plan.lists, plan.cast, plan.control, number)
    return needed + (0 if plan.quadtree is None else quadtree_bytes(size, plan.quadtree.lists, number))


def in_bands(
    measures: Measures, shape: FrameShape, settings: Settings, choices: Choices, bands: int, batch: int | None = None
) -> Plan:
    """The plan of a frame in so many bands (fewer if so many are not there) of `batch` slabs at a time, whatever they take."""
    tile_rows, columns = -(-shape.height // TILE), -(-shape.width // TILE)
    rows = -(-tile_rows // bands)
    bands = -(-tile_rows // rows)
    pairs = [fullest_band(counts, rows) for counts in (measures.tile_pairs, measures.bundle_pairs)]
    tiled, listed = map(shape.room_for, pairs)
    lists = ListPlan(rows, columns, tiled, listed, _choose_runs(tiled, shape.tuning))
    cast = _cast_plan(4 * rows * columns, shape.samples, choices.slab_samples, shape.tuning)
    batch = cast.batch_slabs // OPAQUE_BATCHES if batch is None and shape.opaque else batch
    held = cast.batch_slabs if batch is None else max(min(batch, cast.batch_slabs) // cast.chunk, 1) * cast.chunk
    cast = dataclasses.replace(cast, batch_slabs=held, doublings=DOUBLINGS if settings.is_refined else 0, crowded=choices.crowded)
    room = min(capacity_class(measures.rows), 2 * rows), min(capacity_class(measures.columns), 2 * columns)
    control = _control_plan(settings, choices, room)
    size = shape.width, shape.height, shape.samples, shape.num_particles
    quadtree = _quadtree_plan(measures, shape, settings, lists) if settings.screen == "quadtree" else None
    method = control, settings.integrator_used, settings.screen, quadtree
    made = Plan(*size, shape.num_classes, bands, lists, cast, 0, *method, step_tolerance=_step_tolerance(settings))
    return dataclasses.replace(made, bytes=bytes_of(made, shape.number))


def _step_tolerance(settings: Settings) -> float | None:
    """That of integrators that have one, so that plans of others are the same whatever it is."""
    return float(settings.step_tolerance) if registry.integrator_class(settings.integrator_used).asks_points else None


def _quadtree_plan(measures: Measures, shape: FrameShape, settings: Settings, lists: ListPlan) -> QuadtreePlan:
    """Sizes of the first lattice, and of what is cast after that at a time."""
    stride = settings.leaf_pixels // 2
    rows, columns = (-(-num_nodes(size, stride) // TILE) for size in (shape.height, shape.width))
    tiled, listed = map(shape.room_for, measures.of_lattice)
    coarse = ListPlan(rows, columns, tiled, listed, _choose_runs(tiled, shape.tuning))
    packets = max(lists.num_bundles // shape.tuning.turns, min(lists.num_bundles, MIN_PACKETS))
    return QuadtreePlan(settings.leaf_pixels, coarse, packets)


def fullest_band(counts: np.ndarray, rows: int) -> int:
    """Most pairs of any band of so many rows of tiles, of which there are counts."""
    return int(np.pad(counts, (0, -len(counts) % rows)).reshape(-1, rows).sum(1).max(initial=0))


def next_class(count: int) -> int:
    """The capacity class after that of `count`."""
    return capacity_class(capacity_class(count) + 1)


def _control_plan(settings: Settings, choices: Choices, room: tuple[int, int]) -> ControlPlan | PilotPlan | None:
    """What of `settings` and of the frame's measures is fixed when a program is compiled; None without a tolerance."""
    if choices.nodes is not None:
        return PilotPlan(choices.nodes, room)
    if choices.coverage_subdivisions is not None:
        return ControlPlan(settings.super_pixels, settings.merge, settings.allocation, choices.coverage_subdivisions)
    return None


def _kind(settings: Settings) -> ControlPlan | type[PilotPlan] | None:
    """The kind of error control that settings ask for, whatever the frame."""
    if settings.tolerance is None or settings.is_refined:
        return None
    if settings.estimator == "pilot":
        return PilotPlan
    return ControlPlan(settings.super_pixels, settings.merge, settings.allocation)


def _kind_of(control: ControlPlan | PilotPlan | None) -> ControlPlan | type[PilotPlan] | None:
    if isinstance(control, ControlPlan):
        return ControlPlan(control.super_pixels, control.merge, control.allocation)
    return None if control is None else PilotPlan


def _described(kind: ControlPlan | type[PilotPlan] | None) -> str:
    if kind is None:
        return "full rate (`tolerance=None`)"
    if not isinstance(kind, ControlPlan):
        return "`estimator='pilot'`"
    chosen = f"super_pixels={kind.super_pixels}, merge={kind.merge}, allocation={kind.allocation!r}"
    return f"`estimator='interval'` with {chosen}"


def _choose_nodes(depth_extent: float, diameter: float, slab_samples: int) -> Spacing:
    """As far apart as supports of the median size, in samples and in pixels, reach enough of them."""
    pixels = max((n for n in NODE_PIXELS if diameter >= 2 * MIN_NODES_REACHED[0] * n), default=FINEST.pixels)
    samples = max((n for n in NODE_SAMPLES if depth_extent >= 2 * MIN_NODES_REACHED[1] * n), default=FINEST.samples)
    return Spacing(pixels, min(samples, slab_samples))


def _choose_runs(pairs: int, tuning: Tuning) -> int:
    """As many sorts as run side by side, but not more than pays: every one is a few kernels more to compile."""
    return 1 << (min(tuning.max_sorts, max(pairs // tuning.pairs_per_sort, 1)).bit_length() - 1)


def _cast_plan(bundles: int, samples: int, slab_samples: int, tuning: Tuning) -> CastPlan:
    """As many slabs as suit the machine, but not many more than a small image has."""
    most = bundles * -(-samples // slab_samples)
    chunk = 1 << (min(tuning.samples_at_once // slab_samples, most) - 1).bit_length()
    return CastPlan(chunk, slab_samples, min(tuning.samples_held // slab_samples, -(-most // chunk) * chunk), tuning)
