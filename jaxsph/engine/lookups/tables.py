"""A transfer function prepared for means over ranges of the quantity.

Flow: transfer -> [tables] -> means over ranges -> cast -> image.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.model.transfer.function import Segments, at
from jaxsph.numerics.extremes import clamped, greater, lesser
from jaxsph.numerics.trees import tree

WIDENED = 1  # eps of a range's upper end and of the control points' that it is widened by: at least its next number
FARTHEST = 2.0**120  # times the largest control point: where quantities are clamped, such that nothing overflows
MAX_EXPONENT = 120  # of the power of two that makes positions of quantities
FEW = 8  # control points up to which a sum over all pieces beats finding the two outer ones of evenly spaced
ALL_PAIRS = 128  # up to this many control points, integrals between any two are kept: one gather for four
EXTINCTION = 3  # the row of extinction; those before are emission of red, green and blue


@tree()
class MeanTables:
    """A transfer function prepared for means: made once, outside of loops.

    Positions are quantities times a power of two, such that the largest control point is about 1. For evenly spaced control
    points `between` counts widths in pieces.

    Attributes:
        segments: what control points are found by.
        unit: positions a unit of the quantity.
        points: positions of control points.
        inverse: 1 / the width of pieces, 0 for jumps (and what is as narrow as one) and beyond the last control point.
        base: of red, green, blue and extinction at the beginning of a piece; jumps have their mean.
        slope: change over a unit of position.
        bend: product of the slopes of a row and of extinction, over 12.
        curve: of red, green and blue times extinction, and of extinction, by places behind the beginning of a piece to no power,
            the first and the second; for evenly spaced control points places are counted in pieces. No derivatives.
        sums, lost: integrals over all pieces before, and what rounding lost of them; none for few control points.
        between: by pair (first, last): integrals over the pieces between, or for more than `ALL_PAIRS` control points sums
            like `sums` and `lost`, one after the other. No derivatives.
    """

    segments: Segments
    unit: Float[Array, ""]
    points: Float[Array, " points"]
    inverse: Float[Array, " points"]
    base: Float[Array, "4 points"]
    slope: Float[Array, "4 points"]
    bend: Float[Array, "4 points"]
    curve: tuple[Float[Array, "4 points"], ...]
    sums: Float[Array, "4 points_or_none"]
    lost: Float[Array, "4 points_or_none"]
    between: Float[Array, "4 pairs"]

    @classmethod
    def of(cls, segments: Segments) -> MeanTables:
        """Of a transfer function's segments."""
        largest = lax.stop_gradient(jnp.abs(segments.start).max())
        exponent = jnp.where(largest > 0, jnp.frexp(largest)[1], 0)
        unit = jnp.ldexp(jnp.ones_like(largest), jnp.clip(-exponent, -MAX_EXPONENT, MAX_EXPONENT))
        points = segments.start * unit
        width = jnp.append(points[1:] - points[:-1], 0)
        wide = width > jnp.finfo(width.dtype).eps ** 2  # of a range, which is longer than eps, what is narrower is nothing
        inverse = jnp.where(wide, 1 / jnp.where(wide, width, 1), 0)
        base = jnp.where(wide, segments.base, segments.base + segments.change / 2)
        change = jnp.where(wide, segments.change, 0)
        slope = change * inverse
        curve = lax.stop_gradient(_curve(base, change * jnp.where(segments.even, 1, inverse)))
        sums = lost = between = jnp.zeros_like(base[:, :0])
        if points.shape[0] > FEW:
            whole = _whole(base, change)
            sums, lost = _sums_before(whole * width)
            between = lax.stop_gradient(_between(*_sums_before(whole * jnp.where(segments.even, 1, width))))
        return cls(segments, unit, points, inverse, base, slope, slope * slope[3:] / 12, curve, sums, lost, between)


def _whole(base: Array, change: Array) -> Float[Array, "4 points"]:
    """Means over whole pieces of the emission of three colours, and of extinction."""
    middle = base + change / 2
    emission = middle[:EXTINCTION] * middle[EXTINCTION] + change[:EXTINCTION] * change[EXTINCTION] / 12
    return jnp.concatenate([emission, middle[EXTINCTION:]])


def _curve(base: Array, slope: Array) -> tuple[Float[Array, "4 points"], ...]:
    """See `MeanTables.curve`."""
    (color, extinction), (rise, more) = ((rows[:EXTINCTION], rows[EXTINCTION:]) for rows in (base, slope))
    powers = (color * extinction, extinction), (color * more + rise * extinction, more), (rise * more, 0 * more)
    return tuple(jnp.concatenate(rows) for rows in powers)


def _sums_before(terms: Float[Array, "rows points"]) -> tuple[Array, Array]:
    """Sums of the terms before each, and what rounding lost of them (the two-sum of Knuth 1969, section 4.2.2)."""

    def add(total: tuple[Array, Array], term: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        before, lost = total
        after = before + term
        added = after - before
        return (after, lost + ((before - (after - added)) + (term - added))), total

    nothing = jnp.zeros_like(terms[:, 0])
    sums, lost = lax.scan(add, (nothing, nothing), terms.T)[1]
    return sums.T, lost.T


def _between(sums: Array, lost: Array) -> Float[Array, "4 pairs"]:
    """See `MeanTables.between`."""
    count = sums.shape[1]
    if count > ALL_PAIRS:
        return jnp.concatenate([sums, lost], 1)
    each = jnp.arange(count)
    after = jnp.minimum(each + 1, count - 1)
    pairs = (sums[:, None, :] - sums[:, after, None]) + (lost[:, None, :] - lost[:, after, None])
    return jnp.where(each > after[:, None], pairs, 0).reshape(4, -1)


def integral_between(tables: MeanTables, row: int, first: Array, last: Array) -> Array:
    """Of a row over the pieces between two."""
    count, table = tables.points.shape[0], tables.between[row]
    if count <= ALL_PAIRS:
        return at(table, first * count + last)
    after = jnp.minimum(first + 1, count - 1)
    difference = (at(table, last) - at(table, after)) + (at(table, last + count) - at(table, after + count))
    return jnp.where(last > after, difference, 0)


def beyond(tables: MeanTables, row: int, point: int) -> Array:
    """Emission or extinction beyond the first (0) or the last (-1) control point."""
    value = tables.segments.base[:, point]
    return value[row] if row == EXTINCTION else value[row] * value[EXTINCTION]


def ends(tables: MeanTables, near: Array, far: Array) -> tuple[Array, Array]:
    """Positions of the lower and the upper end of ranges, widened."""
    return ordered(near * tables.unit, far * tables.unit, 1)


def ordered(near: Array, far: Array, reach: float) -> tuple[Array, Array]:
    """The lower and the upper end, clamped and widened; with NaN for either, one of them is NaN."""
    near, far = (clamped(end, -FARTHEST, FARTHEST) for end in (near, far))
    ascending = near < far
    return jnp.where(ascending, near, far), widened(jnp.where(ascending, far, near), reach)


def widened(end: Array, reach: float) -> Array:
    """An upper end moved up by some roundings of it, or of what control points reach to: the range is then never empty."""
    return end + lax.stop_gradient(WIDENED * jnp.finfo(end.dtype).eps * (jnp.abs(end) + reach))


def split(lo: Array, hi: Array, first: Array, last: Array) -> tuple[Array, Array, Array, Array]:
    """Lengths of a range below and above the control points, and ends of what lies among them."""
    below = lesser(first, hi) - lesser(first, lo)
    above = greater(last, hi) - greater(last, lo)
    return below, above, clamped(lo, first, last), clamped(hi, first, last)
