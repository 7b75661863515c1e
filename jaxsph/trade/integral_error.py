"""How far images are from the light integral, at random pixels of a frame.

Flow: scene, camera -> reference -> [integral_error] -> sweep.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsph.model import Camera, Image, Scene
from jaxsph.reference import integral

SEED = 0
TOLERANCE = 1e-6  # of the integral itself: far below any tolerance that images are asked for


@dataclasses.dataclass(frozen=True)
class IntegralAt:
    """The light integral at some pixels: colour and alpha, float64."""

    rows: Int[np.ndarray, " pixels"]
    columns: Int[np.ndarray, " pixels"]
    light: Float[np.ndarray, "pixels 4"]

    @classmethod
    def of(cls, scene: Scene, camera: Camera, count: int) -> IntegralAt | None:
        """At so many pixels of the whole image, always the same of one size; None of no pixels, or of `media` unknown to it."""
        if not count or scene.media:
            return None
        number = camera.width * camera.height
        chosen = np.random.default_rng(SEED).choice(number, min(count, number), replace=False)
        rows, columns = np.unravel_index(chosen, (camera.height, camera.width))
        return cls(rows, columns, layers_of(integral(scene, camera, pixels=(rows, columns), tolerance=TOLERANCE)))

    def at(self, layer: Any) -> np.ndarray:
        """A layer of an image at these pixels."""
        return np.asarray(layer)[self.rows, self.columns]

    def errors(self, layers: Float[np.ndarray, "height width 4"]) -> Float[np.ndarray, " pixels"]:
        """Of each pixel, the largest of any colour channel or alpha."""
        return np.abs(self.at(layers) - self.light).max(-1)


def layers_of(image: Image) -> Float[np.ndarray, "... 4"]:
    """Colour and alpha, float64."""
    alpha = 1 - np.asarray(image.transmittance, np.float64)
    return np.concatenate([np.asarray(image.color, np.float64), alpha[..., None]], -1)
