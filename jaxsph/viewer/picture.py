"""A picture with what it is in words, as bytes for a page; what a place of it is in numbers, and what all its rays meet.

Flow: Image of a stage -> [picture] -> header and JPEG, or PNG of what stands still; numbers -> server, widget.
"""

from __future__ import annotations

import dataclasses
import functools
import io
from typing import Any

import numpy as np

from jaxsph.analysis.visibility import visibility_histogram
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image, png_of
from jaxsph.model.particles.field import ParticleField
from jaxsph.model.scene import Scene, widened
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.maps import Scale
from jaxsph.viewer.control_points import is_flat
from jaxsph.viewer.pose import Pose
from jaxsph.viewer.stages import DRAFT, FULL, TOLERANCE, Stage

JPEG_QUALITY = 85
OF_SURFACE = {DRAFT: "surface where samples see it, thin parts are missed", FULL: "surface to rounding, thin parts may be missed"}
RAYS, BINS = 300, 64  # of a histogram: a quarter of a second
ON_SURFACE = 0.01
"""Of its level, what the coverage may be off where a place is one of the surface, and not of what is in front of it."""


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
