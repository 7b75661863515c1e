"""Pictures of snapshots that are larger than memory: each pane of the image has the particles that its rays can meet, no others.

Flow: OnDisk, camera -> panes -> runs that they can see -> particles -> view -> [from_disk] -> panes of pixels -> Image.

All rays of a pane find what they would find among all particles, in the same order. Two things of a picture depend on
particles elsewhere, too: classes of supports on the widest, strengths on the strongest. Those two come along with every pane. So
pixels are the same bits as those of the whole in memory, if what is chosen by how large supports appear, of a sample here, is
chosen alike; where supports reach around the eye or across near and far, they are so to rounding.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from jaxsph.engine.access.lists import TILE
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.images import image_of
from jaxsph.engine.planning.fit import MAX_CLASSES, measured, see, shape_of, sorted_and_measured
from jaxsph.engine.planning.measures import Measures
from jaxsph.engine.planning.plan import FrameShape, Plan, bytes_of, choose, fitting, in_bands, smallest
from jaxsph.engine.planning.viewing import Seen
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.executors import Eager
from jaxsph.engine.runtime.memory import give_back, given_back_at_once
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.frusta import seen_by
from jaxsph.model.image import Image
from jaxsph.model.particles.particles import capacity_class
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.checks import Progress, array_of
from jaxsph.scale.on_disk import MOST_EXTREMES, Columns, OnDisk
from jaxsph.scale.panes import Need, Pane, crowds
from jaxsph.scale.parts import joined, of_columns, of_rows

MEMORY = 1 << 30
READ_BYTES = 96
"""Of a particle of a pane: of columns that are read, with those of the next pane."""
CROWDED = 1.25
"""Times as many particles as the sample has it there is room for in a pane."""
SIDES = "left", "right", "top", "bottom"
LEAST = f"{TILE} x {TILE} pixels", f"{TILE} rows of pixels"
"""The least pane, and the least from one side of the image to the other."""


class TooLittleMemoryError(ValueError):
    """No cut into panes fits the memory.

    Attributes:
        name: `"memory"` or `"settings.memory_limit"`, whichever is too little.
        least: bytes of it with which the finest cut fits.
        why: what needs so many.
    """

    def __init__(self, name: str, given: int, least: int, why: str) -> None:
        super().__init__(f"`{name}` = {given} bytes is too little: {why}, which need {least:,}; give more, or look closer")
        self.name, self.least, self.why = name, least, why


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

    The image is rendered pane by pane, each with the particles whose supports its rays can meet; those of the next pane are
    read meanwhile. Where rows are ordered in space, as SWIFT's are, all is read a few times, else once a pane.

    Args:
        on_disk: the snapshot.
        transfer: what its particles look like: `on_disk.transfer()`.
        camera, settings: as for `jaxsph.render`; no quadtree of rays, nor octree integrators.
        memory: bytes that particles and what is made of them may take, beyond the interpreter and compiled programs.
        progress: called as `progress(done, total)` after every pane.

    Returns:
        As `jaxsph.render` of all particles, not repeated across the faces of a periodic box; `stats["panes"]` and
        `stats["most_particles"]` say how many panes there were, and how many particles the fullest had.

    Raises:
        TooLittleMemoryError: a `ValueError`: memory that does not suffice for a single tile, and how much does.
        ValueError: a screen or an integrator that needs all particles; as `jaxsph.render`.
    """
    settings = settings or Settings()
    if settings.screen == "quadtree":
        raise ValueError("`settings.screen` must be 'pixels' for parts of a picture: leaves of a quadtree lie across their edges")
    renderer = _Renderer(on_disk, transfer, camera, settings, memory)
    todo, images, most = deque(renderer.panes()), dict[Pane, Image](), 0
    always, ahead = on_disk.extremes(camera), dict[Pane, Future[Columns | None]]()
    with given_back_at_once(), ThreadPoolExecutor(1, "jaxsph-read") as thread:

        def begun(pane: Pane) -> Future[Columns | None]:
            return thread.submit(on_disk.seen_by, seen_by(camera, *pane), always, memory // READ_BYTES)

        while todo:
            pane = todo.popleft()
            columns = (ahead.pop(pane, None) or begun(pane)).result()
            if todo and not ahead:
                ahead[todo[0]] = begun(todo[0])
            image = None if columns is None else renderer.pane(columns, pane)
            if columns is None or image is None:
                halves = pane.halves(renderer.whole_rows)[1]
                if not halves:
                    renderer.require_least()
                    raise AssertionError(f"{pane} fits by counting, but not by its plan")
                todo.extendleft(reversed(halves))
                continue
            images[pane], most = image, max(most, len(columns[0]))
            del columns
            give_back()
            if progress is not None:
                progress(len(images), len(images) + len(todo))
    image = _of_halves(renderer.whole, images, renderer.whole_rows)
    return dataclasses.replace(image, stats=image.stats | {"panes": len(images), "most_particles": most})


def _of_halves(pane: Pane, images: dict[Pane, Image], whole_rows: bool) -> Image:
    """The image of a pane, of its halves where it was cut."""
    if pane in images:
        return images[pane]
    axis, halves = pane.halves(whole_rows)
    return joined([_of_halves(half, images, whole_rows) for half in halves], axis=axis)


class _Renderer:
    """Panes of one picture, with one plan that grows where it has to; all is chosen by the sample, with the supports of all."""

    def __init__(self, on_disk: OnDisk, transfer: TransferFunction, camera: Camera, settings: Settings, memory: int) -> None:
        self._on_disk, self._transfer, self._camera, self._settings, self._memory = on_disk, transfer, camera, settings, memory
        self.whole = Pane(0, camera.height, 0, camera.width)
        sample, index = on_disk.sample, on_disk.index
        thinned = np.cbrt(max(sample.num_particles, 1) / max(len(on_disk), 1))
        true = dataclasses.replace(sample, support=sample.support * sample.dtype.type(thinned))
        self._asked = Request.of(Scene(particles=true, transfer=transfer), camera, settings)
        self.whole_rows = self._asked.along.estimator == "pilot"  # whose lattice reaches from bundle to bundle
        octaves = np.log2(index.support.max() / index.least.min()) if index.support.size else -1.0
        classes = int(min(2 + np.ceil(octaves), MAX_CLASSES))  # as `planning` counts them in the whole
        self._shape = dataclasses.replace(shape_of(self._asked), num_classes=classes, headroom=1.0)
        self._sample = see(self._asked.scene, self._asked.camera, self._shape, Eager())
        self._given = self._asked.along, choose(measured(self._sample, self._asked, self._shape), self._asked.along)
        self._limit = settings.memory_limit or memory  # of a frame, whatever is read
        self._capacity, self._plans = 1, dict[tuple[int, int], Plan]()  # by rows of pixels and entries of particle arrays

    def panes(self) -> list[Pane]:
        """Halves of halves of the picture, each of which fits as far as the sample tells.

        The fullest are the first: where the plan has room for them, it has for most.

        Raises:
            TooLittleMemoryError: the least pane needs more.
        """
        todo, needs, fit = [self.whole], dict[Pane, Need](), True
        while todo:
            pane = todo.pop()
            need, halves = self._told(pane), pane.halves(self.whole_rows)[1]
            if halves and not self._fits(need):
                todo += halves
            else:
                needs[pane], fit = need, fit and self._fits(need)
        if not fit:
            self.require_least()
        return sorted(needs, key=lambda pane: -needs[pane].particles)

    def _told(self, pane: Pane) -> Need:
        """What suffices for a pane, as far as the sample tells."""
        seen, all_there = _within(self._sample, pane), len(self._on_disk)
        rows = of_rows(measured(seen, self._asked, self._shape), pane.top // TILE, -(-pane.bottom // TILE))
        left, right, top, bottom = (np.asarray(getattr(seen.viewed, side)) for side in SIDES)
        counts = ((left <= right) & (top <= bottom)).sum(), rows.tile_pairs.max(), rows.bundle_pairs.max()
        scale = CROWDED * all_there / max(self._on_disk.sample.num_particles, 1)
        held, tiles, bundles = (int(scale * (count + 2 * np.sqrt(count) + 1)) + MOST_EXTREMES for count in counts)
        return Need(min(held, all_there + MOST_EXTREMES), tiles, bundles, pane.bottom - pane.top)

    def require_least(self) -> None:
        """Raise where the least panes do not fit: all particles are read once, to count them."""
        some = (columns for _, _, columns in self._on_disk.read(seen_by(self._camera, *self.whole)))
        counts = crowds(self._camera, self._on_disk.index.bounds(), some, self.whole_rows)
        held, pairs = (max(each.values(), default=0) for each in counts)
        need = Need(held + MOST_EXTREMES, pairs, 4 * pairs, TILE)  # a particle has up to four bundles in a tile
        why, bytes_of_it = f"{LEAST[self.whole_rows]} see up to {need.particles:,} particles", self._bytes(need)
        for name, given, least in zip(("memory", "settings.memory_limit"), (self._memory, self._limit), bytes_of_it, strict=True):
            if given < least:
                raise TooLittleMemoryError(name, given, least, why)

    def _fits(self, need: Need) -> bool:
        in_all, of_frame = self._bytes(need)
        return in_all <= self._memory and of_frame <= self._limit

    def _bytes(self, need: Need) -> tuple[int, int]:
        """In all, and of the frame alone, in bands of one row of tiles and least batches."""
        tile_rows, tile_columns = -(-need.height // TILE), -(-self._camera.width // TILE)
        tiles, bundles = (np.full(tile_rows, count) for count in (need.tile_pairs, need.bundle_pairs))
        measures = Measures(tiles, bundles, 2 * tile_rows, 2 * tile_columns, math.nan, math.nan)
        shape = dataclasses.replace(self._shape, height=need.height, num_particles=capacity_class(need.particles))
        frame = smallest(measures, shape, *self._given).bytes
        return frame + READ_BYTES * shape.num_particles, frame

    def pane(self, columns: Columns, pane: Pane) -> Image | None:
        """The image of some pixels; None where it needs more memory than there is."""
        needed = capacity_class(len(columns[0]))
        for capacity in dict.fromkeys((max(self._capacity, needed), needed)):
            fits = self._fits(Need(capacity, 1, 1, pane.bottom - pane.top))
            if fits and (image := self._image(columns, pane, capacity)) is not None:
                self._capacity = max(self._capacity, capacity)
                return image
        return None

    def _image(self, columns: Columns, pane: Pane, capacity: int) -> Image | None:
        particles = self._on_disk.particles(columns, capacity)
        asked, run = Request.of(Scene(particles=particles, transfer=self._transfer), self._camera, self._settings), Eager()
        shape = dataclasses.replace(self._shape, num_particles=capacity)
        seen = _within(see(asked.scene, asked.camera, shape, run), pane)
        seen, measures = sorted_and_measured(seen, asked, shape)
        rows = dataclasses.replace(shape, height=pane.bottom - pane.top)
        plan = self._plan_for(of_rows(measures, pane.top // TILE, -(-pane.bottom // TILE)), rows)
        run.mark("plan")
        if plan is None:
            return None
        frame = Frame(seen, asked.camera, self._settings, plan, asked.scene.formulas, pane.top)
        image = image_of(frame.drawn(run), frame, run)
        return of_columns(asked.in_given_unit(image), pane.left, pane.right)

    def _plan_for(self, needed: Measures, shape: FrameShape) -> Plan | None:
        """The plan there is, if it serves; else with room for more like this if memory allows; None where it allows none."""
        limit = min(self._limit, self._memory - READ_BYTES * shape.num_particles)
        roomy, kept = dataclasses.replace(shape, headroom=CROWDED), self._plans.get((shape.height, shape.num_particles))
        if kept is not None:
            sizes = kept.bands, kept.cast.batch_slabs
            if kept.serves(in_bands(needed, shape, *self._given, *sizes)):
                return kept
            grown = kept.grown(in_bands(needed, roomy, *self._given, *sizes))
            kept = dataclasses.replace(grown, bytes=bytes_of(grown, shape.number))
        if kept is None or kept.bytes > limit:
            kept = fitting(needed, roomy, *self._given, limit) or fitting(needed, shape, *self._given, limit)
        if kept is not None:
            self._plans[shape.height, shape.num_particles] = kept
        return kept


def _within(seen: Seen, pane: Pane) -> Seen:
    """What is seen, with no particle touching any pixel out of a pane."""
    ends = zip(SIDES, (np.maximum, np.minimum) * 2, (pane.left, pane.right - 1, pane.top, pane.bottom - 1), strict=True)
    inside = {side: array_of(clipped(np.asarray(getattr(seen.viewed, side)), end)) for side, clipped, end in ends}
    return seen._replace(viewed=dataclasses.replace(seen.viewed, **inside))
