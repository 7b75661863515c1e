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
from concurrent.futures import Future, ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np

from jaxsph.access.lists import TILE
from jaxsph.along_rays import along_rays
from jaxsph.field.in_octree import reachable
from jaxsph.measures import Measures
from jaxsph.model.camera import Camera
from jaxsph.model.frusta import seen_by
from jaxsph.model.image import Image
from jaxsph.model.particles import capacity_class
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics import free_memory
from jaxsph.numerics.executors import Clock
from jaxsph.on_disk import Columns, OnDisk
from jaxsph.panes import CROWDED, Pane, Sides, cut
from jaxsph.plan import Choices, FrameShape, Plan, choose, fitted, in_bands
from jaxsph.planning import MAX_CLASSES, measured, see, shape_of_scene, stride_of
from jaxsph.render import Progress, image_of
from jaxsph.tiles import joined, of_columns, of_rows
from jaxsph.viewing import Seen

MEMORY = 1 << 30
READ_BYTES, BYTES_A_PARTICLE = 96, 430
"""Of a particle of a pane: of columns that are read, with those of the next pane; and in all, with its place in lists."""
LEAST = f"{TILE} x {TILE} pixels", f"{TILE} rows of pixels"
"""The least pane, and the least from one side of the image to the other."""
FRAME_SHARE = 0.2
"""Of the memory, that a frame takes whatever its particles."""


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
    read meanwhile. A snapshot whose rows are ordered in space is read a few times, one whose are not once a pane: see
    `jaxsph.io.sort_snapshot`.

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
        ValueError: memory that does not suffice for a single tile (how much does), a screen or an integrator that
            needs all particles; as `jaxsph.render`.
    """
    settings = settings or Settings()
    if settings.screen == "quadtree":
        raise ValueError("`settings.screen` must be 'pixels' for parts of a picture: leaves of a quadtree lie across their edges")
    renderer = _Renderer(on_disk, transfer, camera, settings)
    panes = list(renderer.panes(memory))  # the fullest first: where the plan has room for it, it has for most
    always = on_disk.extremes(camera)
    planes = [seen_by(camera, *pane) for pane in panes]
    images: dict[Pane, Image] = {}
    most = 0
    with free_memory.given_back_at_once(), ThreadPoolExecutor(1, "jaxsph-read") as reader:
        ahead: Future[Columns] = reader.submit(on_disk.seen_by, planes[0], always)
        for number, pane in enumerate(panes, 1):
            columns = ahead.result()
            if number < len(panes):
                ahead = reader.submit(on_disk.seen_by, planes[number], always)
            images[pane] = renderer.pane(columns, pane)
            free_memory.give_back()
            most = max(most, len(columns[0]))
            if progress is not None:
                progress(number, len(panes))
    image = _whole(images)
    return dataclasses.replace(image, stats=image.stats | {"panes": len(panes), "most_particles": most})


def _whole(images: dict[Pane, Image]) -> Image:
    """The image that panes make."""
    rows = (list(row) for _, row in itertools.groupby(sorted(images), lambda pane: pane.top))
    return joined([joined([images[pane] for pane in row], axis=1) for row in rows])


@dataclasses.dataclass
class _Renderer:
    """Panes of one picture, with one plan that grows where it has to."""

    on_disk: OnDisk
    transfer: TransferFunction
    camera: Camera
    settings: Settings
    capacity: int = 1
    plan: Plan | None = None

    def panes(self, memory: int) -> dict[Pane, int]:
        """As few as memory allows; the frame may take what particles leave.

        Raises:
            ValueError: the least pane needs more.
        """
        seen, along = self._sample.viewed, self._along
        there = np.asarray(self.on_disk.sample.valid)
        sides = Sides(*(np.asarray(side)[: len(there)][there] for side in (seen.left, seen.right, seen.top, seen.bottom)))
        room = int((1 - FRAME_SHARE) * memory) // BYTES_A_PARTICLE
        whole_rows = along.estimator == "pilot"  # its lattice reaches from bundle to bundle
        found = cut((self.camera.height, self.camera.width), sides, len(self.on_disk), room, whole_rows=whole_rows)
        most = max(found.values())
        if most > room:
            least = int(BYTES_A_PARTICLE * most / (1 - FRAME_SHARE)) + 1
            raise ValueError(
                f"`memory` = {memory} bytes is too little: {LEAST[whole_rows]} see about {most:,} particles, "
                f"which need {least:,}; give more, or look closer"
            )
        self.capacity = capacity_class(max(most, 1))
        left = max(memory - READ_BYTES * self.capacity, 1)
        self.settings = dataclasses.replace(self.settings, memory_limit=self.settings.memory_limit or left)
        return found

    def pane(self, columns: Columns, pane: Pane) -> Image:
        """The image of some pixels."""
        self.capacity = max(self.capacity, capacity_class(len(columns[0])))
        particles = self.on_disk.particles(columns, self.capacity)
        scene = reachable(Scene(particles=particles, transfer=self.transfer), self.settings)
        along, clock = along_rays(scene, self.settings), Clock()
        shape = dataclasses.replace(shape_of_scene(scene, self.camera, along), headroom=1.0, num_classes=self._classes)
        seen = _within(see(scene, self.camera, shape, clock), pane)
        seen, measures = measured(seen, self.camera, shape.samples, shape.tuning, stride_of(along))
        rows = dataclasses.replace(shape, height=pane.bottom - pane.top)
        needed = of_rows(measures, pane.top // TILE, -(-pane.bottom // TILE))
        self.plan = self._plan_for(needed, rows, along)
        clock.mark("plan")
        given = seen, self.camera, self.settings, self.plan, scene.formulas
        image = image_of(*given, clock, None, planned=True, first_row=pane.top)
        return of_columns(image, pane.left, pane.right)

    def _plan_for(self, needed: Measures, shape: FrameShape, along: Settings) -> Plan:
        """The plan there is, if it serves; else with room for more like this, in as many bands if memory allows."""
        roomy = dataclasses.replace(shape, headroom=CROWDED)
        if self.plan is None or self.plan.height != shape.height:
            return fitted(needed, roomy, along, self._choices)
        made = in_bands(needed, shape, along, self._choices, self.plan.bands)
        if self.plan.serves(made):
            return self.plan
        if made.bytes > (along.memory_limit or shape.memory):
            return fitted(needed, shape, along, self._choices)
        return self.plan.grown(in_bands(needed, roomy, along, self._choices, self.plan.bands))

    @functools.cached_property
    def _classes(self) -> int:
        """Of supports, as the whole snapshot has them: `planning` counts octaves."""
        support = self.on_disk.index.support
        if not support.size:
            return 1
        octaves = np.log2(support.max() / self.on_disk.index.least.min())
        return int(min(2 + np.ceil(max(octaves, 0)), MAX_CLASSES))

    @functools.cached_property
    def _scene(self) -> Scene:
        """Of the sample, with the supports of all particles."""
        sample = self.on_disk.sample
        thinned = np.cbrt(max(sample.num_particles, 1) / max(len(self.on_disk), 1))
        true = dataclasses.replace(sample, support=sample.support * sample.dtype.type(thinned))
        return reachable(Scene(particles=true, transfer=self.transfer), self.settings)

    @functools.cached_property
    def _along(self) -> Settings:
        return along_rays(self._scene, self.settings)

    @functools.cached_property
    def _shape(self) -> FrameShape:
        return shape_of_scene(self._scene, self.camera, self._along)

    @functools.cached_property
    def _sample(self) -> Seen:
        return see(self._scene, self.camera, self._shape, Clock())

    @functools.cached_property
    def _choices(self) -> Choices:
        """By how large supports of the sample appear."""
        measures = measured(self._sample, self.camera, self._shape.samples, self._shape.tuning, stride_of(self._along))[1]
        return choose(measures, self._along)


def _within(seen: Seen, pane: Pane) -> Seen:
    """What is seen, with no particle touching any pixel out of a pane."""
    viewed = seen.viewed
    left, right = jnp.maximum(viewed.left, pane.left), jnp.minimum(viewed.right, pane.right - 1)
    top, bottom = jnp.maximum(viewed.top, pane.top), jnp.minimum(viewed.bottom, pane.bottom - 1)
    return seen._replace(viewed=dataclasses.replace(viewed, left=left, right=right, top=top, bottom=bottom))
