"""Where an orthographic camera stands that looks along an axis of the world, as projections are usually taken.

Flow: box around particles, axis -> [framing] -> Camera.along_axis.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxsph.numerics.given import plain

VIEWS = {"x": ((-1, 0, 0), (0, 0, 1)), "y": ((0, 1, 0), (0, 0, 1)), "z": ((0, 0, -1), (0, 1, 0))}
"""Line of sight and upward direction: images show y and z, x and z, x and y, the first to the right and the second upwards."""

WIDENED = 1e-4  # of the depths, so that no support touches an end by rounding


class ParallelView(NamedTuple):
    """What `Camera.orthographic` takes; all in float64, length units."""

    eye: np.ndarray
    target: np.ndarray
    up: np.ndarray
    view_height: float
    near: float
    far: float


def parallel_view(
    bounds: tuple[np.ndarray, np.ndarray], axis: str, aspect: float, margin: float, depth_range: tuple[Any, Any] | None
) -> ParallelView:
    """The view along an axis that shows all of a box; `aspect` is height over width. See `Camera.along_axis`.

    Raises:
        ValueError: another axis, or coordinates that do not ascend.
    """
    if axis not in VIEWS:
        raise ValueError(f"`axis` must be 'x', 'y' or 'z', got {axis!r}")
    forward, up = (np.asarray(direction, np.float64) for direction in VIEWS[axis])
    lower, upper = bounds
    if not (upper > lower).any():
        lower, upper = lower - 0.5, upper + 0.5
    middle, extent = (lower + upper) / 2, upper - lower
    across, deep = float(extent @ np.abs(np.cross(forward, up))), float(extent @ np.abs(forward))
    view_height = max(float(extent @ up), across * aspect) * margin
    view_height, distance = view_height or 1.0, deep or 1.0
    near, far = 0.5 * distance - WIDENED * deep, 1.5 * distance + WIDENED * deep
    eye = middle - forward * distance
    if depth_range is not None:
        begin, end = (plain("depth_range", one) for one in depth_range)
        if not (np.isfinite(begin) and np.isfinite(end) and begin < end):
            raise ValueError(f"`depth_range` must be two finite coordinates that ascend, got {(begin, end)}")
        near, far = sorted(float((one - eye["xyz".index(axis)]) * forward.sum()) for one in (begin, end))
    return ParallelView(eye, middle, up, view_height, near, far)
