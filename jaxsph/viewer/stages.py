"""Pictures of a view, from a rough one at once to the one that was asked for; each stage keeps its plans.

Flow: Scene, Camera of the newest state -> [stages] -> Image, and what it is in words.

| stage | pixels | settings |
|---|---|---|
| draft | a fraction | a quarter of the samples, no tolerance; of fewer particles where there are many |
| full | all | point samples, no tolerance: the bits of `jaxsph.render` |
| tolerance | all | those that were asked for, where they hold a tolerance |

A plan is made with room for views to come, of a scene of which no look hides anything, and grows when it is too small: only then
is anything compiled. What is chosen by how large supports appear has plans of its own, as it has a say in the picture's bits.
"""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.engine.planning.fit import plan
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.render import render
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.particles.particles import Particles, capacity_class
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.faults import CapacityError
from jaxsph.viewer.control_points import everywhere, is_flat
from jaxsph.viewer.state import State

DRAFT_PIXELS = 50_000
"""Most pixels of a draft: on two cores one of 40,000 particles takes a tenth of a second."""
MOST, MOST_OF_SURFACE = 40_000, 10_000
"""Particles of a draft, such that what is done once a particle takes a fraction of a tenth of a second on two cores."""
MIXED = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0x27D4EB2F165667C5], np.uint64)
"""Odd numbers, by which cubes get one key each."""
DRAFT_SAMPLES = 4
"""Samples of a picture over those of its draft."""
BANDS = 4
"""A full picture is made in so many, so that it can be left between them; not one for a tolerance, in which they have a say."""
HEADROOM = 1.5
DRAFT, FULL, TOLERANCE = "draft", "full", "tolerance"
DEFAULT = Settings(tolerance=0.01)
"""Of a view that was asked for nothing else: an error that is told, against the light integral; of surfaces none is known."""


def fewer(particles: Particles, most: int, smoothing: float = 1.0) -> Particles:
    """At most so many particles, or the very set.

    Those in one cube, whose side is a share of their supports, become one at their middle that has their volume, and their mean
    quantities by volume. Its support is as much longer as distances are, but for what a surface's `smoothing` makes of it: so
    sums over kernels stay what they were on average, and surfaces closed. One that is alone stays as it is. In a periodic set no
    support becomes longer than the longest.
    """
    entries = np.flatnonzero(np.asarray(particles.valid))
    if len(entries) <= most:
        return particles
    columns = particles.exact_position(), particles.volume, particles.support, *particles.quantities
    position, volume, support, *quantities = (np.asarray(one, np.float64)[entries] for one in columns)
    octave, number = np.floor(np.log2(support)), len(entries)
    side = 0.5 * np.exp2(octave)[:, None]
    while number > most:
        cubes = np.column_stack([np.floor(position / side), octave]).astype(np.int64).astype(np.uint64) @ MIXED
        _, cube, counts = np.unique(cubes, return_inverse=True, return_counts=True)
        number, side = len(counts), side * 2 ** (1 / 3)
    total, longest = np.bincount(cube, volume), support.max() if particles.box is not None else np.inf
    weight = np.where(total[cube] > 0, volume, 1)
    x, y, z, support, *quantities = (
        np.bincount(cube, weight * one) / np.bincount(cube, weight) for one in (*position.T, support, *quantities)
    )
    support = np.minimum(support * np.maximum(1, counts ** (1 / 3) / max(smoothing, 1.0)), longest)
    place = np.stack([x, y, z], 1).astype(particles.dtype if particles.position_rest is None else np.float64)
    quantity, capacity = quantities if len(quantities) > 1 else quantities[0], min(capacity_class(most), particles.capacity)
    return Particles.from_arrays(place, support, quantity, total, particles.kernel, capacity=capacity, box=particles.box)


class Abandoned(Exception):
    """There is something newer to be shown."""


class Stage:
    """One way to make the picture, and its plans.

    Attributes:
        name: of the stage.
        shrink: pixels of the picture over those of the stage, along each side.
        settings: of the stage.
    """

    def __init__(self, name: str, settings: Settings, shrink: int = 1) -> None:
        self.name, self.settings, self.shrink = name, settings, shrink
        self._plans: dict[Any, Plan] = {}
        self._few: tuple[Any, Any] = None, None
        self._met: tuple[Any, Any] = (None,), None
        self._bands = 1 if name == DRAFT or settings.tolerance is not None or settings.screen != "pixels" else BANDS

    def camera(self, camera: Camera) -> Camera:
        """The camera with the pixels of this stage."""
        width, height = (max(1, round(side / self.shrink)) for side in (camera.width, camera.height))
        return dataclasses.replace(camera, width=width, height=height)

    def shown(self, scene: Scene) -> Scene:
        """The scene with the particles of this stage, and a surface as it needs it."""
        if self.name != DRAFT or scene.particles is None:
            return scene
        surface = scene.surface and dataclasses.replace(scene.surface, exact=False)
        if self._few[0] is not scene.particles:
            how = (MOST,) if surface is None else (MOST_OF_SURFACE, float(surface.smoothing))
            self._few = scene.particles, fewer(scene.particles, *how)
        return dataclasses.replace(scene, particles=self._few[1], surface=surface)

    def image(self, state: State, stop: Callable[[], bool]) -> Image:
        """The picture; with the first, room is made for views around.

        In a draft of a surface alone rays tell what they meet, and where nothing but its look differs that is coloured anew.

        Raises:
            Abandoned: `stop()` has become true between two bands.
            ValueError: what `jaxsph.render` raises it for.
        """
        scene, look = self.shown(state.scene), state.look
        if self.name != DRAFT or look is None or not is_flat(scene) or len(scene.parts) > 1 or scene.media:
            return self._rendered(state, scene, stop)
        seen = state.base, state.given, state.pose, state.moved, state.cut
        if not all(map(operator.is_, seen, self._met[0])):
            self._met = seen, self._rendered(state, look.by_place(scene), stop)
        return look.coloured(self._met[1])

    def _rendered(self, state: State, scene: Scene, stop: Callable[[], bool]) -> Image:
        """The picture of a scene that is shown."""
        camera = self.camera(state.camera)
        if not self._plans:
            around = [] if scene.media else state.pose.around(camera.width, camera.height)  # media do not say how large they are
            for one in (camera, *around):
                self._planned(everywhere(scene), one)
        made = self._plans[None] if self.name == DRAFT else self._planned(scene, camera)

        def leave(done: int, bands: int) -> None:
            if done < bands and stop():
                raise Abandoned

        try:
            return render(scene, camera, self.settings, plan=made, progress=leave)
        except CapacityError:
            return render(scene, camera, self.settings, plan=self._planned(scene, camera), progress=leave)

    def _planned(self, scene: Scene, camera: Camera) -> Plan:
        """A kept plan with room for a picture, or one that is grown from it."""
        needed = plan(scene, camera, self.settings, bands=self._bands)
        key = None if self.name == DRAFT else needed.choices
        kept = self._plans.get(key)
        if kept is None or not kept.serves(needed):
            kept = plan(scene, camera, self.settings, like=kept, headroom=HEADROOM, bands=self._bands)
            self._plans[key] = kept
        return kept


def stages_of(settings: Settings, camera: Camera) -> tuple[Stage, ...]:
    """The stages of a view, the draft first."""
    shrink = max(2, int(np.ceil(np.sqrt(camera.width * camera.height / DRAFT_PIXELS))))
    plainly = dataclasses.replace(settings, tolerance=None, screen="pixels")
    if settings.is_refined:
        plainly = dataclasses.replace(plainly, integrator=None)
    rough = dataclasses.replace(plainly, samples=max(1, plainly.samples // DRAFT_SAMPLES))
    if settings.tolerance is not None or settings.screen != "pixels":
        return Stage(DRAFT, rough, shrink), Stage(FULL, plainly), Stage(TOLERANCE, settings)
    return Stage(DRAFT, rough, shrink), Stage(FULL, settings)
