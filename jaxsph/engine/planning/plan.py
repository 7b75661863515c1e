"""Capacities of a frame: everything that fixes a shape, in classes, so that similar frames share a compiled program.

Flow: measures, settings -> [plan: Demand -> Plan] -> stages.

Counting is exact, so the capacities made from it are never too small for the frame they were made for. A frame that outgrows
a reused plan raises a fault.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxsph.engine.access.lists import BUNDLE, TILE, ListPlan
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.control.adapt import ControlPlan
from jaxsph.engine.control.pilot import PilotPlan
from jaxsph.engine.field.tasks import FINEST, Spacing
from jaxsph.engine.planning.viewing import Measures
from jaxsph.engine.request import DOUBLINGS, first_samples
from jaxsph.engine.runtime.tuning import CPU, MEMORY, Tuning, shards_at_hand
from jaxsph.engine.screen.packets import QuadtreePlan
from jaxsph.model.camera.camera import Camera, num_nodes
from jaxsph.model.particles.particles import capacity_class
from jaxsph.model.scene import Scene, num_spheres
from jaxsph.model.settings import Settings
from jaxsph.numerics.trees import line_of

OPAQUE_BATCHES = 4  # of a frame whose rays end at a surface, over one of others: on two cores it took 0.8 of the time
MIN_PACKETS = 64  # bundles cast together, by a quadtree
MAX_CAPACITY = 1 << 30
MAX_SLABS = 1 << 27  # of a band: what sort keys have room for
SLAB_SAMPLES = (4, 8, 16)
OPAQUE_SLABS = 8  # where rays end at a surface: others gain nothing then, and are other programs
NODE_PIXELS, NODE_SAMPLES = (FINEST.pixels, 8), (FINEST.samples, 4, 8)  # what nodes can be apart, in pixels and fine samples
MIN_NODES_REACHED = 2.5, 3  # by a support, across and in depth: with fewer, wider nodes resolve too little to pay
COMMON_CLASSES = (1, 16)  # of support, of frames that share programs: 16 cost them a fiftieth more than 8
FINE_DIAMETER = 12  # pixels: supports that are smaller cannot cover a quarter of a footprint
RAYS = BUNDLE * BUNDLE
ARRAYS_OF_NODES = 12  # as large as the lattice, that live at once
NUMBERS_OF_CANVAS = 24  # a pixel: six channels known, predicted and compared, and what is told of each


Chosen = tuple[int, ControlPlan | PilotPlan | None]
"""What is chosen by how large supports appear: samples of a slab, and the pilot's nodes, but for room, or how finely bounds test
coverage. Close calls, that may fall the other way in the next frame of a sequence."""


class Rooms(NamedTuple):
    """All of a plan that may be larger than a frame needs; 0 of what it has not.

    Attributes:
        particles, classes: entries of the particle arrays, and classes of support.
        tiles, bundles: pairs of these with particles that the lists of a band hold.
        rows, columns: of bundles that have nodes.
        coarse_tiles, coarse_bundles: pairs of the first lattice of a quadtree.
    """

    particles: int
    classes: int
    tiles: int
    bundles: int
    rows: int = 0
    columns: int = 0
    coarse_tiles: int = 0
    coarse_bundles: int = 0

    def is_near(self, needed: Rooms) -> bool:
        """Whether nothing is more than one class larger than needed."""
        return all(have <= next_class(need) for have, need in zip(self, needed, strict=True))


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

    def __repr__(self) -> str:
        size = f"{self.width} x {self.height} of {self.samples} {self.integrator}", f"{self.num_particles:,} particles"
        control = None if self.control is None else type(self.control).__name__.removesuffix("Plan").lower()
        how = None if self.screen == "pixels" else self.screen, control
        return line_of("Plan", *size, None if self.bands == 1 else f"{self.bands} bands", *how, f"{self.bytes / 1e6:,.0f} MB")

    @property
    def band_height(self) -> int:
        """Pixel rows of a band."""
        return self.lists.tile_rows * TILE

    @property
    def chosen(self) -> Chosen:
        """What was chosen by the sizes of supports."""
        return self.cast.slab_samples, PilotPlan(self.control.nodes) if isinstance(self.control, PilotPlan) else self.control

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
        }
        if self.quadtree is not None:
            given["settings.leaf_pixels"] = (settings.leaf_pixels, self.quadtree.leaf)
        for name, (have, planned) in given.items():
            if have != planned:
                raise ValueError(f"`plan` was made for {name} = {planned}, got {have}; make a new one with `jaxsph.plan`")
        if settings.is_refined != bool(self.cast.doublings):
            kind = "a tolerance" if self.cast.doublings else "no tolerance (`tolerance=None`)"
            raise ValueError(f"`plan` was made for {kind}, but settings ask for the other; make a new one with `jaxsph.plan`")
        wanted, made = _described(_control(settings)), _described(self.control)
        if wanted != made:
            raise ValueError(f"`plan` was made for {made}, but settings ask for {wanted}; make a new one with `jaxsph.plan`")

    @property
    def rooms(self) -> Rooms:
        """What may be larger than needed."""
        nodes = (self.control.room if isinstance(self.control, PilotPlan) else None) or (0, 0)
        coarse = (0, 0) if self.quadtree is None else (self.quadtree.lists.tile_capacity, self.quadtree.lists.list_capacity)
        return Rooms(self.num_particles, self.num_classes, self.lists.tile_capacity, self.lists.list_capacity, *nodes, *coarse)

    def with_rooms(self, rooms: Rooms) -> Plan:
        """The same in all that is no room."""
        lists = dataclasses.replace(self.lists, tile_capacity=rooms.tiles, list_capacity=rooms.bundles)
        control, quadtree = self.control, self.quadtree
        if isinstance(control, PilotPlan):
            control = dataclasses.replace(control, room=(rooms.rows, rooms.columns))
        if quadtree is not None:
            coarse = {"tile_capacity": rooms.coarse_tiles, "list_capacity": rooms.coarse_bundles, "runs": 1}
            quadtree = dataclasses.replace(quadtree, lists=dataclasses.replace(quadtree.lists, **coarse))
        made = dataclasses.replace(self, lists=lists, control=control, quadtree=quadtree)
        return dataclasses.replace(made, num_particles=rooms.particles, num_classes=rooms.classes)

    def serves(self, needed: Plan) -> bool:
        """Whether this plan has room for all that another was made for, and is the same in what is no room."""
        least = Rooms(*[1] * len(Rooms._fields))
        mine = dataclasses.replace(self, lists=dataclasses.replace(self.lists, runs=needed.lists.runs))
        enough = all(have >= need for have, need in zip(self.rooms, needed.rooms, strict=True))
        return enough and mine.with_rooms(least) == needed.with_rooms(least)

    def grown(self, needed: Plan) -> Plan:
        """This plan if it serves, else `needed` with at least the room of this."""
        if self.serves(needed):
            return self
        rooms, own = Rooms(*map(max, self.rooms, needed.rooms)), needed.rooms
        if self.bands != needed.bands:
            rooms = rooms._replace(tiles=own.tiles, bundles=own.bundles, rows=own.rows, columns=own.columns)
        return needed.with_rooms(rooms)


def common_class(count: int, sizes: tuple[int, ...]) -> int:
    """The least of some sizes that holds `count`; of more, its own class."""
    return next((size for size in sizes if size >= count), capacity_class(count))


def choose(measures: Measures, settings: Settings, opaque: bool) -> Chosen:
    """What suits supports of those sizes."""
    control, slab_samples = _control(settings), OPAQUE_SLABS
    if not opaque:  # deeper slabs for deeper supports: a window is the slab's depth plus a support's diameter
        slab_samples = next((size for size in SLAB_SAMPLES if measures.depth_extent <= 6 * size), SLAB_SAMPLES[-1])
    if isinstance(control, PilotPlan):  # as far apart as supports of the median size reach enough of them
        across, deep = (2 * least for least in MIN_NODES_REACHED)
        pixels = max((n for n in NODE_PIXELS if measures.diameter >= across * n), default=FINEST.pixels)
        samples = max((n for n in NODE_SAMPLES if measures.depth_extent >= deep * n), default=FINEST.samples)
        control = PilotPlan(Spacing(pixels, min(samples, slab_samples)))
    elif control is not None:  # a support covers what is a few times narrower
        control = dataclasses.replace(control, coverage_subdivisions=2 if measures.diameter >= FINE_DIAMETER else 4)
    return slab_samples, control


@dataclasses.dataclass(frozen=True)
class Demand:
    """All that the plan of a frame is made from: what is known before it is measured, and what was measured and chosen.

    Attributes:
        settings: those that are kept along rays.
        num_particles: entries of the particle arrays.
        num_classes: classes of support.
        headroom: factor that the number of particles may yet grow by within those entries, and pairs with it.
        number: bytes of a number.
        tuning, memory: for the device that holds the particles; the bytes that a frame may take there.
        opaque: whether rays end at a surface: the light of so many slabs is held that few behind it are marched.
        bands: that there are to be, or more where memory needs it.
        common: whether rooms are those of few classes, see `in_common`.
    """

    settings: Settings
    width: int
    height: int
    samples: int
    num_particles: int
    num_classes: int
    headroom: float
    number: int
    tuning: Tuning = CPU
    memory: int = MEMORY
    opaque: bool = False
    bands: int = 1
    common: bool = False
    measures: Measures = None  # type: ignore[assignment]
    chosen: Chosen = None  # type: ignore[assignment]

    @property
    def integrator(self) -> str:
        """Its name."""
        return self.settings.integrator_used

    def in_common(self) -> Demand:
        """With rooms that frames of most files share, and so their programs, where room that is not filled costs nothing.

        Room changes no bit of an image.
        """
        if not self.tuning.common_particles:
            return self
        particles = common_class(self.num_particles, self.tuning.common_particles)
        classes = next(number for number in COMMON_CLASSES if number >= self.num_classes)
        return self.shaped(num_particles=particles, num_classes=classes, common=True)

    def room_for(self, pairs: int) -> int:
        """Entries for pairs of particles and tiles or bundles."""
        pairs = max(int(self.headroom * pairs), pairs, 1)
        return common_class(pairs, self.tuning.common_pairs) if self.common else capacity_class(pairs)

    @property
    def limit(self) -> int:
        """Bytes that the frame may take."""
        return int(self.settings.memory_limit or self.memory)

    def shaped(self, **changes: Any) -> Demand:
        """With other things known."""
        return dataclasses.replace(self, **changes)

    def of_rows(self, first: int, last: int) -> Demand:
        """Of some rows of tiles alone."""
        tiles, bundles = self.measures.tile_pairs[first:last], self.measures.bundle_pairs[first:last]
        measures = dataclasses.replace(self.measures, tile_pairs=tiles, bundle_pairs=bundles)
        return self.shaped(measures=measures, height=min(last * TILE, self.height) - first * TILE)

    def fitted(self, limit: int) -> Plan:
        """The plan of the frame, in as few bands as so many bytes allow.

        Raises:
            ValueError: when even a band of one row of tiles exceeds them; with the bytes named it does not.
        """
        if (made := self.fitting(limit)) is not None:
            return made
        least, one_row = self.in_bands(-(-self.height // TILE), 1), f"one band of {TILE} pixel rows"
        if least.bytes <= limit:  # then what is too little is not memory
            raise ValueError(
                f"{one_row} has room for {MAX_CAPACITY:,} pairs of particles and bundles of rays and {MAX_SLABS:,} slabs, got "
                f"{least.lists.list_capacity:,} and {_slabs(least):,}; lower the image width, the samples or the number of "
                "particles"
            )
        raise ValueError(
            f"`memory_limit` = {limit} bytes is too little: {one_row} needs about {least.bytes} bytes; raise the limit, or "
            "lower the image width, the samples or the number of particles"
        )

    def fitting(self, limit: int) -> Plan | None:
        """The plan of the frame, in as few bands as so many bytes allow; None where even the smallest needs more.

        Where bands of one row of tiles need more, batches of slabs are halved, of any number of which light is the same bits.
        """
        tile_rows, bands, batch = -(-self.height // TILE), self.bands, None
        while True:
            made = self.in_bands(bands, batch)
            if made.bytes <= limit and made.lists.list_capacity <= MAX_CAPACITY and _slabs(made) < MAX_SLABS:
                return made
            if made.lists.tile_rows > 1:
                bands = min(2 * bands, tile_rows)
            elif made.cast.batch_slabs > made.cast.chunk:
                batch = made.cast.batch_slabs // 2
            else:
                return None

    def in_bands(self, bands: int, batch: int | None = None) -> Plan:
        """In so many bands (fewer if so many are not there) of `batch` slabs at a time, whatever they take."""
        measures, settings, (slab_samples, control), tuning = self.measures, self.settings, self.chosen, self.tuning
        tile_rows, columns, quadtree = -(-self.height // TILE), -(-self.width // TILE), None
        rows = -(-tile_rows // bands)
        bands = -(-tile_rows // rows)
        lists = self._lists(rows, columns, [fullest_band(each, rows) for each in (measures.tile_pairs, measures.bundle_pairs)])
        # as many slabs as suit the machine, but not many more than a small image has
        most = 4 * rows * columns * -(-self.samples // slab_samples)
        chunk = 1 << (min(tuning.samples_at_once // slab_samples, most) - 1).bit_length()
        held = min(tuning.samples_held // slab_samples, -(-most // chunk) * chunk)
        batch = held // OPAQUE_BATCHES if batch is None and self.opaque else batch
        held = held if batch is None else max(min(batch, held) // chunk, 1) * chunk
        cast = CastPlan(chunk, slab_samples, held, tuning, DOUBLINGS if settings.is_refined else 0)
        if isinstance(control, PilotPlan):
            room = min(capacity_class(measures.rows), 2 * rows), min(capacity_class(measures.columns), 2 * columns)
            control = PilotPlan(control.nodes, room)
        if settings.screen == "quadtree":
            stride, packets = settings.leaf_pixels // 2, max(lists.num_bundles // tuning.turns, MIN_PACKETS)
            down, across = (-(-num_nodes(size, stride) // TILE) for size in (self.height, self.width))
            coarse = self._lists(down, across, measures.of_lattice)
            quadtree = QuadtreePlan(settings.leaf_pixels, coarse, min(packets, lists.num_bundles))
        size = self.width, self.height, self.samples, self.num_particles, self.num_classes, bands
        made = Plan(*size, lists, cast, 0, control, self.integrator, settings.screen, quadtree)
        return dataclasses.replace(made, bytes=bytes_of(made, self.number))

    def _lists(self, rows: int, columns: int, pairs: Sequence[int]) -> ListPlan:
        """Of so many rows and columns of tiles, with room for pairs of tiles and of bundles."""
        tiled, listed = map(self.room_for, pairs)
        # as many sorts as run side by side, but not more than pays: every one is a few kernels more to compile
        runs = 1 << (min(self.tuning.max_sorts, max(tiled // self.tuning.pairs_per_sort, 1)).bit_length() - 1)
        return ListPlan(rows, columns, tiled, listed, runs)


def _slabs(plan: Plan) -> int:
    return plan.lists.num_bundles * -(-plan.samples // plan.cast.slab_samples)


def bytes_of(plan: Plan, number: int) -> int:
    """About what a frame takes with all the room of a plan, of numbers so many bytes wide."""
    lists, cast, control, pixels = plan.lists, plan.cast, plan.control, plan.width * plan.height
    slabs = -(-plan.samples // cast.slab_samples)
    of_bundle = plan.num_classes * slabs * 40 + RAYS * 5 * number * 2 + slabs * 8
    of_lists = [plan.lists] if plan.quadtree is None else [plan.lists, plan.quadtree.lists]
    if isinstance(control, ControlPlan):  # tables of all candidates of all cells, paint of slabs, and windows of coarser ones
        of_bundle += slabs * (24 * number + plan.num_classes * 32)
    needed = plan.num_particles * (24 * number + 64) + lists.num_bundles * of_bundle + pixels * 8 * number
    needed += sum(one.tile_capacity * (12 * number + 48) + one.list_capacity * 8 for one in of_lists)
    needed += (16 * cast.chunk + 3 * cast.batch_slabs) * cast.slab_samples * RAYS * number
    if isinstance(control, PilotPlan):
        of_nodes = math.prod(control.room or lists.bundles) * control.nodes.across**2
        needed += slabs * -(-cast.slab_samples // control.nodes.samples) * of_nodes * ARRAYS_OF_NODES * number
    return needed + (0 if plan.quadtree is None else pixels * NUMBERS_OF_CANVAS * number)


def fullest_band(counts: np.ndarray, rows: int) -> int:
    """Most pairs of any band of so many rows of tiles, of which there are counts."""
    return int(np.pad(counts, (0, -len(counts) % rows)).reshape(-1, rows).sum(1).max(initial=0))


def next_class(count: int) -> int:
    """The capacity class after that of `count`."""
    return capacity_class(capacity_class(count) + 1)


def _control(settings: Settings) -> ControlPlan | PilotPlan | None:
    """The error control that settings ask for, whatever the frame; None without a tolerance that is kept so."""
    if settings.tolerance is None or settings.is_refined:
        return None
    if settings.estimator == "pilot":
        return PilotPlan()
    return ControlPlan(settings.super_pixels, settings.merge, settings.allocation, relaxed=settings.is_relaxed)


def _described(control: ControlPlan | PilotPlan | None) -> str:
    """By what settings ask for, not by what was chosen for a frame."""
    if control is None:
        return "full rate (`tolerance=None`)"
    if isinstance(control, PilotPlan):
        return "`estimator='pilot'`"
    chosen = f"super_pixels={control.super_pixels}, merge={control.merge}, allocation={control.allocation!r}"
    return f"`estimator='interval'` with {chosen}"
