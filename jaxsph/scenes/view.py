"""Cameras of the built-in scenes: one eye for all frames, and depths that are snug for the frame.

Flow: Particles -> [view] -> Camera.
"""

from __future__ import annotations

import numpy as np

from jaxsph.model import Camera, Particles
from jaxsph.model.camera.snug import corners_of, snug

FOV_DEGREES = 35.0
UP = (0.0, 1.0, 0.0)
BORDER = 0.06  # part of the image that stays empty around a scene


def looking_at_box(
    lower: tuple[float, float, float],
    upper: tuple[float, float, float],
    direction: tuple[float, float, float],
    particles: Particles,
    width: int,
    height: int,
) -> Camera:
    r"""Camera along `direction` whose image the box fills but for a border, with depths snug to `particles`.

    With $k$ the tangent of half the opening, an eye at lateral place $e$ and distance $D$ sees a corner when
    $|x - e| \le k (z + D)$. The nearest such eye has $e = (a + b) / 2$ and $D = (a - b) / 2k$, where
    $a = \max(x - k z)$ and $b = \min(x + k z)$ over the corners; likewise for $y$.
    """
    forward = np.asarray(direction) / np.linalg.norm(direction)
    right = np.cross(forward, UP) / np.linalg.norm(np.cross(forward, UP))
    axes = np.stack([right, np.cross(right, forward), forward])
    corners = corners_of(lower, upper) @ axes.T
    tangent = np.tan(np.radians(FOV_DEGREES) / 2) * (1 - BORDER) * np.array([width / height, 1.0])
    ahead = corners[:, 2:] * tangent
    most, least = (corners[:, :2] - ahead).max(0), (corners[:, :2] + ahead).min(0)
    eye = np.append((most + least) / 2, -((most - least) / (2 * tangent)).max()) @ axes
    camera = Camera.look_at(eye, eye + forward, UP, FOV_DEGREES, width, height, near=1.0, far=2.0)
    return snug(camera, particles)
