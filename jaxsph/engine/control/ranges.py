r"""Ranges of the transfer function over intervals of the quantity: Hochstetter et al. 2016, section 4.1.

Flow: transfer function -> [ranges] -> bounds.

A piecewise linear function on $[a, b]$ is extreme at a, at b, or at a control point between. A sparse table (the extremes of
every run of $2^k$ control points) gives the latter from two overlapping runs: O(K log K) memory, O(1) a query.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.model.transfer.function import SELECT_ALL, Segments, TransferFunction, look_up
from jaxsph.numerics.trees import tree

EXTINCTION = 3  # channel, after those of colours
ROUNDING = 8  # eps: a looked up value is a sum and a product away from its control points
ROUNDING_OF_PLACE = 16  # eps of the largest value: where evenly spaced points are taken to lie


@tree()
class RangeTables:
    """Transfer function with extremes of runs of control points.

    Attributes:
        segments: for values at the ends.
        values: the control points.
        lo, hi: of control points `i ... i + 2**k - 1` at entry `k * points + i`; red, green, blue, extinction.
        fuzz: how far, in quantity, a looked up value can be misplaced.
        scale: largest value of each channel, for rounding.
        steepest: largest slope of each channel, a unit of quantity; infinite with jumps.
    """

    segments: Segments
    values: Float[Array, " points"]
    lo: Float[Array, "4 entries"]
    hi: Float[Array, "4 entries"]
    fuzz: Float[Array, ""]
    scale: Float[Array, " 4"]
    steepest: Float[Array, " 4"]


def tables_of_parts(transfer: TransferFunction) -> tuple[RangeTables, ...]:
    """Of the parts of a transfer function, by the quantities that they are looked up by."""
    return tuple(map(range_tables, transfer.parts()))


def range_tables(transfer: TransferFunction) -> RangeTables:
    """Sparse tables of a transfer function, or part of one, of one quantity: made once a frame."""
    table = jnp.concatenate([transfer.colors, transfer.extinction[:, None]], 1).T
    fuzz = ROUNDING_OF_PLACE * jnp.finfo(table.dtype).eps * jnp.maximum(jnp.abs(transfer.values[0]), jnp.abs(transfer.values[-1]))
    lo, hi = _sparse(table, jnp.minimum), _sparse(table, jnp.maximum)
    rise, run = jnp.abs(table[:, 1:] - table[:, :-1]), transfer.values[1:] - transfer.values[:-1]
    steepest = jnp.where(rise > 0, rise / run, 0).max(1, initial=0)
    return RangeTables(transfer.segments(), transfer.values, lo, hi, fuzz, table.max(1), steepest)


def _sparse(row: Float[Array, "4 points"], extreme: Callable[[Array, Array], Array]) -> Float[Array, "4 entries"]:
    """Extremes of runs of 1, 2, 4, ... entries beginning at each; runs past the end stop there."""
    runs, length = [row], 1
    while 2 * length <= row.shape[-1]:
        last = runs[-1]
        runs.append(jnp.concatenate([extreme(last[:, :-length], last[:, length:]), last[:, -length:]], 1))
        length *= 2
    return jnp.concatenate(runs, 1)


def ranges_of_parts(
    tables: tuple[RangeTables, ...], quantities: Sequence[tuple[Float[Array, "*any"], Float[Array, "*any"]]]
) -> tuple[list[Float[Array, "*any"]], list[Float[Array, "*any"]]]:
    r"""`transfer_ranges` of each part, over the range of its own quantity: of colours by the first, extinction by the last.

    **Theorem.** Where the quantities lie in their ranges, whatever they have to do with each other, look-ups lie in what is
    returned. *Argument.* A colour is looked up by the first quantity alone, extinction by the last alone: each is bounded by
    `transfer_ranges`. That both ranges are met at once is not said, so the bounds are those of the box of both. $\square$
    """
    found = [transfer_ranges(part, *ends) for part, ends in zip(tables, quantities, strict=True)]
    least, greatest = ([*found[0][side][:EXTINCTION], found[-1][side][EXTINCTION]] for side in range(2))
    return least, greatest


def transfer_ranges(
    tables: RangeTables, lo: Float[Array, "*any"], hi: Float[Array, "*any"]
) -> tuple[list[Float[Array, "*any"]], list[Float[Array, "*any"]]]:
    """Least and greatest red, green, blue and extinction that `look_up` can give for any quantity in `[lo, hi]`.

    Rounded outwards. A look-up may be misplaced by less than `fuzz`, so ends are looked up that much further out, and control
    points twice as far out count as inside; `ROUNDING` eps of the channel's largest value cover the interpolation's own
    rounding. At control points and beyond the ends the range is exact but for these terms.
    """
    points = tables.values.shape[0]
    lo, hi = lo - tables.fuzz, hi + tables.fuzz
    method = "compare_all" if points <= SELECT_ALL else "scan_unrolled"
    first = jnp.searchsorted(tables.values, lo - tables.fuzz, side="left", method=method).astype(jnp.int32)
    past = jnp.searchsorted(tables.values, hi + tables.fuzz, side="right", method=method).astype(jnp.int32)
    inside = past > first
    run = 31 - lax.clz(jnp.maximum(past - first, 1))
    front = jnp.minimum(run * points + first, tables.lo.shape[1] - 1)
    back = run * points + jnp.maximum(past - (1 << run), 0)
    at_lo, at_hi = look_up(tables.segments, lo), look_up(tables.segments, hi)
    rounding = ROUNDING * jnp.finfo(lo.dtype).eps * tables.scale
    least, greatest = [], []
    for channel in range(4):
        lows, highs = (
            [row[channel].at[i].get(mode="promise_in_bounds") for i in (front, back)] for row in (tables.lo, tables.hi)
        )
        low, high = jnp.minimum(at_lo[channel], at_hi[channel]), jnp.maximum(at_lo[channel], at_hi[channel])
        low = jnp.where(inside, jnp.minimum(low, jnp.minimum(*lows)), low)
        high = jnp.where(inside, jnp.maximum(high, jnp.maximum(*highs)), high)
        least.append(jnp.maximum(low - rounding[channel], 0))
        greatest.append(high + rounding[channel])
    return least, greatest
