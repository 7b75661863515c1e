"""A picture: a picture with what it is in words, as bytes for a page.

Flow: Image of a stage -> [picture] -> header and JPEG, or PNG of what stands still -> server, widget.
"""

from __future__ import annotations

import dataclasses
import functools
import io
from typing import Any

import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image, png_of
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.viewer.pose import Pose
from jaxsph.viewer.stages import DRAFT, Stage

JPEG_QUALITY = 85
OF_SURFACE = "surface to rounding, thin parts may be missed"


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A picture of a view.

    Attributes:
        version: of the state that it shows: states are counted.
        stage: `"draft"`, `"full"` or `"tolerance"`.
        words: what it is, for people.
        final: whether nothing better will come of this state.
        image, scene, camera: what it is, and what it was made of.
        settings: likewise.
        pose: of the camera.
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
    def format(self) -> str:
        """JPEG while things move, PNG once they stand."""
        return "jpeg" if self.stage == DRAFT else "png"

    @functools.cached_property
    def encoded(self) -> bytes:
        """The picture's file."""
        picture = self.image.to_uint8()
        if self.format == "png":
            return png_of(picture)
        return jpeg_of(picture)

    def header(self) -> dict[str, Any]:
        """What goes before the picture, as JSON has it."""
        height, width = self.image.shape
        return {
            "is": "picture",
            "version": self.version,
            "stage": self.stage,
            "words": self.words,
            "final": self.final,
            "format": self.format,
            "width": width,
            "height": height,
            "tangent": self.pose.tangent,
            **self.facts,
        }


def jpeg_of(picture: np.ndarray) -> bytes:
    """A JPEG file of (H, W, 3) uint8."""
    from PIL import Image as Pillow

    buffer = io.BytesIO()
    Pillow.fromarray(picture).save(buffer, format="JPEG", quality=JPEG_QUALITY)
    return buffer.getvalue()


def described(stage: Stage, image: Image, scene: Scene, camera: Camera, seconds: float) -> tuple[str, dict[str, Any]]:
    """What a picture is in words, and as numbers: the words say how wrong it is, or that nobody knows."""
    settings, (height, width) = stage.settings, image.shape
    left = camera.width * camera.height - height * width
    bound = np.nan_to_num(np.asarray(image.error_bound, np.float64), nan=0.0, neginf=0.0, posinf=1.0)
    facts: dict[str, Any] = {"rays_left": left, "milliseconds": round(1000 * seconds), "error": None}
    facts["size"] = [camera.width, camera.height]
    if settings.tolerance is None:
        error = "error not estimated" if scene.surface is None else OF_SURFACE
        words = f"{width} x {height}, {settings.samples} samples a ray; {error}"
        if stage.name == DRAFT:
            return f"draft: {words}; {left:,} rays left{_particles_left(stage, scene)}", facts
        return f"full: {words}", facts
    facts["error"] = largest = float(bound.max(initial=0))
    facts["over"] = over = int((bound > settings.tolerance).sum())
    how = "certified" if bool(image.certified) else "estimated"
    against = "the light integral" if settings.integrator_used == "segments" else f"{settings.samples} samples a ray"
    if over:
        return f"tolerance {settings.tolerance:g} not met in {over:,} pixels, error up to {largest:.2g} ({how})", facts
    return f"tolerance {settings.tolerance:g} met, error at most {largest:.2g} ({how}, against {against})", facts


def _particles_left(stage: Stage, scene: Scene) -> str:
    """Of a draft of many particles, how many it leaves out."""
    if scene.particles is None:
        return ""
    left = scene.particles.num_particles - stage.shown(scene).particle_set.num_particles
    return f", and {left:,} particles" if left else ""
