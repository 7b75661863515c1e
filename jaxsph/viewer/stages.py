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
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.engine.planning.fit import plan
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.render import render
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import array_of, product
from jaxsph.numerics.faults import CapacityError
from jaxsph.viewer.control_points import everywhere
from jaxsph.viewer.state import State

DRAFT_PIXELS = 50_000
"""Most pixels of a draft: on two cores one of 40,000 particles takes a tenth of a second."""
MOST = 40_000
"""Particles of a draft, such that what is done once a particle takes a fraction of a tenth of a second on two cores."""
DRAFT_SAMPLES = 4
"""Samples of a picture over those of its draft."""
BANDS = 4
"""A full picture is made in so many, so that it can be left between them; not one for a tolerance, in which they have a say."""
HEADROOM = 1.5
DRAFT, FULL, TOLERANCE = "draft", "full", "tolerance"
DEFAULT = Settings(tolerance=0.01)
"""Of a view that was asked for nothing else: an error that is told, against the light integral."""


def default_of(scene: Scene) -> Settings:
    """Of a view of a scene that was asked for nothing else: a surface of particles has no tolerance."""
    return DEFAULT if scene.surface is None else Settings()


def fewer(particles: Particles) -> Particles:
    """At most `MOST` of the particles, or the very set.

    Each of them stands for several: its volume is theirs, and its support as much longer as distances are now, so that sums over
    kernels stay what they were on average. In a periodic set no support becomes longer than the longest.
    """
    entries = np.flatnonzero(np.asarray(particles.valid))
    if len(entries) <= MOST:
        return particles
    ratio = len(entries) / MOST
    kept = particles.at(np.sort(np.random.default_rng(0).permutation(entries)[:MOST]))
    support = product(kept.support, ratio ** (1 / 3))
    if particles.box is not None:
        support = array_of(np.minimum(np.asarray(particles.support).max(), support))
    return dataclasses.replace(kept, support=support, volume=product(kept.volume, np.asarray(ratio, kept.volume.dtype)))


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
        self._bands = 1 if name == DRAFT or settings.tolerance is not None or settings.screen != "pixels" else BANDS

    def camera(self, camera: Camera) -> Camera:
        """The camera with the pixels of this stage."""
        if self.shrink == 1:
            return camera
        width, height = (max(1, round(side / self.shrink)) for side in (camera.width, camera.height))
        return dataclasses.replace(camera, width=width, height=height)

    def shown(self, scene: Scene) -> Scene:
        """The scene with the particles of this stage."""
        if self.name != DRAFT or scene.particles is None:
            return scene
        if self._few[0] is not scene.particles:
            self._few = scene.particles, fewer(scene.particles)
        return dataclasses.replace(scene, particles=self._few[1])

    def image(self, state: State, stop: Callable[[], bool]) -> Image:
        """The picture; with the first, room is made for views around.

        Raises:
            Abandoned: `stop()` has become true between two bands.
            ValueError: what `jaxsph.render` raises it for.
        """
        scene, camera = self.shown(state.scene), self.camera(state.camera)
        if not self._plans:
            around = [] if scene.media else state.pose.around(camera.width, camera.height)  # media do not say how large they are
            for one in (camera, *around):
                self._planned(everywhere(scene), one)
        made = self._plans[None] if self.name == DRAFT else self._planned(scene, camera)

        def leave(done: int, bands: int) -> None:
            if done < bands and stop():
                raise Abandoned

        while True:
            try:
                return render(scene, camera, self.settings, plan=made, progress=leave)
            except CapacityError:
                small, made = made, self._planned(scene, camera)
                if made == small:
                    raise

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
