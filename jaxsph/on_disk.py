"""Pictures of snapshots that are larger than memory: each part of the image has the particles that its rays can meet, no others.

Flow: snapshot, index -> rows of a part -> runs that they can see -> particles -> view -> [on_disk] -> parts -> Image.

All rays of a part find what they would find among all particles, in the same order. Two things of a picture depend on particles
elsewhere, too: classes of supports on the widest, strengths on the strongest. Those two come along with every part. So pixels are
the same bits as those of the whole in memory, if what is chosen by how large supports appear, of a sample here, is chosen alike;
where supports reach around the eye or across near and far, they are so to rounding.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsph import scenes
from jaxsph.access.lists import TILE
from jaxsph.along_rays import along_rays
from jaxsph.field.in_octree import reachable
from jaxsph.io.assemble import opacity_of
from jaxsph.io.quantities import ROLES, choose_quantity
from jaxsph.io.snapshot_index import SnapshotIndex, index_of
from jaxsph.io.snapshot_rows import Snapshot, needed_columns, supports_and_volumes
from jaxsph.io.table import ParticleTable
from jaxsph.measures import Measures
from jaxsph.model.camera import Camera
from jaxsph.model.frusta import Planes, between_depths, seen_by_rows
from jaxsph.model.image import Image
from jaxsph.model.particles import Particles, capacity_class
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics import free_memory
from jaxsph.numerics.executors import Clock
from jaxsph.plan import Choices, FrameShape, Plan, choose, fitted
from jaxsph.planning import MAX_CLASSES, measured, see, shape_of_scene, stride_of
from jaxsph.render import Progress, image_of
from jaxsph.tiles import joined, of_rows
from jaxsph.viewing import Seen

MEMORY = 1 << 30
SAMPLED = 1 << 16
"""Particles, about, by which colours, plans and parts are chosen."""
READ_BYTES, BYTES_A_PARTICLE = 96, 430
"""Of a particle of a part: of columns that are read, with those of the next part; and in all, with its place in lists."""
FRAME_SHARE = 0.2
"""Of the memory, that a frame takes whatever its particles."""
CROWDED = 1.25
"""Times as many particles as the sample has it there is room for in a part."""
Columns = tuple[np.ndarray, ...]


@dataclasses.dataclass(frozen=True, eq=False)
class OnDisk:
    """A snapshot whose particles stay on disk; made by `OnDisk.open`.

    Attributes:
        snapshot, index: its files, and where in space their particles are.
        quantities: names of the quantity, and of that of extinction if there is another.
        kernel: name of the smoothing kernel.
        sample: some of the particles, evenly taken, with supports so large that they fill as much of space as all of them.
        ramp: how extinction depends on its quantity by default, see `scenes.default_transfer`.
    """

    snapshot: Snapshot
    index: SnapshotIndex
    quantities: tuple[str, ...]
    kernel: str
    sample: Particles
    ramp: str | None = None

    @classmethod
    def open(
        cls,
        path: str | Path,
        quantity: str | None = None,
        *,
        kernel: str = "poly6",
        part_type: int | None = None,
        opacity_by: str | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> OnDisk:
        """Open a snapshot: Gadget-like HDF5 with supports, masses and densities, in one file or several.

        The first time all of it is read once, to index it; the index is kept beside it.

        Args:
            path: any of its files.
            quantity, kernel, part_type, opacity_by: as for `jaxsph.io.read_particles`; sums over neighbours cannot be had.
            progress: called as `progress(done, total)` while it is indexed.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: another format; particles whose supports or volumes need neighbours; an unknown quantity.

        Warns:
            UserWarning: where the index cannot be kept.
        """
        snapshot = Snapshot(path, part_type)
        index = index_of(snapshot, progress=progress)
        table = _sampled(snapshot, index)
        _, name = choose_quantity(table, quantity)
        _, volume = supports_and_volumes(table)
        mass = table.named(*ROLES["mass"])
        _, second = opacity_of(table, name, opacity_by, volume if mass is None else volume / table.columns[mass], None)
        names = tuple(dict.fromkeys((name, *([] if second is None else [second]))))
        ramp = "even" if name in ("x", "y", "z") else None
        nothing = Particles.from_arrays(np.zeros((0, 3)), 1.0, 0.0)
        opened = cls(snapshot, index, names, kernel, nothing, ramp if second is None else "steep")
        position, support, volume, *values = opened.columns_of(table)
        thinned = np.cbrt(max(len(index), 1) / max(len(table), 1))
        sample = opened.particles((position, (support * thinned).astype(support.dtype), volume, *values))
        return dataclasses.replace(opened, sample=sample)

    def __len__(self) -> int:
        return len(self.index)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Camera.framing`."""
        return self.index.bounds()

    def transfer(self, colormap: str = "viridis", values: tuple[float, float] | None = None, **more: Any) -> TransferFunction:
        """What its particles look like by default, see `scenes.default_transfer`; chosen by the sample."""
        return scenes.default_transfer(self.sample, colormap, values, **{"ramp": self.ramp, **more})

    @functools.cached_property
    def needed(self) -> list[str]:
        """Columns of the files that are read."""
        return needed_columns(self.snapshot.first, *self.quantities)

    def columns_of(self, table: ParticleTable) -> Columns:
        """Positions, supports, volumes and quantities of rows that were read, as particles have them."""
        support, volume = supports_and_volumes(table)
        values = [choose_quantity(table, name)[0] for name in self.quantities]
        dtype = table.position.dtype
        with np.errstate(over="ignore"):
            return table.position, *(column.astype(dtype) for column in (support, volume / self._volume_unit, *values))

    @functools.cached_property
    def _volume_unit(self) -> float:
        """What volumes are divided by where float32 could not hold them: only their ratios matter."""
        limits, volumes = np.finfo(np.float32), self.index.volume
        if not volumes.size or (volumes.max() < np.sqrt(limits.max) and volumes.min() > np.sqrt(limits.tiny)):
            return 1.0
        return float(2.0 ** np.round((np.log2(volumes.min()) + np.log2(volumes.max())) / 2))

    def particles(self, columns: Columns, capacity: int | None = None) -> Particles:
        """Of columns."""
        position, support, volume, *values = columns
        quantity: Any = values[0] if len(values) == 1 else tuple(values)
        return Particles.from_arrays(position, support, quantity, volume, self.kernel, capacity=capacity)

    def seen_by(self, planes: Planes, always: frozenset[tuple[int, int]] = frozenset()) -> Columns:
        """The particles whose supports reach into a region, and some others, in the order of the files."""
        index, parts = self.index, [self.columns_of(self._nothing)]
        held = planes.meet_boxes(index.lower, index.upper, index.support) if len(index.file) else np.zeros(0, bool)
        for file, row in always:
            held |= (index.file == file) & (index.begin <= row) & (row < index.end)
        for run in np.flatnonzero(held):
            file, begin, end = int(index.file[run]), int(index.begin[run]), int(index.end[run])
            columns = self.columns_of(self.snapshot.read(file, slice(begin, end), self.needed))
            kept = planes.meet(columns[0].astype(np.float64), columns[1].astype(np.float64))
            kept[[row - begin for which, row in always if which == file and begin <= row < end]] = True
            parts.append(tuple(column[kept] for column in columns))
        return tuple(np.concatenate(each) for each in zip(*parts, strict=True))

    @functools.cached_property
    def _nothing(self) -> ParticleTable:
        file = int(self.index.file[0]) if len(self.index.file) else 0
        return self.snapshot.read(file, slice(0, 0), self.needed)

    def extremes(self, camera: Camera) -> frozenset[tuple[int, int]]:
        """File and row of the widest and of the strongest particle between near and far."""
        index, planes = self.index, between_depths(camera)
        runs = np.flatnonzero(planes.meet_boxes(index.lower, index.upper, index.support)) if len(index.file) else np.zeros(0, int)
        found = set()
        for rows, values in ((index.widest, index.support), (index.strongest, index.strength)):
            for run in sorted(runs, key=lambda run: -values[run]):
                place = int(index.file[run]), int(rows[run])
                position, support, *_ = self.columns_of(self.snapshot.read(place[0], slice(place[1], place[1] + 1), self.needed))
                if planes.meet(position.astype(np.float64), support.astype(np.float64))[0]:
                    found.add(place)
                    break
        return frozenset(found)


def _sampled(snapshot: Snapshot, index: SnapshotIndex) -> ParticleTable:
    """Rows at the beginning of every run."""
    each = max(SAMPLED // max(len(index.file), 1), 1)
    rows = zip(index.file, index.begin, index.end, strict=True)
    tables = [snapshot.read(int(file), slice(int(begin), min(int(begin) + each, int(end)))) for file, begin, end in rows]
    if not tables:
        return snapshot.read(0, slice(0, 0))
    names = set.intersection(*(set(table.columns) for table in tables))
    columns = {name: np.concatenate([table.columns[name] for table in tables]) for name in tables[0].columns if name in names}
    supports = [table.support for table in tables if table.support is not None]
    position = np.concatenate([table.position for table in tables])
    return dataclasses.replace(tables[0], position=position, columns=columns, support=np.concatenate(supports))


class Parts(NamedTuple):
    """How a picture is cut.

    Attributes:
        rows: first row of each part, and the end of the last.
        capacity: room for particles of each.
    """

    rows: list[int]
    capacity: int

    def __len__(self) -> int:
        return len(self.rows) - 1


def render_from_disk(
    on_disk: OnDisk,
    transfer: TransferFunction,
    camera: Camera,
    settings: Settings | None = None,
    *,
    memory: int = MEMORY,
    progress: Progress | None = None,
) -> Image:
    """Render a snapshot that is larger than memory.

    Rows of the image are rendered part by part, each with the particles whose supports its rays can meet; those of the next part
    are read meanwhile. A snapshot whose rows are ordered in space is read about once, one whose are not once a part: see
    `jaxsph.io.sort_snapshot`.

    Args:
        on_disk: the snapshot.
        transfer: what its particles look like: `on_disk.transfer()`.
        camera, settings: as for `jaxsph.render`; no quadtree of rays, nor octree integrators.
        memory: bytes that particles and what is made of them may take, beyond the interpreter and compiled programs.
        progress: called as `progress(done, total)` after every part.

    Returns:
        As `jaxsph.render` of all particles, not repeated across the faces of a periodic box; `stats["parts"]` and
        `stats["most_particles"]` say how many parts there were, and how many particles the fullest had.

    Raises:
        ValueError: memory that does not suffice for a single row of tiles (how much does), a screen or an integrator that
            needs all particles; as `jaxsph.render`.
    """
    settings = settings or Settings()
    if settings.screen == "quadtree":
        raise ValueError("`settings.screen` must be 'pixels' for parts of a picture: leaves of a quadtree lie across their edges")
    parts = cut(on_disk, camera, memory)
    left = max(memory - READ_BYTES * parts.capacity, 1)
    settings = dataclasses.replace(settings, memory_limit=settings.memory_limit or left)
    renderer = _Renderer(on_disk, transfer, camera, settings, parts.capacity)
    always = on_disk.extremes(camera)
    planes = [seen_by_rows(camera, *ends) for ends in zip(parts.rows[:-1], parts.rows[1:], strict=True)]
    images, most = [], 0
    with ThreadPoolExecutor(1, "jaxsph-read") as reader:
        ahead: Future[Columns] = reader.submit(on_disk.seen_by, planes[0], always)
        for number, (first, end) in enumerate(zip(parts.rows[:-1], parts.rows[1:], strict=True)):
            columns = ahead.result()
            if number + 1 < len(parts):
                ahead = reader.submit(on_disk.seen_by, planes[number + 1], always)
            images.append(renderer.part(columns, first, end))
            free_memory.give_back()
            most = max(most, len(columns[0]))
            if progress is not None:
                progress(number + 1, len(parts))
    image = joined(images)
    return dataclasses.replace(image, stats=image.stats | {"parts": len(parts), "most_particles": most})


def cut(on_disk: OnDisk, camera: Camera, memory: int) -> Parts:
    """Parts of as many rows as memory allows, by how many particles of the sample each can see.

    Raises:
        ValueError: a row of tiles alone needs more.
    """
    tile_rows = -(-camera.height // TILE)
    each = _particles_of(on_disk, camera, tile_rows)
    room = int((1 - FRAME_SHARE) * memory) // BYTES_A_PARTICLE
    if max(each) > room:
        least = int(BYTES_A_PARTICLE * max(each) / (1 - FRAME_SHARE)) + 1
        raise ValueError(
            f"`memory` = {memory} bytes is too little: {TILE} rows of pixels see about {max(each):,} particles, "
            f"which need {least:,}; give more, or look closer"
        )
    rows = 1
    while rows < tile_rows and max(_particles_of(on_disk, camera, -(-tile_rows // (2 * rows)))) <= room:
        rows *= 2
    most = max(_particles_of(on_disk, camera, -(-tile_rows // rows)))
    rows = min(rows, tile_rows)
    return Parts([*range(0, camera.height, rows * TILE), camera.height], capacity_class(max(most, 1)))


def _particles_of(on_disk: OnDisk, camera: Camera, parts: int) -> list[int]:
    """About how many particles each of so many parts sees, with some to spare."""
    there = np.asarray(on_disk.sample.valid)
    position, count = on_disk.sample.exact_position()[there], int(there.sum())
    support = np.asarray(on_disk.sample.support, np.float64)[there]
    support = support * np.cbrt(max(count, 1) / max(len(on_disk), 1))  # the sample's are larger
    tile_rows = -(-camera.height // TILE)
    rows = -(-tile_rows // parts) * TILE
    found = []
    for first in range(0, camera.height, rows):
        seen = seen_by_rows(camera, first, min(first + rows, camera.height)).meet(position, support)
        share = (seen.sum() + 2 * np.sqrt(seen.sum()) + 1) / max(count, 1)
        found.append(int(min(CROWDED * share, 1.0) * len(on_disk)) + 2)
    return found


@dataclasses.dataclass
class _Renderer:
    """Parts of one picture, with one plan that grows where it has to."""

    on_disk: OnDisk
    transfer: TransferFunction
    camera: Camera
    settings: Settings
    capacity: int
    plan: Plan | None = None

    def part(self, columns: Columns, first: int, end: int) -> Image:
        """The image of some rows."""
        self.capacity = max(self.capacity, capacity_class(len(columns[0])))
        particles = self.on_disk.particles(columns, self.capacity)
        scene = reachable(Scene(particles=particles, transfer=self.transfer), self.settings)
        along, clock = along_rays(scene, self.settings), Clock()
        shape = dataclasses.replace(shape_of_scene(scene, self.camera, along), headroom=1.0, num_classes=self._classes)
        seen, measures = measured(
            see(scene, self.camera, shape, clock), self.camera, shape.samples, shape.tuning, stride_of(along)
        )
        rows = dataclasses.replace(shape, height=end - first)
        needed = of_rows(measures, first // TILE, -(-end // TILE))
        made = fitted(needed, rows, along, self._choices)
        if self.plan is None or self.plan.height != made.height:
            roomy = fitted(needed, dataclasses.replace(rows, headroom=CROWDED), along, self._choices)
            self.plan = roomy
        self.plan = self.plan.grown(made)
        clock.mark("plan")
        return image_of(seen, self.camera, self.settings, self.plan, scene.formulas, clock, None, planned=True, first_row=first)

    @functools.cached_property
    def _classes(self) -> int:
        """Of supports, as the whole snapshot has them: `planning` counts octaves."""
        support = self.on_disk.index.support
        if not support.size:
            return 1
        octaves = np.log2(support.max() / self.on_disk.index.least.min())
        return int(min(2 + np.ceil(max(octaves, 0)), MAX_CLASSES))

    @functools.cached_property
    def _choices(self) -> Choices:
        """By how large supports of the sample appear."""
        sample = self.on_disk.sample
        thinned = np.cbrt(max(sample.num_particles, 1) / max(len(self.on_disk), 1))
        true = dataclasses.replace(sample, support=sample.support * sample.dtype.type(thinned))
        scene = reachable(Scene(particles=true, transfer=self.transfer), self.settings)
        along, clock = along_rays(scene, self.settings), Clock()
        shape: FrameShape = shape_of_scene(scene, self.camera, along)
        return choose(self._measured(scene, shape, along, clock)[1], along)

    def _measured(self, scene: Scene, shape: FrameShape, along: Settings, clock: Clock) -> tuple[Seen, Measures]:
        seen = see(scene, self.camera, shape, clock)
        return measured(seen, self.camera, shape.samples, shape.tuning, stride_of(along))
