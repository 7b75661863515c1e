"""The lesser and the greater of two numbers, with derivatives that hold however a program is compiled.

JAX finds the derivative of `jnp.maximum(a, b)` by asking which of the two the result equals. A compiler may add up the result
and what it is compared with in two loops, with a fused multiplication in one of them only; then it equals neither, and the
derivative is 0 without a word. Here it follows the comparison that chose: at worst the other side of what is nearly a tie.
One instruction, too, where `jnp.maximum` takes several to find NaN.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

Number = Array | np.floating[Any] | float


def lesser(a: Number, b: Number) -> Array:
    """Minimum: `b` if either is NaN, and where both are equal."""
    return jnp.where(a < b, a, b)


def greater(a: Number, b: Number) -> Array:
    """Maximum: `b` if either is NaN, and where both are equal."""
    return jnp.where(a > b, a, b)


def clamped(value: Array, low: Number, high: Number) -> Array:
    """`value` between two bounds; NaN stays."""
    return lesser(high, greater(low, value))
