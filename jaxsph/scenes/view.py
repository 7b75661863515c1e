"""Cameras of the built-in scenes: one eye for all frames, and depths that are snug for the frame.

Flow: Particles -> [view] -> Camera.
"""

from __future__ import annotations

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np

from jaxsph.model import Camera, Particles

NEAREST = 1e-3  # smallest near over far, where particles reach the eye: sample depths are geometric between them
ROUNDING = 1e-4  # relative widening of the depths, far above the rounding of float32 positions

FOV_DEGREES = 35.0
UP = (0.0, 1.0, 0.0)
BORDER = 0.06  # part of the image that stays empty around a scene


def snug(camera: Camera, particles: Particles) -> Camera:
    """`camera` with near and far moved to the particles' supports; unchanged where none lies in front of the eye."""
    valid = np.asarray(particles.valid)
    if not valid.any():
        return camera
    if particles.box is not None:
        return snug_box(camera, *particles.bounds())
    depth = _depth(camera, particles.exact_position()[valid])
    support = np.asarray(particles.support, np.float64)[valid]
    return _between(camera, (depth - support).min(), (depth + support).max())


def snug_box(camera: Camera, lower: np.ndarray, upper: np.ndarray) -> Camera:
    """`camera` with near and far moved to a box; unchanged where none of it lies in front of the eye."""
    depth = _depth(camera, np.array(list(itertools.product(*zip(lower, upper, strict=True)))))
    return _between(camera, depth.min(), depth.max())


def _depth(camera: Camera, position: np.ndarray) -> np.ndarray:
    return (position - camera.exact_eye()) @ np.asarray(camera.axes, np.float64)[2]


def _between(camera: Camera, near: float, far: float) -> Camera:
    if camera.is_perspective:
        if far <= 0:
            return camera
        near = max(near, NEAREST * far)
    margin = ROUNDING * max(abs(near), abs(far))
    near = near * (1 - ROUNDING) if camera.is_perspective else near - margin
    dtype = camera.dtype
    return dataclasses.replace(camera, near=jnp.asarray(near, dtype), far=jnp.asarray(far + margin, dtype))


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
    corners = np.array(list(itertools.product(*zip(lower, upper, strict=True)))) @ axes.T
    tangent = np.tan(np.radians(FOV_DEGREES) / 2) * (1 - BORDER) * np.array([width / height, 1.0])
    ahead = corners[:, 2:] * tangent
    most, least = (corners[:, :2] - ahead).max(0), (corners[:, :2] + ahead).min(0)
    eye = np.append((most + least) / 2, -((most - least) / (2 * tangent)).max()) @ axes
    camera = Camera.look_at(eye, eye + forward, UP, FOV_DEGREES, width, height, near=1.0, far=2.0)
    return snug(camera, particles)
