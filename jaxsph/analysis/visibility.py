r"""What rays really meet: how much light each value of a quantity emits and absorbs, as the camera sees it.

Flow: scene, camera -> some rays -> portions -> quantity at nodes, light in front of it -> [visibility] -> histogram, figure.

A value may be that of most particles and never be seen, as it lies behind others. Along rays of random pixels the quantity is
taken at the nodes of portions of the float64 reference, and what is there is weighted by the transmittance in front:
$\int T \sigma\,dl$ is absorbed, $\int T c \sigma\,dl$ is emitted, and the path length alone tells what is there at all. The sum
of what all values absorb is the mean alpha of the image, if nothing else is in the scene.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import Scale
from jaxsph.numerics.trees import on_host
from jaxsph.reference import met

MAX_BINS = 4096


@dataclasses.dataclass(frozen=True, eq=False)
class VisibilityHistogram:
    """What rays meet, by value of the quantity; all are means over the pixels of the image.

    Attributes:
        edges: of the bins, ascending, even on the scale of the transfer function.
        there: path length, length units, whatever hides it.
        absorbed: share of the light of the background that is absorbed there.
        emitted: red, green and blue that reach the eye from there.
        rays: how many were cast.
    """

    edges: Float[np.ndarray, " bins_and_one"]
    there: Float[np.ndarray, " bins"]
    absorbed: Float[np.ndarray, " bins"]
    emitted: Float[np.ndarray, "bins 3"]
    rays: int

    @property
    def middles(self) -> Float[np.ndarray, " bins"]:
        """Between the edges, halfway."""
        return (self.edges[1:] + self.edges[:-1]) / 2


@on_host
def visibility_histogram(
    scene: Scene, camera: Camera, *, rays: int = 2000, bins: int = 64, part: int = 0, seed: int = 0
) -> VisibilityHistogram:
    """The histogram of what rays meet, over the quantity of one part of a scene (host side, float64).

    An estimate: of random pixels, and of the field at nodes of portions that are not split any further, as
    `jaxsph.reference.integral` splits them for its own. Everything in the scene hides what lies behind it, of whichever part.

    Args:
        scene: particles, volumes and points.
        camera: where from.
        rays: random pixels, all different; all pixels where there are fewer.
        bins: of the histogram, from the least to the greatest of control values and of what is met.
        part: which part that has a transfer function: particles come first, then volumes, in their order.
        seed: of the choice of pixels.

    Raises:
        ValueError: a scene of nothing or with `media`, no such part, a number of rays or bins out of range.

    References:
        Correa & Ma 2011, *Visibility histograms and visibility-driven transfer functions*.
    """
    scene.check_without_surface("`visibility_histogram`")
    if scene.media:
        raise ValueError("`media` must be `()` for `visibility_histogram`, which knows particles, volumes and points")
    for name, number, most in (("rays", rays, 1 << 24), ("bins", bins, MAX_BINS)):
        if not 1 <= number <= most:
            raise ValueError(f"`{name}` must be an integer from 1 to {most}, got {number!r}")
    camera = with_depths(camera, scene)
    looks, number = scene.looks, camera.width * camera.height
    if not 0 <= part < len(looks):
        there = f"0 to {len(looks) - 1}" if looks else "none: points have colours of their own"
        raise ValueError(f"`part` must be the number of a part with a transfer function, got {part}; there are {there}")
    pixels = np.random.default_rng(seed).choice(number, min(rays, number), replace=False)
    rows, columns = np.unravel_index(pixels, (camera.height, camera.width))
    return _histogram(met(scene, camera, rows, columns, part), looks[part], bins, len(pixels))


def _histogram(found: tuple[np.ndarray, ...], transfer: TransferFunction, bins: int, rays: int) -> VisibilityHistogram:
    quantity, path, absorbed, emitted = found
    scale = Scale.of(np.asarray(transfer.values, np.float64))
    place = scale.place(quantity)
    finite = place[np.isfinite(place)]
    low, high = min(0.0, finite.min(initial=0)), max(1.0, finite.max(initial=1))
    at = np.clip((np.maximum(place, low) - low) / (high - low) * bins, 0, bins - 1).astype(int)

    def summed(weight: Any) -> np.ndarray:
        return np.bincount(at, weight, bins) / rays

    edges = scale.value(low + (high - low) * np.arange(bins + 1) / bins)
    light = np.stack([summed(channel) for channel in emitted.T], 1)
    return VisibilityHistogram(edges, summed(path), summed(absorbed), light, rays)
