"""Surfaces in a light at the eye, or one from far away: what is shared by all media that are one.

Flow: gradient, ray -> [headlight] -> iso_surface, particle_surface.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.numerics.extremes import greater

OPAQUE = 1e4  # optical thickness of a sample that holds the surface: what other media add to it is nothing


def headlight(
    normal: Sequence[Float[Array, "..."]],
    ray: Sequence[Float[Array, "..."]],
    ambient: Float[Array, ""],
    light: Float[Array, "3"] | None = None,
) -> Float[Array, "..."]:
    """Ambient light, and the light that a surface faces with the side that is seen (Lambert); where it faces nowhere, all of it.

    Args:
        normal, ray: x, y and z of a vector across the surface and of one along the ray, of any lengths.
        ambient: share of the light that a surface has which is seen edge on.
        light: x, y and z of a vector of unit length towards a light far away; None for a light at the eye.
    """
    along = normal[0] * ray[0] + normal[1] * ray[1] + normal[2] * ray[2]
    square = square_of(normal) * square_of(ray)
    if light is None:
        facing = jnp.where(square > 0, jnp.abs(along) * lax.rsqrt(jnp.where(square > 0, square, 1)), 1)
        return ambient + (1 - ambient) * facing
    square, towards = square_of(normal), normal[0] * light[0] + normal[1] * light[1] + normal[2] * light[2]
    towards = greater(0, jnp.where(along > 0, -towards, towards))
    return ambient + (1 - ambient) * jnp.where(square > 0, towards * lax.rsqrt(jnp.where(square > 0, square, 1)), 1)


def square_of(vector: Sequence[Float[Array, "..."]]) -> Float[Array, "..."]:
    """Of its length."""
    return vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2
