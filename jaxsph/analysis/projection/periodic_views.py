"""Periodic sets in projections: which cameras see them across their faces, and how much of their box each pixel holds.

Flow: periodic -> [periodic_views] -> projection_plan, project.

Along an axis of the box, rays and pixels end where its faces are: what a projection has is what the box holds, images that reach
into it included. Along other directions faces cut rays at depths that differ from ray to ray, which column integrals do not know:
there each particle is taken once, with all of its support.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips.shapes import Box
from jaxsph.model.particles import Particles

ALIGNED = 1e-6  # of its length, that a line of sight may be off an axis


def sees_images(particles: Particles, camera: Camera) -> bool:
    """Whether images of a periodic set count: for parallel rays along one of its axes, upright (host side)."""
    if particles.box is None or camera.is_perspective:
        return False
    return bool((np.abs(np.asarray(camera.axes, np.float64)).max(1) > 1 - ALIGNED).all())


def between_faces(camera: Camera, box: Box, pixel: str) -> tuple[Camera, Float[Array, "height width"]]:
    """The camera with its depths cut off at the faces of a box, and what share of each pixel lies between the others.

    Args:
        camera: that `sees_images`.
        box: a period.
        pixel: `"mean"`, or `"ray"`, of which the middle counts.
    """
    ends = jnp.stack([camera.to_view(corner, rest) for corner, rest in zip((box.lower, box.upper), box.rest, strict=True)])
    low, high = ends.min(0), ends.max(0)
    near, far = jnp.maximum(camera.near, low[2]), jnp.minimum(camera.far, high[2])
    meets = near < far
    inside = dataclasses.replace(camera, near=jnp.where(meets, near, camera.near), far=jnp.where(meets, far, camera.far))
    across = _shares(camera.column, camera.width, low[0], high[0], pixel)
    down = _shares(camera.row, camera.height, low[1], high[1], pixel)
    return inside, jnp.where(meets, down[:, None] * across, 0)


def _shares(place: Any, number: int, low: Array, high: Array, pixel: str) -> Float[Array, " pixels"]:
    """Of pixels in a row or column, how much lies between two coordinates."""
    if pixel == "ray":
        middle = place(jnp.arange(number) + 0.5)
        return ((middle >= low) & (middle <= high)).astype(low.dtype)
    edges = place(jnp.arange(number + 1))
    lower, upper = jnp.minimum(edges[:-1], edges[1:]), jnp.maximum(edges[:-1], edges[1:])
    return jnp.clip(jnp.minimum(upper, high) - jnp.maximum(lower, low), 0, upper - lower) / (upper - lower)
