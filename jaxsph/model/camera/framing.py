"""Where cameras look that are placed by a word, which way is up, and where one stands that looks along an axis of the world.

Flow: word, upward direction -> [framing] -> Direction; box around particles, axis -> [framing] -> Camera.along_axis.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsph.numerics.given import plain

VIEWS = {"x": ((-1, 0, 0), (0, 0, 1)), "y": ((0, 1, 0), (0, 0, 1)), "z": ((0, 0, -1), (0, 1, 0))}
"""Line of sight and upward direction: images show y and z, x and z, x and y, the first to the right and the second upwards."""

OBLIQUE, UP = (-0.45, -0.35, -1.0), (0.0, 1.0, 0.0)
"""Line of sight of what is looked at obliquely from above, where y is up; which is so unless anything says otherwise."""
ALONG = 1e-9  # sine of the angle by which a line of sight is along what is up

WIDENED = 1e-4  # of the depths, so that no support touches an end by rounding


def sight(view: str, up: Any = UP) -> tuple[np.ndarray, np.ndarray]:
    """Line of sight and upward direction of `"iso"`, obliquely from above, and of `"x"`, `"y"` and `"z"`, never from below.

    What is up in the world is so in the picture.
    """
    axis = np.asarray(up, np.float64)
    size = np.linalg.norm(axis) or 1.0
    if view == "iso":  # turned as y is turned to what is up (Rodrigues)
        forward, turn, cosine = np.array(OBLIQUE), np.cross(UP, axis / size), axis[1] / size
        if cosine < ALONG - 1:
            return -forward, axis
        return forward + np.cross(turn, forward) + np.cross(turn, np.cross(turn, forward)) / (1 + cosine), axis
    forward = np.asarray(VIEWS[view][0], np.float64)
    forward = -forward if forward @ axis > ALONG * size else forward
    return forward, upright(forward, axis)


def upright(forward: Any, up: Any) -> np.ndarray:
    """What is up in a picture: what is so in the world, or along that such that x is to the right, else y."""
    ahead, axis = (np.asarray(one, np.float64) for one in (forward, up))
    if np.linalg.norm(np.cross(ahead, axis)) > ALONG * np.linalg.norm(ahead) * np.linalg.norm(axis):
        return axis
    across = np.cross((1.0, 0.0, 0.0), ahead)
    return across if across.any() else np.array(UP)


def parallel_view(
    bounds: tuple[np.ndarray, np.ndarray],
    axis: str,
    aspect: float,
    margin: float,
    depth_range: tuple[Any, Any] | None,
    upward: Any = None,
) -> dict[str, Any]:
    """What `Camera.orthographic` takes to show all of a box along an axis; `aspect`: height over width. See `Camera.along_axis`.

    Raises:
        ValueError: another axis, or coordinates that do not ascend.
    """
    if axis not in VIEWS:
        raise ValueError(f"`axis` must be 'x', 'y' or 'z', got {axis!r}")
    forward, up = (np.asarray(direction, np.float64) for direction in (VIEWS[axis] if upward is None else sight(axis, upward)))
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    up = np.cross(right, forward)
    lower, upper = bounds
    if not (upper > lower).any():
        lower, upper = lower - 0.5, upper + 0.5
    middle, extent = (lower + upper) / 2, upper - lower
    across, deep = float(extent @ np.abs(right)), float(extent @ np.abs(forward))
    view_height = max(float(extent @ np.abs(up)), across * aspect) * margin
    view_height, distance = view_height or 1.0, deep or 1.0
    near, far = 0.5 * distance - WIDENED * deep, 1.5 * distance + WIDENED * deep
    eye = middle - forward * distance
    if depth_range is not None:
        begin, end = (plain("depth_range", one) for one in depth_range)
        if not (np.isfinite(begin) and np.isfinite(end) and begin < end):
            raise ValueError(f"`depth_range` must be two finite coordinates that ascend, got {(begin, end)}")
        near, far = sorted(float((one - eye["xyz".index(axis)]) * forward.sum()) for one in (begin, end))
    return {"eye": eye, "target": middle, "up": up, "view_height": view_height, "near": near, "far": far}
