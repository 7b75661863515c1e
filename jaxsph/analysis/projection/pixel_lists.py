"""Which pixels a particle's column is laid into, and by which rule: rays through pixels, or exact shares of whole pixels.

Flow: particles, camera -> [pixel_lists] -> lists -> field.column_sums.

A column along a ray is exact there, and says nothing of the rest of the pixel: a support smaller than a pixel is met by chance.
Shares are exact means of pixels, where no depth cuts the support and rays are parallel. So means over pixels take shares wherever
they are exact, and for supports so small that it is of no matter; and a grid of rays in each pixel for all others.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.footprint import pixel_ranges
from jaxsph.engine.access.ordering import Ordered
from jaxsph.engine.access.resolution import ROUNDING, unresolved
from jaxsph.engine.planning.viewing import camera_usable
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles.particles import Particles
from jaxsph.numerics import faults

SMALL = (
    2.0  # pixels that a support radius may have for shares where they are not exact: with more, rays are good to 3e-4 of the peak
)
NARROW = 1 / 32  # of its depth that it may have in perspective, unless it is smaller than a pixel: larger ones are no ellipses
LARGE = 256.0  # pixels beyond which differences of float32 corner integrals lose more than rays do
RAY, SHARE = "ray", "share"


class Placed(NamedTuple):
    """Particles in view space.

    Attributes:
        view: coordinates, length units; 0 where they are of no use.
        distance: largest coordinate of the offset from the eye, which rounding grows with.
        support: radius, 1 where it is of no use.
        live: whether any of the support lies between the camera's depths.
        small: whether its pixels get shares in means over pixels.
        large: whether several rays of each pixel meet it instead; where a decision is in doubt, it may be both.
        faults: fault word.
    """

    view: Float[Array, "particles 3"]
    distance: Float[Array, " particles"]
    support: Float[Array, " particles"]
    live: Bool[Array, " particles"]
    small: Bool[Array, " particles"]
    large: Bool[Array, " particles"]
    faults: Int[Array, ""]


def place(particles: Particles, camera: Camera, doubt: int = 0) -> Placed:
    """Particles as seen by a camera.

    Args:
        particles: in world space.
        camera: that sees them.
        doubt: times what rounding may be off by, within which a decision is left open: what may be live is, and what may follow
            either rule follows both. Programs round differently, and whole layers of a lattice lie on the border of a decision.

    Differentiation:
        View coordinates and supports have derivatives; which rule a particle follows is held fixed.
    """
    offset = camera.offset(particles.position, particles.position_rest)
    view = camera.rotate(offset)
    usable = jnp.isfinite(view).all(1) & (particles.support > 0) & jnp.isfinite(particles.support)
    view, support = jnp.where(usable[:, None], view, 0), jnp.where(usable, particles.support, 1)
    distance = jnp.abs(offset).max(1)
    still, z, near, far = (lax.stop_gradient(value) for value in (support, view[:, 2], camera.near, camera.far))
    size = lax.stop_gradient(distance) + still + jnp.maximum(jnp.abs(near), jnp.abs(far))
    off = doubt * ROUNDING * jnp.finfo(z.dtype).eps * size
    live = particles.valid & usable & (z + still >= near - off) & (z - still <= far + off)
    small, large = _small(z, still, camera, off), ~_small(z, still, camera, -off)
    blurred = live & unresolved(lax.stop_gradient(view), lax.stop_gradient(distance), still, camera, jnp.zeros(1, z.dtype))
    word = faults.raised(faults.BAD_PARTICLES, (particles.valid & ~usable).any()) | faults.raised(
        faults.UNRESOLVED, blurred.any()
    )
    return Placed(view, distance, support, live, small, large, word | faults.raised(faults.BAD_CAMERA, ~camera_usable(camera)))


def _small(z: Array, support: Array, camera: Camera, off: Array) -> Bool[Array, " particles"]:
    """Whether shares are exact, or good enough; `off` is added to whatever speaks for it."""
    height, near, far = (lax.stop_gradient(value) for value in (camera.half_height, camera.near, camera.far))
    pixel, reach = 2 * height / camera.height, support - off
    if camera.is_perspective:
        return (z + off > 0) & (reach < jnp.maximum(jnp.minimum(SMALL * pixel, NARROW), pixel) * (z + off))
    whole = (z - support >= near - off) & (z + support <= far + off)
    return (reach < SMALL * pixel) | (whole & (reach < LARGE * pixel))


def footprints(placed: Placed, camera: Camera, wanted: Bool[Array, " particles"], beside: float, doubt: int = 0) -> Ordered:
    """Particles that are `wanted` in the order that they have, with the pixels whose rays they can touch.

    Args:
        placed: particles in view space.
        camera: that sees them.
        wanted: which of them.
        beside: how far from the middle of a pixel rays go, in pixels, on either axis.
        doubt: as for `place`. Theorem: of 2 or more, there are at least the pixels that any other program finds with none: each
            is off by less than `ROUNDING` eps of what enters, which margins hold once for itself, and `doubt` times more.
    """
    placed = lax.stop_gradient(placed)
    camera = lax.stop_gradient(camera)
    x, y, z = (placed.view[:, k] for k in range(3))
    eps = jnp.finfo(x.dtype).eps * ROUNDING * (1 + doubt)
    reach = placed.support * (1 + eps) + eps * placed.distance
    aside = math.sqrt(2) * beside * 2 * camera.half_height / camera.height
    reach = reach + aside * ((jnp.abs(z) + reach) if camera.is_perspective else 1)
    live = placed.live & wanted
    between = camera.near.astype(z.dtype), camera.far.astype(z.dtype)
    sides = pixel_ranges(x, y, z, reach, live, camera, between, ROUNDING * (1 + doubt))
    nothing, nowhere = jnp.zeros_like(x), jnp.zeros((1, 1), jnp.int32)  # of samples, which columns have none of
    index = jnp.arange(x.shape[0], dtype=jnp.int32)
    borders = dict(zip(("left", "right", "top", "bottom"), sides, strict=True))
    windows = dict.fromkeys(("first_rank", "last_rank", "first_beside", "last_beside"), nowhere)
    columns = {"x": x, "y": y, "z": z, "reach": reach, "live": live}
    columns |= dict.fromkeys(("scale", "size", "quantity"), nothing)
    return Ordered(**columns, **borders, **windows, index=index)
