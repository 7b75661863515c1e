"""Arithmetic that holds however XLA compiles it, and what keeps XLA from computing anything anew in each of its consumers.

The lesser, the greater and the ratio of two numbers have derivatives here that hold. JAX finds the derivative of
`jnp.maximum(a, b)` by asking which of the two the result equals. A compiler may add up the result and what it is compared with in
two loops, with a fused multiplication in one of them only; then it equals neither, and the derivative is 0 without a word. Here
it follows the comparison that chose: at worst the other side of what is nearly a tie. One instruction, too, where `jnp.maximum`
takes several to find NaN. And JAX divides by the square of a divisor, which is nothing (or no number) long before the divisor is.

Numbers are parted into mantissa and exponent, where products of many decades would leave the range of the dtype. XLA treats
subnormal numbers as zero on CPU, in comparisons too. So exponents are read from the bits.

On CPUs XLA fuses cheap-looking producers into every consumer and evaluates them anew in each: shading was computed six times,
the sphere-against-pyramid test twelve times. `lax.optimization_barrier` is dropped before fusion there. A branch is a
boundary that fusion respects, so the computation is put behind one that is always taken. On accelerators a branch is a round
trip to the host, and fusion looks at what it costs: there is no barrier (`engine.runtime.tuning`).
"""

from __future__ import annotations

import contextlib
import contextvars
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

Number = Array | np.floating[Any] | float
LEAST = 2.0**20  # times the least normal number: up to there a divisor has no derivatives, as one over it could overflow
ROW = 1 << 12  # values that are compared together
_BARRIERS = contextvars.ContextVar("barriers", default=True)


def lesser(a: Number, b: Number) -> Array:
    """Minimum: `b` if either is NaN, and where both are equal."""
    return jnp.where(a < b, a, b)


def greater(a: Number, b: Number) -> Array:
    """Maximum: `b` if either is NaN, and where both are equal."""
    return jnp.where(a > b, a, b)


def clamped(value: Array, low: Number, high: Number) -> Array:
    """`value` between two bounds; NaN stays."""
    return lesser(high, greater(low, value))


def extent(value: Float[Array, " any"], counts: Bool[Array, " any"]) -> tuple[Array, Array]:
    """Least and greatest of the values that count: inf and -inf of none.

    Row by row, so that it vectorises: XLA's own reductions on CPUs take fourteen times as long, as they ask for NaN.
    """
    size = min(ROW, value.shape[0])
    if not size:
        return jnp.asarray(jnp.inf, value.dtype), jnp.asarray(-jnp.inf, value.dtype)

    def of_row(nth: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        some, real = (lax.dynamic_slice(of, (nth * size,), (size,)) for of in (value, counts))
        return lesser(jnp.where(real, some, jnp.inf), ends[0]), greater(jnp.where(real, some, -jnp.inf), ends[1])

    nothing = jnp.full(size, jnp.inf, value.dtype)
    least, greatest = lax.fori_loop(0, -(-value.shape[0] // size), of_row, (nothing, -nothing))
    return least.min(), greatest.max()


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


def mantissa_and_exponent(x: Float[Array, "*any"]) -> tuple[Float[Array, "*any"], Int[Array, "*any"]]:
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


@contextlib.contextmanager
def barriers(kept: bool) -> Iterator[None]:
    """Have barriers in what is traced meanwhile, or not."""
    token = _BARRIERS.set(kept)
    try:
        yield
    finally:
        _BARRIERS.reset(token)


barriers_kept = _BARRIERS.get
"""Whether what is traced now is worked around XLA's fusion for CPUs."""


def fusion_barrier(witness: Bool[Array, ""], function: Callable[..., Any], *arguments: Any) -> Any:
    """`function(*arguments)`, computed once however many consumers it has.

    Args:
        witness: any scalar that is not known when compiling. Its value does not matter: the branch is taken where the number
            of its bits is not negative, which holds for true, for false, and thus for comparisons with NaN.
        function: pure; returns a pytree of arrays.
    """
    if not barriers_kept():
        return function(*arguments)
    once = jax.jit(function, inline=True)  # so that it is traced once, however deep barriers are nested
    shapes = once.eval_shape(*arguments)

    def nothing(*_: Any) -> Any:
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    always = lax.population_count(jnp.asarray(witness).astype(jnp.int32)) >= 0
    return lax.cond(always, once, nothing, *arguments)


def side_by_side(rows: Sequence[Array], axis: int) -> Array:
    """`jnp.stack`, of what is found in the same XLA kernel.

    On CPUs `jnp.stack` is a loop for each row, with all that rows share in each, and compiles as slowly as so many kernels of
    XLA's would. Here each element chooses.
    """
    if not barriers_kept():
        return jnp.stack(rows, axis)
    shape = [1] * (rows[0].ndim + 1)
    shape[axis] = len(rows)
    row, found = np.arange(len(rows)).reshape(shape), jnp.expand_dims(rows[-1], axis)  # known when compiling
    for k, value in enumerate(rows[:-1]):
        found = jnp.where(row == k, jnp.expand_dims(value, axis), found)
    return found


def together_of(first: Array, second: Array) -> Any:
    """Two arrays as one complex number: of every array that a loop or a branch gives XLA makes a kernel, that finds all anew."""
    return lax.complex(first, second) if barriers_kept() else (first, second)


def apart_of(pair: Any) -> tuple[Array, Array]:
    """The two arrays again."""
    return (pair.real, pair.imag) if barriers_kept() else pair
