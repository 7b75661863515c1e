"""Lines of sight that a word stands for, what is up in their pictures, and boxes as they are framed.

Flow: word, upward direction -> [directions] -> line of sight, upward direction -> camera.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

OBLIQUE = -0.45, -0.35, -1.0  # line of sight of what is looked at obliquely from above, where y is up
VIEWS = {"x": ((-1, 0, 0), (0, 0, 1)), "y": ((0, 1, 0), (0, 0, 1)), "z": ((0, 0, -1), (0, 1, 0))}
"""Line of sight and upward direction: images show y and z, x and z, x and y, the first to the right and the second upwards."""
UP = (0.0, 1.0, 0.0)  # unless anything says otherwise
ALONG = 1e-9  # sine of the angle by which a line of sight is along what is up
NEAREST = 1e-3  # smallest near over far, where particles reach the eye: sample depths are geometric between them
ROUNDING = 1e-4  # relative widening of the depths, far above the rounding of float32 positions


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


def filled(bounds: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """A box; around what has no extent the unit box."""
    lower, upper = bounds
    return (lower, upper) if (upper > lower).any() else (lower - 0.5, upper + 0.5)


def corners_of(lower: Any, upper: Any) -> np.ndarray:
    """Of a box, the last coordinate first."""
    return np.array(list(itertools.product(*zip(lower, upper, strict=True))))
