"""How steep a transfer function is over a range of quantities: the mean of its squared slopes.

Flow: transfer -> [slopes] -> interpolation_error.

The integral of the squared slope up to any quantity tells the mean over any range: a difference of two. It is tabulated at
uniform borders, so a range is read without a search.
"""

from __future__ import annotations

import dataclasses
import functools

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsph.model.transfer.function import TransferFunction, look_up
from jaxsph.numerics.fusion import fusion_barrier
from jaxsph.numerics.trees import tree

BUCKETS = 1024  # of the transfer function's domain: a slope is averaged over one at least


@tree()
class SquaredSlopes:
    """Squared slopes of a transfer function, such that they are read without a search.

    Attributes:
        start, rate: where the first of `BUCKETS` uniform buckets begins, and buckets a unit.
        integral: from the first control point to the borders of buckets, of red, green, blue and extinction; number of jumps.
            With an empty bucket at either end, for what lies beyond all control points.
    """

    start: Float[Array, ""]
    rate: Float[Array, ""]
    integral: Float[Array, "5 borders"]


def squared_slopes(transfer: TransferFunction) -> SquaredSlopes:
    """The tables that `mean_square_slope` reads: made once, outside of loops."""
    segments = transfer.segments()
    run = jnp.diff(transfer.values, append=transfer.values[-1:])
    change = jnp.where(run > 0, segments.change / jnp.where(run > 0, run, 1), 0) ** 2 * run
    jumps = ((run <= 0) & functools.reduce(jnp.logical_or, segments.change != 0)).astype(run.dtype)
    added, moved = (jnp.stack([*change, last]) for last in (jumps, jnp.zeros_like(jumps)))
    cumulative = dataclasses.replace(segments, base=jnp.cumsum(added, 1) - added, change=moved)
    first, last = transfer.values[0], transfer.values[-1]
    borders = jnp.append(jnp.linspace(first, last, BUCKETS, endpoint=False)[1:], jnp.stack([last, last]))
    integral = jnp.pad(jnp.stack(look_up(cumulative, borders)), ((0, 0), (2, 0)))
    width = (last - first) / BUCKETS
    return SquaredSlopes(first, jnp.where(width > 0, 1 / jnp.where(width > 0, width, 1), 0), integral)


def mean_square_slope(squares: SquaredSlopes, low: Array, high: Array) -> list[Array]:
    """Mean over `[low, high]` of the squared slope of red, green, blue and extinction; infinite with a jump inside.

    Of all buckets that the range meets, so too much rather than too little, and with what the difference of two integrals may
    have lost to rounding.
    """

    def bucket(quantity: Array) -> Array:
        place = jnp.clip((quantity - squares.start) * squares.rate, 0, BUCKETS).astype(jnp.int32)
        place = jnp.where(squares.rate > 0, place, BUCKETS)  # of no width: all lies beyond
        return jnp.where(quantity < squares.start, 0, jnp.clip(place, 0, BUCKETS) + 1)  # in range even for NaN

    lost = 4 * jnp.finfo(low.dtype).eps
    borders = fusion_barrier(squares.rate >= 0, lambda low, high: (bucket(low), bucket(high) + 1), low, high)
    lower, upper = (squares.integral.at[:, at].get(mode="promise_in_bounds") for at in borders)
    extent = jnp.maximum(high - low, jnp.where(squares.rate > 0, 1 / squares.rate, 1))
    *inside, jumps = upper - lower
    return [jnp.where(jumps > 0, jnp.inf, (sum_of + lost * most) / extent) for sum_of, most in zip(inside, upper, strict=False)]
