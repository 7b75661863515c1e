r"""Numbers as mantissa and exponent, where products of many decades would leave the range of the dtype.

XLA treats subnormal numbers as zero on CPU, in comparisons too. So exponents are read from the bits.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int


def split(x: Float[Array, "*any"]) -> tuple[Float[Array, "*any"], Int[Array, "*any"]]:
    r"""Mantissa m, $1 \le |m| < 2$, and exponent e of x = m 2^e; of zero and of subnormal numbers, 0 and the least exponent.

    Differentiation: the exponent is a constant.
    """
    _, exponent, _, bias = _layout(x)
    normal, exponent = exponent > 0, (exponent - bias).astype(jnp.int32)
    half = exponent // 2  # in two steps, as 2^-127 is no normal number
    mantissa = jnp.where(normal, x, 0) * power_of_two(-half, x.dtype) * power_of_two(half - exponent, x.dtype)
    return mantissa, exponent


def power_of_two(exponent: Int[Array, "*any"], dtype: Any) -> Float[Array, "*any"]:
    """$2^e$ exactly; 0 below the range of normal numbers, and the largest power above it."""
    info = jnp.finfo(dtype)
    whole = jnp.int32 if info.bits == 32 else jnp.int64
    bias = -int(info.minexp) + 1
    biased = jnp.clip(exponent.astype(whole) + bias, 0, 2 * bias)
    return lax.bitcast_convert_type(biased << info.nmant, dtype)


def is_subnormal(x: Float[Array, "*any"]) -> Bool[Array, "*any"]:
    """Whether x is neither zero nor normal, so that arithmetic takes it for zero."""
    bits, exponent, mantissa_bits, _ = _layout(x)
    return (exponent == 0) & ((bits & ((1 << mantissa_bits) - 1)) != 0)


def _layout(x: Array) -> tuple[Array, Array, int, int]:
    """Bits, those of the exponent, number of mantissa bits, exponent bias."""
    info = jnp.finfo(x.dtype)
    bits = lax.bitcast_convert_type(x, jnp.int32 if info.bits == 32 else jnp.int64)
    return bits, (bits >> int(info.nmant)) & ((1 << int(info.nexp)) - 1), int(info.nmant), -int(info.minexp) + 1
