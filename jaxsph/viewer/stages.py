"""Pictures of a view, from a rough one at once to the one that was asked for; each stage keeps its plans.

Flow: Scene, Camera of the newest state -> [stages: Image -> Picture, with what it is in words] -> server, widget.

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
import functools
import io
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.analysis.visibility import visibility_histogram
from jaxsph.engine.planning.fit import plan
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.render import render
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image, png_of
from jaxsph.model.particles.field import ParticleField
from jaxsph.model.particles.particles import Particles, capacity_class
from jaxsph.model.scene import Scene, widened
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.maps import Scale
from jaxsph.numerics.faults import CapacityError
from jaxsph.viewer.control_points import everywhere, is_flat
from jaxsph.viewer.pose import Pose
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
JPEG_QUALITY = 85
OF_SURFACE = {DRAFT: "surface where samples see it, thin parts are missed", FULL: "surface to rounding, thin parts may be missed"}
RAYS, BINS = 300, 64  # of a histogram: a quarter of a second
ON_SURFACE = 0.01
"""Of its level, what the coverage may be off where a place is one of the surface, and not of what is in front of it."""


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
        self._few: tuple[Any, ...] = None, None
        self._bands = 1 if name == DRAFT or settings.tolerance is not None or settings.screen != "pixels" else BANDS

    def camera(self, camera: Camera) -> Camera:
        """The camera with the pixels of this stage."""
        width, height = (max(1, round(side / self.shrink)) for side in (camera.width, camera.height))
        return dataclasses.replace(camera, width=width, height=height)

    def shown(self, scene: Scene) -> Scene:
        """The scene with the particles of this stage, and a surface as it needs it."""
        if self.name != DRAFT or scene.particles is None:
            return scene
        surface = scene.surface and dataclasses.replace(scene.surface, exact=False, antialias=1, occlusion=None)
        how = (MOST,) if surface is None else (MOST_OF_SURFACE, float(surface.smoothing))
        if self._few[0] is not scene.particles or self._few[1] != how:
            self._few = scene.particles, how, fewer(scene.particles, *how)
        return dataclasses.replace(scene, particles=self._few[2], surface=surface)

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

        try:
            return render(scene, camera, self.settings, plan=made, progress=leave)
        except CapacityError:
            return render(scene, camera, self.settings, plan=self._planned(scene, camera), progress=leave)

    def _planned(self, scene: Scene, camera: Camera) -> Plan:
        """A kept plan with room for a picture, or one that is grown from it."""
        needed = plan(scene, camera, self.settings, bands=self._bands)
        key = None if self.name == DRAFT else needed.chosen
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


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A picture of a view.

    Attributes:
        version: of the state that it shows: states are counted.
        stage: `"draft"`, `"full"` or `"tolerance"`.
        words: what it is, for people.
        final: whether nothing better will come of this state.
        image, scene, camera: what it is, and what it was made of.
        settings, pose: likewise.
        facts: numbers for the page: `size` of the full picture, `error`, `rays_left`, `milliseconds`.
    """

    version: int
    stage: str
    words: str
    final: bool
    image: Image
    scene: Scene
    camera: Camera
    settings: Settings
    pose: Pose
    facts: dict[str, Any]

    @property
    def rank(self) -> tuple[int, int]:
        """By which pictures are ordered: of a newer state, then by a better stage."""
        return self.version, (DRAFT, FULL, TOLERANCE).index(self.stage)

    @property
    def format(self) -> str:
        """JPEG while things move, PNG once they stand."""
        return "jpeg" if self.stage == DRAFT else "png"

    @functools.cached_property
    def encoded(self) -> bytes:
        """The picture's file."""
        picture = self.image.to_uint8()
        if self.format == "png":
            return png_of(picture)
        from PIL import Image as Pillow

        buffer = io.BytesIO()
        Pillow.fromarray(picture).save(buffer, format="JPEG", quality=JPEG_QUALITY)
        return buffer.getvalue()

    def header(self) -> dict[str, Any]:
        """What goes before the picture, as JSON has it."""
        height, width = self.image.shape
        own = {name: getattr(self, name) for name in ("version", "stage", "words", "final", "format")}
        return {"is": "picture", **own, "width": width, "height": height, "tangent": self.pose.tangent, **self.facts}

    def pixel(self, right: float, down: float) -> tuple[int, int] | None:
        """Row and column at a place in shares of the picture's height from its middle; None outside."""
        height, width = self.image.shape
        row, column = int(np.floor((down + 0.5) * height)), int(np.floor(right * height + width / 2))
        return (row, column) if 0 <= row < height and 0 <= column < width else None

    def seen(self, right: float, down: float) -> np.ndarray | None:
        """(3,) where light is half absorbed on the ray there, length units; None where it never is."""
        found = self.pixel(right, down)
        return None if found is None or not np.isfinite(self.depth[found]) else self.places(*found)

    def told(self, right: float, down: float) -> dict[str, Any]:
        """Numbers of the pixel there, as JSON has them: what is not known is left out."""
        found, place, image = self.pixel(right, down), self.seen(right, down), self.image
        if found is None:
            return {"text": "outside of the picture"}
        told: dict[str, Any] = {"row": found[0], "column": found[1], "of": list(image.shape), "stage": self.stage}
        told["color"] = np.asarray(image.color)[found].tolist()
        told["transmittance"] = float(np.asarray(image.transmittance)[found])
        if self.settings.tolerance is not None:
            told["error"] = _plain(np.asarray(image.error_bound)[found])
        if self.scene.surface is not None:
            told["surface"] = True
        if place is None:
            return told
        told |= {"depth": float(self.depth[found]), "place": place.tolist()}
        if (particles := widened(self.scene).particles) is not None:
            there = ParticleField(particles).at(place[None])
            told |= {"quantity": _plain(there.quantity[0]), "neighbours": int(there.number[0])}
            surface = self.scene.surface
            if surface is not None and abs(there.coverage[0] / float(surface.level) - 1) < ON_SURFACE:
                told["normal"] = there.normal[0].tolist()
        return told

    @property
    def depth(self) -> np.ndarray:
        """(H, W), see `Image.depth`."""
        return np.asarray(self.image.depth)

    def places(self, rows: Any, columns: Any) -> np.ndarray:
        """(..., 3) where rays of pixels have lost half of their light."""
        height, width = self.image.shape
        right, down = (columns + 0.5 - width / 2) / height, (rows + 0.5) / height - 0.5
        return self.pose.places(right, down, self.depth[rows, columns].astype(np.float64))


def described(stage: Stage, image: Image, scene: Scene, camera: Camera, seconds: float) -> tuple[str, dict[str, Any]]:
    """What a picture is in words, and as numbers: the words say how wrong it is, or that nobody knows."""
    settings, (height, width) = stage.settings, image.shape
    left = camera.width * camera.height - height * width
    bound = np.nan_to_num(np.asarray(image.error_bound, np.float64), nan=0.0, neginf=0.0, posinf=1.0)
    facts: dict[str, Any] = {"rays_left": left, "milliseconds": round(1000 * seconds), "error": None}
    facts["size"] = [camera.width, camera.height]
    if settings.tolerance is None:
        error = "error not estimated" if scene.surface is None else OF_SURFACE[stage.name]
        words = f"{stage.name}: {width} x {height}, {settings.samples} samples a ray; {error}"
        few = scene.particle_set.num_particles - stage.shown(scene).particle_set.num_particles
        particles = f", and {few:,} particles" if few else ""
        return f"{words}; {left:,} rays left{particles}" if stage.name == DRAFT else words, facts
    facts["error"] = largest = float(bound.max(initial=0))
    facts["over"] = over = int((bound > settings.tolerance).sum())
    how = "certified" if bool(image.certified) else "estimated"
    against = "the light integral" if settings.integrator_used == "segments" else f"{settings.samples} samples a ray"
    if over:
        return f"tolerance {settings.tolerance:g} not met in {over:,} pixels, error up to {largest:.2g} ({how})", facts
    return f"tolerance {settings.tolerance:g} met, error at most {largest:.2g} ({how}, against {against})", facts


def histogram_of(scene: Scene, camera: Camera, scale: Scale, picture: Picture | None = None) -> dict[str, Any] | None:
    """What rays meet by place on an axis, as JSON has it: path length, and light absorbed; each over its largest.

    Of a surface it is where rays of a picture meet it: both are one. None of media that have no quantity.
    """
    if scene.media or not scene.looks:
        return None
    if scene.surface is not None:
        return None if picture is None or not is_flat(scene) else _of_surface(scene, scale, picture)
    found = visibility_histogram(scene, camera, rays=RAYS, bins=BINS)
    places = np.clip(np.nan_to_num(scale.place(found.edges), neginf=-1.0, posinf=2.0), -1, 2)
    bars = {name: _shares(getattr(found, name)) for name in ("there", "absorbed")}
    return {"edges": places.tolist(), **bars, "rays": found.rays}


def _of_surface(scene: Scene, scale: Scale, picture: Picture) -> dict[str, Any]:
    """Of the quantity where some rays of a picture meet a surface."""
    depth, particles = picture.depth, widened(scene).particles
    assert particles is not None
    chosen = np.random.default_rng(0).choice(depth.size, min(RAYS, depth.size), replace=False)
    met = picture.places(*np.unravel_index(chosen[np.isfinite(depth.ravel()[chosen])], depth.shape))
    quantity = ParticleField(particles).at(met).quantity
    place = np.clip(scale.place(quantity[np.isfinite(quantity)]), -1, 2)
    counts, edges = np.histogram(place, BINS, (min(0.0, place.min(initial=0)), max(1.0, place.max(initial=1))))
    shares = _shares(counts.astype(np.float64))
    return {"edges": edges.tolist(), "there": shares, "absorbed": shares, "rays": len(chosen)}


def _shares(values: np.ndarray) -> list[float]:
    largest = float(values.max(initial=0))
    return (values / largest).tolist() if largest > 0 else np.zeros(len(values)).tolist()


def _plain(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
