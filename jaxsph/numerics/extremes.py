"""The lesser, the greater and the ratio of two numbers, with derivatives that hold however a program is compiled.

JAX finds the derivative of `jnp.maximum(a, b)` by asking which of the two the result equals. A compiler may add up the result
and what it is compared with in two loops, with a fused multiplication in one of them only; then it equals neither, and the
derivative is 0 without a word. Here it follows the comparison that chose: at worst the other side of what is nearly a tie.
One instruction, too, where `jnp.maximum` takes several to find NaN.

And JAX divides by the square of a divisor, which is nothing (or no number) long before the divisor is.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

Number = Array | np.floating[Any] | float
LEAST = 2.0**20  # times the least normal number: up to there a divisor has no derivatives, as one over it could overflow


def lesser(a: Number, b: Number) -> Array:
    """Minimum: `b` if either is NaN, and where both are equal."""
    return jnp.where(a < b, a, b)


def greater(a: Number, b: Number) -> Array:
    """Maximum: `b` if either is NaN, and where both are equal."""
    return jnp.where(a > b, a, b)


def clamped(value: Array, low: Number, high: Number) -> Array:
    """`value` between two bounds; NaN stays."""
    return lesser(high, greater(low, value))


@jax.custom_jvp
def ratio(part: Number, whole: Number) -> Array:
    """`part / whole`, 0 where `whole` is not above 0; with derivatives that are finite, 0 where it is at most `LEAST`."""
    filled = whole > 0
    return jnp.where(filled, part / jnp.where(filled, whole, 1), 0)


@ratio.defjvp
def _ratio_moved(primals: tuple[Any, Any], moves: tuple[Any, Any]) -> tuple[Array, Array]:
    found, whole = ratio(*primals), primals[1]
    solid = whole > LEAST * jnp.finfo(whole.dtype).tiny
    return found, (moves[0] - jnp.where(solid, found, 0) * moves[1]) * jnp.where(solid, 1 / jnp.where(solid, whole, 1), 0)
