"""Pictures of snapshots that are larger than memory: each pane of the image has the particles that its rays can meet, no others.

Flow: OnDisk, camera -> panes -> runs that they can see -> particles -> view -> [from_disk] -> panes of pixels -> Image.

All rays of a pane find what they would find among all particles, in the same order. Two things of a picture depend on
particles elsewhere, too: classes of supports on the widest, strengths on the strongest. Those two come along with every pane. So
pixels are the same bits as those of the whole in memory, if what is chosen by how large supports appear, of a sample here, is
chosen alike; where supports reach around the eye or across near and far, they are so to rounding.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np

from jaxsph.engine.access.lists import TILE
from jaxsph.engine.frame.bands import Progress, Work
from jaxsph.engine.planning.fit import MAX_CLASSES, measured, see, shape_of, sorted_and_measured
from jaxsph.engine.planning.measures import Measures
from jaxsph.engine.planning.plan import Choices, FrameShape, Plan, bytes_of, choose, fitting, in_bands, smallest
from jaxsph.engine.planning.viewing import Seen
from jaxsph.engine.request import Request
from jaxsph.engine.runtime import free_memory
from jaxsph.engine.runtime.executors import Clock
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.frusta import seen_by
from jaxsph.model.image import Image
from jaxsph.model.particles.particles import capacity_class
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.scale.on_disk import MOST_EXTREMES, Columns, OnDisk
from jaxsph.scale.panes import CROWDED, Crowd, Need, Pane, Sides, cut_to_fit
from jaxsph.scale.parts import joined, of_columns, of_rows

MEMORY = 1 << 30
READ_BYTES, BYTES_A_PARTICLE = 96, 430
"""Of a particle of a pane: of columns that are read, with those of the next pane; and in all, as a first guess."""
LEAST = f"{TILE} x {TILE} pixels", f"{TILE} rows of pixels"
"""The least pane, and the least from one side of the image to the other."""
FRAME_SHARE = 0.2
"""Of the memory, that a frame is guessed to take whatever its particles."""


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
    panes = renderer.panes()  # the fullest first: where the plan has room for it, it has for most
    todo, images, most = deque(panes), dict[Pane, Image](), 0
    with free_memory.given_back_at_once(), _Reader(on_disk, camera, memory // READ_BYTES) as reader:
        while todo:
            pane = todo.popleft()
            columns = reader.columns(pane, todo[0] if todo else None)
            image = None if columns is None else renderer.pane(columns, pane)
            if image is None:
                todo.extendleft(reversed(renderer.halves(pane)))
                continue
            assert columns is not None
            images[pane], most = image, max(most, len(columns[0]))
            del columns
            free_memory.give_back()
            if progress is not None:
                progress(len(images), len(images) + len(todo))
    image = _rows_of([_cut_image(pane, images, renderer.whole_rows) for pane in sorted(panes)], sorted(panes))
    return dataclasses.replace(image, stats=image.stats | {"panes": len(images), "most_particles": most})


def _cut_image(pane: Pane, images: dict[Pane, Image], whole_rows: bool) -> Image:
    """The image of a pane, of its halves where it was cut."""
    if pane in images:
        return images[pane]
    axis, halves = pane.halves(whole_rows)
    return joined([_cut_image(half, images, whole_rows) for half in halves], axis=axis)


def _rows_of(images: list[Image], panes: list[Pane]) -> Image:
    """The image that panes make, in the order of their rows and columns."""
    rows = itertools.groupby(zip(panes, images, strict=True), lambda one: one[0].top)
    return joined([joined([image for _, image in row], axis=1) for _, row in rows])


class _Reader:
    """Reads the particles of a pane while another is rendered; None of panes with more than `most`."""

    def __init__(self, on_disk: OnDisk, camera: Camera, most: int) -> None:
        self._on_disk, self._camera, self._most = on_disk, camera, most
        self._always = on_disk.extremes(camera)
        self._ahead: dict[Pane, Future[Columns | None]] = {}
        self._thread = ThreadPoolExecutor(1, "jaxsph-read")

    def __enter__(self) -> _Reader:
        return self

    def __exit__(self, *error: object) -> None:
        self._thread.shutdown()

    def columns(self, pane: Pane, then: Pane | None) -> Columns | None:
        """The particles of a pane; those of the next are begun to be read, unless others are read ahead already."""
        columns = self._begun(pane).result()
        if then is not None and not self._ahead:
            self._ahead[then] = self._begun(then)
        return columns

    def _begun(self, pane: Pane) -> Future[Columns | None]:
        begun = self._ahead.pop(pane, None)
        return begun or self._thread.submit(self._on_disk.seen_by, seen_by(self._camera, *pane), self._always, self._most)


@dataclasses.dataclass
class _Renderer:
    """Panes of one picture, with one plan that grows where it has to."""

    on_disk: OnDisk
    transfer: TransferFunction
    camera: Camera
    settings: Settings
    memory: int
    capacity: int = 1
    plans: dict[tuple[int, int], Plan] = dataclasses.field(default_factory=dict)
    """By rows of pixels and entries of particle arrays."""

    @property
    def whole_rows(self) -> bool:
        """Whether panes reach from side to side: the pilot's lattice reaches from bundle to bundle."""
        return self._asked.along.estimator == "pilot"

    def panes(self) -> list[Pane]:
        """As few as memory allows, as far as the sample tells.

        Raises:
            TooLittleMemoryError: the least pane needs more.
        """
        seen, there = self._sample.viewed, np.asarray(self.on_disk.sample.valid)
        sides = Sides(*(np.asarray(side)[: len(there)][there] for side in (seen.left, seen.right, seen.top, seen.bottom)))
        room = int((1 - FRAME_SHARE) * self.memory) // BYTES_A_PARTICLE
        size = self.camera.height, self.camera.width
        found, fit = cut_to_fit(size, sides, len(self.on_disk), room, self._fits, whole_rows=self.whole_rows)
        if not fit:
            self._require_least()
        return list(found)

    def halves(self, pane: Pane) -> list[Pane]:
        """Of a pane that needs more than there is.

        Raises:
            TooLittleMemoryError: it cannot be cut.
        """
        halves = pane.halves(self.whole_rows)[1]
        if not halves:
            self._require_least()
            raise AssertionError(f"{pane} fits by counting, but not by its plan")
        return halves

    def _require_least(self) -> None:
        """Raise where the least panes do not fit: all particles are read once, to count them."""
        crowd = Crowd(self.camera, self.on_disk.index.bounds())
        for position, support, *_ in self.on_disk.all_seen_by(seen_by(self.camera, 0, self.camera.height, 0, self.camera.width)):
            crowd.count(position, support)
        need = crowd.fullest(self.whole_rows)
        need = need._replace(particles=need.particles + MOST_EXTREMES)
        frame = self._smallest(need).bytes
        given = {"memory": (self.memory, frame + self._read_bytes(need)), "settings.memory_limit": (self._limit, frame)}
        for name, (allowed, least) in given.items():
            if allowed < least:
                why = f"{LEAST[self.whole_rows]} see up to {need.particles:,} particles"
                raise TooLittleMemoryError(name, allowed, least, why)

    @property
    def _limit(self) -> int:
        """Of a frame, whatever is read."""
        return self.settings.memory_limit or self.memory

    def _fits(self, need: Need) -> float:
        """How many times what is needed there is, in bands of one row of tiles and least batches."""
        least = self._smallest(need)
        return min(self.memory / (least.bytes + self._read_bytes(need)), self._limit / least.bytes)

    def _read_bytes(self, need: Need) -> int:
        return READ_BYTES * capacity_class(need.particles)

    def _smallest(self, need: Need) -> Plan:
        """The plan that takes least of all."""
        tile_rows, tile_columns = -(-need.height // TILE), -(-self.camera.width // TILE)
        tiles, bundles = (np.full(tile_rows, count) for count in (need.tile_pairs, need.bundle_pairs))
        measures = Measures(tiles, bundles, 2 * tile_rows, 2 * tile_columns, math.nan, math.nan)
        shape = self._shape_of(self._shape, need.height, capacity_class(need.particles))
        return smallest(measures, shape, self._asked.along, self._choices)

    def _shape_of(self, shape: FrameShape, height: int, capacity: int) -> FrameShape:
        return dataclasses.replace(shape, height=height, num_particles=capacity, num_classes=self._classes, headroom=1.0)

    def pane(self, columns: Columns, pane: Pane) -> Image | None:
        """The image of some pixels; None where it needs more memory than there is."""
        needed = capacity_class(len(columns[0]))
        for capacity in dict.fromkeys((max(self.capacity, needed), needed)):
            if self._fits(Need(capacity, 1, 1, pane.bottom - pane.top)) < 1:
                continue
            image = self._image(columns, pane, capacity)
            if image is not None:
                self.capacity = max(self.capacity, capacity)
                return image
        return None

    def _image(self, columns: Columns, pane: Pane, capacity: int) -> Image | None:
        particles = self.on_disk.particles(columns, capacity)
        asked, clock = Request.of(Scene(particles=particles, transfer=self.transfer), self.camera, self.settings), Clock()
        shape = self._shape_of(shape_of(asked), self.camera.height, capacity)
        seen = _within(see(asked.scene, asked.camera, shape, clock), pane)
        seen, measures = sorted_and_measured(seen, asked, shape)
        rows = dataclasses.replace(shape, height=pane.bottom - pane.top)
        plan = self._plan_for(of_rows(measures, pane.top // TILE, -(-pane.bottom // TILE)), rows)
        clock.mark("plan")
        if plan is None:
            return None
        image = Work(seen, asked.camera, self.settings, plan, asked.scene.formulas, pane.top).image(clock)
        return of_columns(asked.in_given_unit(image), pane.left, pane.right)

    def _plan_for(self, needed: Measures, shape: FrameShape) -> Plan | None:
        """The plan there is, if it serves; else with room for more like this if memory allows; None where it allows none."""
        limit = min(self._limit, self.memory - READ_BYTES * shape.num_particles)
        given, roomy = (self._asked.along, self._choices), dataclasses.replace(shape, headroom=CROWDED)
        kept = self.plans.get((shape.height, shape.num_particles))
        if kept is not None:
            sizes = kept.bands, kept.cast.batch_slabs
            if kept.serves(in_bands(needed, shape, *given, *sizes)):
                return kept
            grown = kept.grown(in_bands(needed, roomy, *given, *sizes))
            kept = dataclasses.replace(grown, bytes=bytes_of(grown, shape.number))
        if kept is not None and kept.bytes <= limit:
            made: Plan | None = kept
        else:
            made = fitting(needed, roomy, *given, limit) or fitting(needed, shape, *given, limit)
        if made is not None:
            self.plans[shape.height, shape.num_particles] = made
        return made

    @functools.cached_property
    def _classes(self) -> int:
        """Of supports, as the whole snapshot has them: `planning` counts octaves."""
        support = self.on_disk.index.support
        if not support.size:
            return 1
        octaves = np.log2(support.max() / self.on_disk.index.least.min())
        return int(min(2 + np.ceil(max(octaves, 0)), MAX_CLASSES))

    @functools.cached_property
    def _asked(self) -> Request:
        """Of the sample, with the supports of all particles."""
        sample = self.on_disk.sample
        thinned = np.cbrt(max(sample.num_particles, 1) / max(len(self.on_disk), 1))
        true = dataclasses.replace(sample, support=sample.support * sample.dtype.type(thinned))
        return Request.of(Scene(particles=true, transfer=self.transfer), self.camera, self.settings)

    @functools.cached_property
    def _shape(self) -> FrameShape:
        return shape_of(self._asked)

    @functools.cached_property
    def _sample(self) -> Seen:
        return see(self._asked.scene, self._asked.camera, self._shape, Clock())

    @functools.cached_property
    def _choices(self) -> Choices:
        """By how large supports of the sample appear."""
        return choose(measured(self._sample, self._asked, self._shape), self._asked.along)


def _within(seen: Seen, pane: Pane) -> Seen:
    """What is seen, with no particle touching any pixel out of a pane."""
    viewed = seen.viewed
    left, right = jnp.maximum(viewed.left, pane.left), jnp.minimum(viewed.right, pane.right - 1)
    top, bottom = jnp.maximum(viewed.top, pane.top), jnp.minimum(viewed.bottom, pane.bottom - 1)
    return seen._replace(viewed=dataclasses.replace(viewed, left=left, right=right, top=top, bottom=bottom))
