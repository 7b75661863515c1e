"""Particles in order along a curve: neighbours in space are then neighbours in memory.

A Morton key interleaves the binary digits of x, y and z (Morton 1966, "A computer oriented geodetic data base"; for particles,
Warren & Salmon 1993, section 2.1).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxsph.model.particles.particles import Particles
from jaxsph.numerics.checks import as_usual, typed

DIGITS = 10  # binary ones of each coordinate: three times as many fit into a word
NOWHERE = 1 << (3 * DIGITS)  # the key of particles without a place, past all others; that of padding is past it
SPREAD = ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249))  # shifts and masks that leave gaps of two digits


@typed
@as_usual()
@jax.jit
def prepare(particles: Particles) -> Particles:
    """Do once what depends on particles alone: the same particles in an order in which frames find them faster.

    Worth it where particles that came in any order are rendered more than once. Frames need no preparation: an image is that
    of the particles as given but for rounding, as particles of the same depth are added up in another order.

    Args:
        particles: any, with their padding.

    Returns:
        As many entries, of which those that are particles come first, along a Morton curve through their bounding box.
        Preparing them again changes nothing.

    Differentiation:
        A permutation: what is differentiated by the particles given has the derivatives that it would have without; what by
        those returned, the same ones in their order. The order itself is held fixed.
    """
    order = jnp.argsort(lax.stop_gradient(morton_keys(particles)), stable=True)
    return particles.at(order)


def morton_keys(particles: Particles) -> Int[Array, " particles"]:
    """Morton keys of 3 x `DIGITS` binary digits, within the box around all particles that have a place."""
    position = particles.position
    placed = particles.valid & jnp.isfinite(position).all(1)
    largest = jnp.finfo(position.dtype).max
    lower = jnp.where(placed[:, None], position, largest).min(0, initial=largest)
    upper = jnp.where(placed[:, None], position, -largest).max(0, initial=-largest)
    middle, half = 0.5 * lower + 0.5 * upper, 0.5 * upper - 0.5 * lower
    share = (0.5 * position - 0.5 * middle) / jnp.where(half > 0, half, 1) + 0.5
    place = jnp.clip(share * (1 << DIGITS), 0, (1 << DIGITS) - 1)
    digits = jnp.where(placed[:, None], place, 0).astype(jnp.uint32)
    for shift, mask in SPREAD:
        digits = (digits | (digits << shift)) & mask
    key = digits[:, 0] | (digits[:, 1] << 1) | (digits[:, 2] << 2)
    return jnp.where(placed, key, jnp.where(particles.valid, NOWHERE, NOWHERE + 1).astype(jnp.uint32))
