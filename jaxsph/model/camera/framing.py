"""Cameras with parallel rays along the axes of the world, as projections are usually taken.

Flow: particles -> [framing] -> Camera.
"""

from __future__ import annotations

import numpy as np

from jaxsph.model.camera.camera import Bounded, Camera
from jaxsph.numerics.given import plain

VIEWS = {"x": ((-1, 0, 0), (0, 0, 1)), "y": ((0, 1, 0), (0, 0, 1)), "z": ((0, 0, -1), (0, 1, 0))}
"""Line of sight and upward direction: images show y and z, x and z, x and y, the first to the right and the second upwards."""

WIDENED = 1e-4  # of the depths, so that no support touches an end by rounding


def along_axis(
    bounded: Bounded,
    axis: str = "z",
    width: int = 512,
    height: int = 512,
    *,
    margin: float = 1.0,
    slab: tuple[float, float] | None = None,
) -> Camera:
    """Orthographic camera along an axis that shows all of what there is (host side).

    Args:
        bounded: particles, a volume or points.
        axis: `"x"` shows y (right) and z (up), seen from large x; `"y"` x and z, seen from small y; `"z"` x and y, from large z.
        width, height: size in pixels.
        margin: 1 fills the image to its edge, larger leaves a border.
        slab: coordinates along the axis between which rays are followed; by default all.

    Raises:
        ValueError: another axis, or a slab that is none.
    """
    if axis not in VIEWS:
        raise ValueError(f"`axis` must be 'x', 'y' or 'z', got {axis!r}")
    forward, up = (np.asarray(direction, np.float64) for direction in VIEWS[axis])
    lower, upper = bounded.bounds()
    if not (upper > lower).any():
        lower, upper = lower - 0.5, upper + 0.5
    middle, extent = (lower + upper) / 2, upper - lower
    across, deep = float(extent @ np.abs(np.cross(forward, up))), float(extent @ np.abs(forward))
    view_height = max(float(extent @ up), across * height / width) * margin
    view_height, distance = view_height or 1.0, deep or 1.0
    near, far = 0.5 * distance - WIDENED * deep, 1.5 * distance + WIDENED * deep
    eye = middle - forward * distance
    if slab is not None:
        slab = plain("slab", slab[0]), plain("slab", slab[1])
        if not (np.isfinite(slab[0]) and np.isfinite(slab[1]) and slab[0] < slab[1]):
            raise ValueError(f"`slab` must be two finite coordinates that ascend, got {tuple(slab)}")
        near, far = sorted(float((end - eye["xyz".index(axis)]) * forward.sum()) for end in slab)
    return Camera.orthographic(eye, middle, up, view_height, width, height, near=near, far=far)
