r"""Means of a transfer function over ranges of the quantity: pre-integration (Engel, Kraus & Ertl 2001) without attenuation.

Flow: transfer -> [means over ranges] -> cast -> image.

Where the quantity runs linearly from $a$ to $b$, the mean of an optical property $f$ on the way is $\int_a^b f(Q) dQ / (b - a)$.
Colour and extinction are linear between control points, so there the mean of extinction is its value in the middle, and that of
$f = c s$ over a width $w$ is $c_m s_m + c' s' w^2 / 12$ with the values $c_m$, $s_m$ in the middle. Pieces are weighed by their
widths, which are differences of exact positions: no difference of large integrals is taken, however short the range is. The two
outer pieces of a range are found once, for extinction and colours; each then reads seven numbers in one kernel.

Accuracy: as if the ends were off by a few roundings of the largest control point or of themselves, and then a few eps of the
largest value in the pieces that are met. For few control points (`FEW`) and up to `ALL_PAIRS`, integrals over whole
pieces have eps; for more, eps and eps squared of the integral over all. A range is widened at its upper end by `WIDENED`
roundings: none is empty, and one that is nothing but a jump has the later point. What lies beyond the control points counts
with its true length and the value at the end.

Differentiation: in the ends and in control points. Moving the upper end of a range of length l changes the mean of f by
(f(end) - mean) / l, which drowns in rounding where l is short. So for derivatives the mean is written with pieces that keep their
shares of the range while it moves and stretches (`_smooth_means`): what changes is the value in their middles, by slopes. That
pieces change their shares adds nothing where f is continuous, since what one loses the next gains. Shares move only at jumps, and
where whole pieces lie between the ends: such ranges are not short.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.model.transfer.function import SELECT_ALL, Segments, at, locate
from jaxsph.numerics.checks import as_usual
from jaxsph.numerics.compiled import apart_of, clamped, greater, lesser, ratio, together_of
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
        (color, extinction), (rise, more) = (
            (rows[:EXTINCTION], rows[EXTINCTION:]) for rows in (base, change * jnp.where(segments.even, 1, inverse))
        )
        powers = (color * extinction, extinction), (color * more + rise * extinction, more), (rise * more, 0 * more)
        curve = lax.stop_gradient(tuple(jnp.concatenate(rows) for rows in powers))
        sums = lost = between = jnp.zeros_like(base[:, :0])
        if points.shape[0] > FEW:
            middle = base + change / 2
            emission = middle[:EXTINCTION] * middle[EXTINCTION] + change[:EXTINCTION] * change[EXTINCTION] / 12
            whole = jnp.concatenate([emission, middle[EXTINCTION:]])
            sums, lost = _sums_before(whole * width)
            before, off = _sums_before(whole * jnp.where(segments.even, 1, width))
            between, count = jnp.concatenate([before, off], 1), points.shape[0]
            if count <= ALL_PAIRS:
                each = jnp.arange(count)
                after = jnp.minimum(each + 1, count - 1)
                pairs = (before[:, None, :] - before[:, after, None]) + (off[:, None, :] - off[:, after, None])
                between = jnp.where(each > after[:, None], pairs, 0).reshape(4, -1)
            between = lax.stop_gradient(between)
        return cls(segments, unit, points, inverse, base, slope, slope * slope[3:] / 12, curve, sums, lost, between)


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


def mean_light(
    tables: MeanTables, near: Float[Array, "*any"], far: Float[Array, "*any"], channels: slice
) -> list[Float[Array, "*any"]]:
    """Means over the quantities between `near` and `far`, in any order; at one quantity, its value.

    Of colour times extinction in red, green and blue, and of extinction: those of the four that `channels` selects.
    """
    return _means(range(*channels.indices(EXTINCTION + 1)), tables, near, far, outer_pieces(tables, near, far))


class Outer(NamedTuple):
    """The first and the last piece that ranges run over, and what is met of both.

    Attributes:
        first, last: their numbers; where both are the same, nothing of the last is met.
        of_first, of_last: how far the middle of what is met is behind the beginning, and its width, see `together_of`.
        beyond: shares of the range below and above the control points, likewise; `share`: 1 over its length.
    """

    first: Int[Array, "*any"]
    last: Int[Array, "*any"]
    of_first: Any
    of_last: Any
    beyond: Any
    share: Float[Array, "*any"]


class OverRange(NamedTuple):
    """A range of the quantity, in any order, its outer pieces and the mean of extinction over it; `share`: of what counts."""

    near: Float[Array, "*any"]
    far: Float[Array, "*any"]
    outer: Outer | None
    extinction: Float[Array, "*any"]
    share: Float[Array, "*any"] | None = None


def extinction_over(tables: MeanTables, near: Float[Array, "*any"], far: Float[Array, "*any"]) -> OverRange:
    """The mean over a range, and what colours are found by."""
    outer = outer_pieces(tables, near, far)
    return OverRange(near, far, outer, _means(range(EXTINCTION, EXTINCTION + 1), tables, near, far, outer)[0])


def colors_over(tables: MeanTables, over: OverRange, channels: slice) -> list[Float[Array, "*any"]]:
    """Mean colours over a range, by extinction; none where there is nothing."""
    light = _means(range(*channels.indices(EXTINCTION)), tables, over.near, over.far, over.outer)
    return [clamped(ratio(emission, over.extinction), 0, 1) for emission in light]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _means(rows: range, tables: MeanTables, near: Array, far: Array, outer: Outer | None) -> list[Array]:
    return _over_all_pieces(rows, tables, near, far) if outer is None else _over_outer_pieces(rows, tables, outer)


@_means.defjvp
@as_usual()
def _means_moved(rows: range, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[list[Array], list[Array]]:
    moved = jax.jvp(functools.partial(_smooth_means, rows), primals[:3], tangents[:3])[1]
    return _means(rows, *primals), moved


def _over_all_pieces(rows: range, tables: MeanTables, near: Array, far: Array) -> list[Array]:
    """For few control points: the sum over all pieces, most of which have no width, vectorises."""
    points, last = tables.points, tables.points.shape[0] - 1
    lo, hi = ordered(near * tables.unit, far * tables.unit, 1)
    below, above, start, stop = split(lo, hi, points[0], points[-1])
    totals, begin = [jnp.zeros_like(lo) for _ in rows], start
    for k in range(last):
        end = lesser(stop, greater(start, points[k + 1])) if k + 1 < last else stop
        width = end - begin
        middle = (begin - points[k]) + width / 2
        line = [base + slope * middle for base, slope in zip(tables.base[:, k], tables.slope[:, k], strict=True)]
        weight, cube = width * line[EXTINCTION], width * width * width
        for n, row in enumerate(rows):
            added = weight if row == EXTINCTION else weight * line[row] + cube * tables.bend[row, k]
            totals[n] = totals[n] + added
        begin = end
    share = 1 / (hi - lo)
    below, above = below * share, above * share
    return [
        total * share + below * beyond(tables, row, 0) + above * beyond(tables, row, -1)
        for row, total in zip(rows, totals, strict=True)
    ]


def outer_pieces(tables: MeanTables, near: Array, far: Array) -> Outer | None:
    """What is found once of ranges; for few control points nothing."""
    if tables.points.shape[0] <= FEW:
        return None
    still = lax.stop_gradient((tables, near, far))
    return lax.cond(tables.segments.even, _of_even_pieces, _of_uneven_pieces, *still)  # type: ignore[no-any-return]


def _of_even_pieces(tables: MeanTables, near: Array, far: Array) -> Outer:
    """For evenly spaced control points: places are counted in pieces, no control point is read."""
    values, count = tables.segments.start, tables.points.shape[0] - 1
    rate = count / (values[-1] - values[0])
    lo, hi = ordered((near - values[0]) * rate, (far - values[0]) * rate, count)
    below, above, start, stop = split(lo, hi, jnp.zeros_like(rate), jnp.full_like(rate, count))
    i, j = (jnp.clip(place.astype(jnp.int32), 0, count) for place in (start, stop))
    begin = start - i.astype(lo.dtype)
    first = lesser(1, stop - i.astype(lo.dtype)) - begin
    last = jnp.where(i == j, 0, stop - j.astype(lo.dtype))
    return _outer((i, j), begin, first, last, (below, above), hi - lo)


def _of_uneven_pieces(tables: MeanTables, near: Array, far: Array) -> Outer:
    """For any control points."""
    points = tables.points
    lo, hi = ordered(near * tables.unit, far * tables.unit, 1)
    below, above, start, stop = split(lo, hi, points[0], points[-1])
    i, j = (locate(tables.segments, place / tables.unit)[0] for place in (start, stop))
    first = lesser(at(points, jnp.minimum(i + 1, points.shape[0] - 1)), stop) - start
    last = jnp.where(i == j, 0, stop - at(points, j))
    return _outer((i, j), start - at(points, i), first, last, (below, above), hi - lo)


def _outer(
    pieces: tuple[Array, Array], begin: Array, first: Array, last: Array, outside: tuple[Array, Array], length: Array
) -> Outer:
    share = 1 / length
    below, above = (part * share for part in outside)
    return Outer(*pieces, together_of(begin + first / 2, first), together_of(last / 2, last), together_of(below, above), share)


def _over_outer_pieces(rows: range, tables: MeanTables, outer: Outer) -> list[Array]:
    """Means over the first and the last piece of ranges, and all between: every number of the tables is read once a kernel."""
    below, above = apart_of(outer.beyond)
    found = []
    for row in rows:
        total = integral_between(tables, row, outer.first, outer.last)
        for i, met in ((outer.first, outer.of_first), (outer.last, outer.of_last)):
            middle, width = apart_of(met)
            once, rising, bent = (at(power[row], i) for power in tables.curve)
            value = once + rising * middle
            if row != EXTINCTION:
                value = value + bent * (middle * middle + width * width / 12)
            total = total + width * value
        found.append(total * outer.share + below * beyond(tables, row, 0) + above * beyond(tables, row, -1))
    return found


Part = tuple[Array, list[Array], list[Array], tuple[Array, Array], tuple[Array, Array]]
"""What of a piece lies in a range: where the piece begins; base and slope of red, green, blue and extinction; positions of the
part's ends; and shares of the range before each of these, which move if they do."""


def _mean_of(part: Part, lo: Array, hi: Array, row: int) -> Array:
    """What a part adds to the mean from `lo` to `hi`."""
    point, bases, slopes, (begin, end), (before, after) = part
    weight = _moving((end - begin) / (hi - lo), after - before)
    width = _moving(end - begin, (after - before) * (hi - lo))
    middle = _moving((begin - point) + width / 2, lo + (before + after) / 2 * (hi - lo) - point)
    value, slope = bases[row] + slopes[row] * middle, slopes[row]
    if row == EXTINCTION:
        return weight * value
    extinction = bases[EXTINCTION] + slopes[EXTINCTION] * middle
    return weight * (value * extinction + slope * slopes[EXTINCTION] * width * width / 12)


def _smooth_means(rows: range, tables: MeanTables, near: Array, far: Array) -> list[Array]:
    """Means for their derivatives' sake; the values are right but for what rounding does to jumps."""
    near, far = (clamped(end * tables.unit, -FARTHEST, FARTHEST) for end in (near, far))
    middle, equal = 0.5 * (near + far), near == far  # where equal, each moves both by half
    lo, hi = (jnp.where(equal, middle, end(near, far)) for end in (lesser, greater))
    hi = widened(hi, 1)
    below, above, start, stop = split(lo, hi, tables.points[0], tables.points[-1])
    few = tables.points.shape[0] <= SELECT_ALL
    parts = (_all_parts if few else _outer_parts)(tables, lo, hi, start, stop)
    results = []
    for row in rows:
        total = _moving(below / (hi - lo), parts[0][-1][0]) * beyond(tables, row, 0)
        total += _moving(above / (hi - lo), 1 - parts[-1][-1][1]) * beyond(tables, row, -1)
        results.append(total + sum(_mean_of(part, lo, hi, row) for part in parts))
    if few:
        return results
    i, j = _found(tables, start, stop)
    after = jnp.minimum(i + 1, tables.points.shape[0] - 1)
    for n, row in enumerate(rows):  # with all between two pieces
        whole = sum(at(table[row], j) - at(table[row], after) for table in (tables.sums, tables.lost))
        results[n] = results[n] + jnp.where(j > after, whole, 0) / (hi - lo)
    return results


def _moving(value: Array, like: Array) -> Array:
    """`value`, with the derivatives of `like`."""
    return lax.stop_gradient(value) + (like - lax.stop_gradient(like))


def _share(point: Array, lo: Array, hi: Array, moves: Bool[Array, "..."]) -> Array:
    """Share of the range that lies before a control point, which moves in it or not."""
    share = (point - lo) / (hi - lo)
    return jnp.where(moves, share, lax.stop_gradient(share))


def _all_parts(tables: MeanTables, lo: Array, hi: Array, start: Array, stop: Array) -> list[Part]:
    points, last = tables.points, tables.points.shape[0] - 1
    jump = jnp.pad(tables.inverse[:-1] == 0, 1)
    shares = [clamped(_share(points[k], lo, hi, jump[k] | jump[k + 1]), 0, 1) for k in range(last + 1)]
    places = [clamped(point, start, stop) for point in points]
    pairs = [(k, min(k + 1, last)) for k in range(max(last, 1))]
    return [
        (points[k], list(tables.base[:, k]), list(tables.slope[:, k]), (places[k], places[n]), (shares[k], shares[n]))
        for k, n in pairs
    ]


def _found(tables: MeanTables, start: Array, stop: Array) -> list[Array]:
    return [locate(tables.segments, lax.stop_gradient(place / tables.unit))[0] for place in (start, stop)]


def _outer_parts(tables: MeanTables, lo: Array, hi: Array, start: Array, stop: Array) -> list[Part]:
    points, count = tables.points, tables.points.shape[0]
    i, j = _found(tables, start, stop)
    after = jnp.minimum(i + 1, count - 1)
    same, apart = i == j, j > after
    begin, end = jnp.where(same, stop, at(points, j)), jnp.where(same, stop, at(points, after))
    limits = ((points[0], tables.inverse[0]), (points[-1], tables.inverse[-2]))
    first, last = (clamped(_share(point, lo, hi, inverse == 0), 0, 1) for point, inverse in limits)
    inner = [jnp.where(same, last, _share(at(points, k), lo, hi, apart)) for k in (after, j)]
    bases, slopes = ([[at(row, k) for row in table] for k in (i, j)] for table in (tables.base, tables.slope))
    return [
        (at(points, i), bases[0], slopes[0], (start, end), (first, inner[0])),
        (at(points, j), bases[1], slopes[1], (begin, stop), (inner[1], last)),
    ]
