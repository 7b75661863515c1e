"""Pictures of snapshots that are larger than memory: each pane of the image has the particles that its rays can meet, no others.

Flow: OnDisk, camera -> panes -> runs that they can see -> particles -> view -> [from_disk] -> panes of pixels -> Image.

All rays of a pane find what they would find among all particles, in the same order. Two things of a picture depend on
particles elsewhere, too: classes of supports on the widest, strengths on the strongest. Those two come along with every pane. So
pixels are the same bits as those of the whole in memory, if what is chosen by how large supports appear, of a sample here, is
chosen alike; where supports reach around the eye or across near and far, they are so to rounding.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from jaxsph.engine.access.lists import TILE
from jaxsph.engine.frame.frame import Frame
from jaxsph.engine.frame.images import image_of
from jaxsph.engine.planning.fit import MAX_CLASSES, demanded, fit, see, shape_of
from jaxsph.engine.planning.plan import Demand, Plan
from jaxsph.engine.planning.viewing import Measures, Seen
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.executors import Eager
from jaxsph.engine.runtime.programs import give_back, given_back_at_once
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.particles.particles import capacity_class
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.checks import Progress, array_of
from jaxsph.scale.on_disk import Columns, OnDisk, seen_by
from jaxsph.scale.parts import NO_LEAVES, cut, joined

MEMORY = 1 << 30
READ_BYTES = 96
"""Of a particle of a pane: of columns that are read, with those of the next pane."""
CROWDED = 1.25
"""Times what a pane needs that there is room for, so that its plan serves others, and that is named where it is too much."""
SIDES = "left", "right", "top", "bottom"


class Pane(NamedTuple):
    """Pixels of an image: rows from `top` to `bottom`, and columns from `left` to `right`, both exclusive."""

    top: int
    bottom: int
    left: int
    right: int

    def halves(self, whole_rows: bool) -> tuple[int, list[Pane]]:
        """The axis that it is cut across, the longer, and two panes of whole tiles; no panes where it is the least there is.

        What reaches across a border is held by both sides, and a square has the shortest border. With `whole_rows` panes are
        cut into rows alone.
        """
        tiles_across, tiles_down = -(-(self.right - self.left) // TILE), -(-(self.bottom - self.top) // TILE)
        if tiles_across > 1 and tiles_across >= tiles_down and not whole_rows:
            middle = self.left + tiles_across // 2 * TILE
            return 1, [self._replace(right=middle), self._replace(left=middle)]
        if tiles_down > 1:
            middle = self.top + tiles_down // 2 * TILE
            return 0, [self._replace(bottom=middle), self._replace(top=middle)]
        return 0, []


class TooLittleMemoryError(ValueError):
    """A pane that cannot be cut does not fit the memory.

    Attributes:
        name: `"memory"` or `"settings.memory_limit"`, whichever is too little.
        least: bytes of it with which that pane fits, with a fourth more for those that are fuller.
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
        TooLittleMemoryError: a `ValueError`: memory that does not suffice for a single tile, and how much should.
        ValueError: a screen or an integrator that needs all particles; as `jaxsph.render`.
    """
    settings = settings or Settings()
    if settings.screen == "quadtree":
        raise ValueError(NO_LEAVES)
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
            try:
                images[pane] = renderer.pane(columns, pane)
            except TooLittleMemoryError:
                if not (halves := pane.halves(renderer.whole_rows)[1]):
                    raise
                todo.extendleft(reversed(halves))
                continue
            most = max(most, 0 if columns is None else len(columns[0]))
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
        self._true = dataclasses.replace(sample, support=sample.support * sample.dtype.type(thinned))
        asked = Request.of(Scene(particles=self._true, transfer=transfer), camera, settings)
        self.whole_rows = asked.along.estimator == "pilot"  # whose lattice reaches from bundle to bundle
        octaves = np.log2(index.runs.support.max() / index.runs.least.min()) if len(index.runs) else -1.0
        classes = int(min(2 + np.ceil(octaves), MAX_CLASSES))  # as `planning` counts them in the whole
        self._shape = dataclasses.replace(shape_of(asked), num_classes=classes, headroom=1.0)
        _, self._demand = demanded(see(asked.scene, asked.camera, self._shape, Eager()), asked, self._shape, in_order=False)
        self._limit = settings.memory_limit or memory  # of a frame, whatever is read
        self._capacity, self._plans = 1, dict[tuple[int, int], Plan]()  # by rows of pixels and entries of particle arrays

    def panes(self) -> list[Pane]:
        """Halves of halves of the picture, the particles of each of which fit as far as the sample tells.

        The fullest are the first: where the plan has room for them, it has for most.
        """
        known = np.asarray(self._true.valid)
        position, support = self._true.exact_position()[known], np.asarray(self._true.support, np.float64)[known]
        todo, counts = [self.whole], dict[Pane, int]()
        while todo:
            pane = todo.pop()
            count, halves = int(seen_by(self._camera, *pane).meet(position, support).sum()), pane.halves(self.whole_rows)[1]
            if halves and not self._fits(self.bytes(count * len(self._on_disk) // max(len(position), 1), pane)):
                todo += halves
            else:
                counts[pane] = count
        return sorted(counts, key=lambda pane: -counts[pane])

    def bytes(self, particles: int, pane: Pane, full: bool = False) -> tuple[int, int]:
        """What the particles of a pane take in all, and of the frame alone; `full`: of a tile that all of them touch."""
        tile_rows, tile_columns = -(-(pane.bottom - pane.top) // TILE), -(-self._camera.width // TILE)
        tiles = np.full(tile_rows, particles if full else 1)  # of a tile they touch up to four bundles
        measures = Measures(tiles, 4 * tiles, 2 * tile_rows, 2 * tile_columns, math.nan, math.nan)
        sizes = {"height": pane.bottom - pane.top, "num_particles": capacity_class(particles)}
        return self._with_read(self._demand.shaped(measures=measures, **sizes))

    def _with_read(self, demand: Demand) -> tuple[int, int]:
        frame = demand.smallest().bytes
        return frame + READ_BYTES * demand.num_particles, frame

    def _fits(self, needed: tuple[int, int]) -> bool:
        return needed[0] <= self._memory and needed[1] <= self._limit

    def _require(self, needed: tuple[int, int], pane: Pane) -> None:
        """Raise where a pane needs more than there is."""
        told = f"{TILE} rows of pixels" if self.whole_rows else f"{TILE} x {TILE} pixels"
        why = f"the particles that {told} see from row {pane.top} on"
        for name, given, least in zip(("memory", "settings.memory_limit"), (self._memory, self._limit), needed, strict=True):
            if given < least:
                raise TooLittleMemoryError(name, given, int(CROWDED * least), why)

    def pane(self, columns: Columns | None, pane: Pane) -> Image:
        """The image of some pixels, given the particles that they see, unless these are more than are held.

        Raises:
            TooLittleMemoryError: it needs more memory than there is.
        """
        if columns is None:
            whole = not pane.halves(self.whole_rows)[1]  # else it is cut, however many they are
            count = self._on_disk.count(seen_by(self._camera, *pane)) if whole else 0
            self._require(self.bytes(max(count, self._memory // READ_BYTES + 1), pane, full=True), pane)
        assert columns is not None  # as reading alone would have taken more
        needed = capacity_class(len(columns[0]))
        if self._capacity > needed:
            with contextlib.suppress(TooLittleMemoryError):
                return self._image(columns, pane, self._capacity)
        image = self._image(columns, pane, needed)
        self._capacity = max(self._capacity, needed)
        return image

    def _image(self, columns: Columns, pane: Pane, capacity: int) -> Image:
        self._require(self.bytes(capacity, pane), pane)
        particles = self._on_disk.particles(columns, capacity)
        asked, run = Request.of(Scene(particles=particles, transfer=self._transfer), self._camera, self._settings), Eager()
        shape = dataclasses.replace(self._shape, num_particles=capacity)
        seen = _within(see(asked.scene, asked.camera, shape, run), pane)
        seen, of_all = demanded(seen, asked, shape, self._demand.choices)
        demand = of_all.of_rows(pane.top // TILE, -(-pane.bottom // TILE))
        self._require(self._with_read(demand), pane)
        plan = self._plan_for(demand)
        run.mark("plan")
        frame = Frame(seen, asked.camera, self._settings, plan, asked.scene.formulas, pane.top)
        image = image_of(frame.drawn(run), frame, run)
        return cut(asked.in_given_unit(image), pane.left, pane.right, 1)

    def _plan_for(self, demand: Demand) -> Plan:
        """The plan there is, if it serves; else one with room for more like this if memory allows."""
        key = demand.height, demand.num_particles
        kept = self._plans.get(key)
        if kept is None or not kept.serves(demand.in_bands(kept.bands, kept.cast.batch_slabs)):
            limit = min(self._limit, self._memory - READ_BYTES * demand.num_particles)
            kept = fit(demand, roomy=demand.shaped(headroom=CROWDED), limit=limit)
        self._plans[key] = kept
        return kept


def _within(seen: Seen, pane: Pane) -> Seen:
    """What is seen, with no particle touching any pixel out of a pane."""
    ends = zip(SIDES, (np.maximum, np.minimum) * 2, (pane.left, pane.right - 1, pane.top, pane.bottom - 1), strict=True)
    inside = {side: array_of(clipped(np.asarray(getattr(seen.viewed, side)), end)) for side, clipped, end in ends}
    return seen._replace(viewed=dataclasses.replace(seen.viewed, **inside))
