r"""Means of a transfer function over ranges of the quantity: pre-integration (Engel, Kraus & Ertl 2001) without attenuation.

Flow: transfer -> [means over ranges] -> cast -> image.

Where the quantity runs linearly from $a$ to $b$, the mean of an optical property $f$ on the way is $\int_a^b f(Q) dQ / (b - a)$.
Colour and extinction are linear between control points, so there the mean of extinction is its value in the middle, and that of
$f = c s$ over a width $w$ is $c_m s_m + c' s' w^2 / 12$ with the values $c_m$, $s_m$ in the middle: of one sign, as is the sum
over pieces. Nothing cancels, however short the range is.

A range is widened at its upper end by a few roundings of it, as if the quantity were off by so much: no range is then empty.
What lies beyond the control points counts with its true length and the value at the end.

Differentiation: moving an end weighs slopes, not differences of values, which would drown in rounding where ranges are short.
The rule is the derivative of the same mean written with pieces at fixed shares of the range; only jumps move in it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.model.transfer import SELECT_ALL, Segments, locate

WIDENED = 4  # eps of its upper end, and of the control points', that a range is widened by
FARTHEST = 2.0**120  # times the largest control point: where quantities are clamped, such that nothing overflows
EXTINCTION = slice(3, 4)


@dataclasses.dataclass(frozen=True)
class MeanTables:
    """A transfer function prepared for means: made once, outside of loops.

    Positions are quantities times a power of two, such that the largest control point is about 1.

    Attributes:
        segments: what control points are found by.
        unit: positions a unit of the quantity.
        points: positions of control points.
        inverse: 1 / the width of pieces, 0 for jumps (with what is as good as one) and beyond the last control point.
        base, change: at the beginning of a piece, and over it; jumps have their mean, and change by nothing.
        slope: change by position.
        before: integrals over the pieces before, of red, green, blue emission and extinction, and their rounding errors as
            imaginary part; `evenly_before` the same by number of pieces. Empty for few control points.
    """

    segments: Segments
    unit: Float[Array, ""]
    points: Float[Array, " points"]
    inverse: Float[Array, " points"]
    base: Float[Array, "4 points"]
    change: Float[Array, "4 points"]
    slope: Float[Array, "4 points"]
    before: Array
    evenly_before: Array

    @classmethod
    def of(cls, segments: Segments) -> MeanTables:
        """Of a transfer function's segments."""
        values = segments.start
        eps = jnp.finfo(values.dtype).eps
        largest = jnp.abs(values).max()
        exponent = jnp.where(largest > 0, jnp.frexp(lax.stop_gradient(largest))[1], 0)
        unit = jnp.ldexp(jnp.ones((), values.dtype), jnp.clip(-exponent, -120, 120))
        points = values * unit
        width = jnp.append(points[1:] - points[:-1], 0)
        wide = width > eps**2
        inverse = jnp.where(wide, 1 / jnp.where(wide, width, 1), 0)
        base = jnp.where(wide, segments.base, segments.base + segments.change / 2)
        change = jnp.where(wide, segments.change, 0)
        before = evenly_before = jnp.zeros((4, 0), jnp.result_type(values.dtype, jnp.complex64))
        if values.shape[0] > SELECT_ALL:
            means = _whole(base, change)
            before, evenly_before = _sums_before(means * width), _sums_before(means)
        return cls(segments, unit, points, inverse, base, change, change * inverse, before, evenly_before)


def _whole(base: Array, change: Array) -> Array:
    """Means over whole pieces: of the emission of three colours, and of extinction."""
    middle = base + change / 2
    return middle * jnp.append(middle[3:].repeat(3, 0), jnp.ones_like(middle[3:]), 0) + jnp.append(
        change[:3] * change[3:] / 12, jnp.zeros_like(change[3:]), 0
    )


def _sums_before(terms: Float[Array, "rows points"]) -> Array:
    """Sums of the terms before each, as complex numbers: rounded, and what rounding lost (two-sum; Knuth 1969)."""

    def add(total: tuple[Array, Array], term: Array) -> tuple[tuple[Array, Array], Array]:
        old, lost = total
        new = old + term
        added = new - old
        lost = lost + ((old - (new - added)) + (term - added))
        return (new, lost), lax.complex(*total)

    nothing = jnp.zeros_like(terms[:, 0])
    return lax.scan(add, (nothing, nothing), terms.T)[1].T


def mean_extinction(tables: MeanTables, near: Float[Array, "*any"], far: Float[Array, "*any"]) -> Float[Array, "*any"]:
    """Mean of extinction over the quantities between `near` and `far`, in any order; see the module for its error."""
    return _mean(tables, near, far, EXTINCTION)[0]


def mean_emission(
    tables: MeanTables, near: Float[Array, "*any"], far: Float[Array, "*any"], channels: slice
) -> list[Float[Array, "*any"]]:
    """Means of colour times extinction over the quantities between `near` and `far`, of some of red, green and blue."""
    return _mean(tables, near, far, slice(*channels.indices(3)))


def _mean(tables: MeanTables, near: Array, far: Array, channels: slice) -> list[Array]:
    return _means(tables, near, far, (channels.start, channels.stop, channels.step or 1))


def _means_of(tables: MeanTables, near: Array, far: Array, rows: tuple[int, int, int]) -> list[Array]:
    few = tables.points.shape[0] <= SELECT_ALL
    if few:
        return _few(tables, *_ends(tables, near, far), list(range(*rows)))
    return lax.cond(
        tables.segments.even,
        lambda *given: _many_even(*given, list(range(*rows))),
        lambda *given: _many(*given, list(range(*rows))),
        tables,
        near,
        far,
    )


_means = jax.custom_jvp(_means_of, nondiff_argnums=(3,))


@_means.defjvp
def _means_moved(rows, primals, tangents):
    smooth = lambda *given: _smooth(*given, list(range(*rows)))
    return _means(*primals, rows), jax.jvp(smooth, primals, tangents)[1]


def _position(tables: MeanTables, quantity: Array) -> Array:
    return jnp.clip(quantity * tables.unit, -FARTHEST, FARTHEST)


def _ends(tables: MeanTables, near: Array, far: Array) -> tuple[Array, Array]:
    """Positions of the lower and the upper end, widened."""
    near, far = _position(tables, near), _position(tables, far)
    return jnp.minimum(near, far), _widened(jnp.maximum(near, far), 1)


def _widened(end: Array, reach: float) -> Array:
    return end + lax.stop_gradient(WIDENED * jnp.finfo(end.dtype).eps * (jnp.abs(end) + reach))


def _outside(lo: Array, hi: Array, first: Array, last: Array) -> tuple[Array, Array, Array, Array]:
    """Lengths below and above the control points, and the ends of what lies among them."""
    low, high = jnp.minimum(lo, first), jnp.maximum(hi, last)
    below, above = jnp.minimum(hi, first) - low, high - jnp.maximum(lo, last)
    return below, above, jnp.clip(lo, first, last), jnp.clip(hi, first, last)


def _few(tables: MeanTables, lo: Array, hi: Array, rows: list[int]) -> list[Array]:
    """For few control points: the sum over all pieces."""
    points = tables.points
    below, above, start, stop = _outside(lo, hi, points[0], points[-1])
    totals = [jnp.zeros_like(lo) for _ in rows]
    begin = start
    for k in range(points.shape[0] - 1):
        end = jnp.minimum(jnp.maximum(points[k + 1], start), stop) if k + 2 < points.shape[0] else stop
        width = end - begin
        middle = (begin - points[k]) + width / 2
        weight, cube = width, width * width * width
        if rows[0] < 3:
            weight = weight * (tables.base[3, k] + tables.slope[3, k] * middle)
        for row, channel in enumerate(rows):
            totals[row] = totals[row] + weight * (tables.base[channel, k] + tables.slope[channel, k] * middle)
            if channel < 3:
                totals[row] = totals[row] + cube * (tables.slope[channel, k] * tables.slope[3, k] / 12)
        begin = end
    share = 1 / (hi - lo)
    return [
        total * share + (below * share) * _value(tables, c, 0) + (above * share) * _value(tables, c, -1)
        for c, total in zip(rows, totals, strict=True)
    ]


def _value(tables: MeanTables, channel: int, point: int) -> Array:
    """Emission or extinction beyond the first (0) or the last (-1) control point."""
    base = tables.segments.base[:, point]
    return base[channel] * base[3] if channel < 3 else base[channel]


def _at(row: Array, i: Array) -> Array:
    return row.at[i].get(mode="promise_in_bounds")


def _over(line: Callable[[int, Array], Array], piece: tuple[Array, Array, Array], rows: list[int]) -> list[Array]:
    """Means over a part of a piece."""
    i, middle, width = piece
    lines = {channel: line(channel, i) for channel in {*rows, *([3] if rows[0] < 3 else [])}}
    values = {channel: two.real + two.imag * middle for channel, two in lines.items()}
    if rows == [3]:
        return [values[3]]
    square = width * width * (1 / 12)
    return [values[c] * values[3] + lines[c].imag * lines[3].imag * square for c in rows]


def _lines(tables: MeanTables) -> Callable[[int, Array], Array]:
    packed = lax.complex(tables.base, tables.change)
    return lambda channel, i: _at(packed[channel], i)


def _many_even(tables: MeanTables, near: Array, far: Array, rows: list[int]) -> list[Array]:
    """For evenly spaced control points: positions are counted in pieces."""
    values = tables.segments.start
    count = values.shape[0] - 1
    rate = count / (values[-1] - values[0])
    near, far = (jnp.clip((q - values[0]) * rate, -FARTHEST, FARTHEST) for q in (near, far))
    lo, hi = jnp.minimum(near, far), _widened(jnp.maximum(near, far), count)
    below, above, start, stop = _outside(lo, hi, jnp.zeros_like(rate), jnp.full_like(rate, count))
    i, j = (jnp.clip(place.astype(jnp.int32), 0, count) for place in (start, stop))
    begin, end = i.astype(lo.dtype), j.astype(lo.dtype)
    first = jnp.minimum(stop, begin + 1) - start
    last = jnp.where(i == j, 0, stop - end)
    pieces = ((i, (start - begin) + first / 2, first), (j, last / 2, last))
    return _joined(tables, rows, tables.evenly_before, pieces, (below, first, last, above), 1 / (hi - lo))


def _many(tables: MeanTables, near: Array, far: Array, rows: list[int]) -> list[Array]:
    """For any control points."""
    points = tables.points
    lo, hi = _ends(tables, near, far)
    below, above, start, stop = _outside(lo, hi, points[0], points[-1])
    i, j = (locate(tables.segments, place / tables.unit)[0] for place in (start, stop))
    begin, end = _at(points, i), _at(points, j)
    first = jnp.minimum(stop, _at(points, jnp.minimum(i + 1, points.shape[0] - 1))) - start
    last = jnp.where(i == j, 0, stop - end)
    inverses = _at(tables.inverse, i), _at(tables.inverse, j)
    pieces = (
        (i, ((start - begin) + first / 2) * inverses[0], first * inverses[0]),
        (j, ((stop - end) - last / 2) * inverses[1], last * inverses[1]),
    )
    return _joined(tables, rows, tables.before, pieces, (below, first, last, above), 1 / (hi - lo))


def _joined(tables, rows, before, pieces, lengths, share) -> list[Array]:
    """Means of what lies below, in the first piece, in whole pieces, in the last piece, and above."""
    (i, *_), (j, *_) = pieces
    below, first, last, above = lengths
    line = _lines(tables)
    of_first, of_last = (_over(line, piece, rows) for piece in pieces)
    result = []
    for c, one, two in zip(rows, of_first, of_last, strict=True):
        between = _at(before[c], j) - _at(before[c], jnp.minimum(i + 1, tables.points.shape[0] - 1))
        between = jnp.where(i == j, 0, between.real + between.imag)
        inner = (first * one + between + last * two) * share
        result.append(inner + (below * share) * _value(tables, c, 0) + (above * share) * _value(tables, c, -1))
    return result


def _smooth(tables: MeanTables, near: Array, far: Array, rows: list[int]) -> list[Array]:
    """The same means, with pieces at fixed shares of the range unless there are jumps or whole pieces: for derivatives."""
    pieces = _few_pieces if tables.points.shape[0] <= SELECT_ALL else _many_pieces
    lo, hi = _ends(tables, near, far)
    below, above, start, stop = _outside(lo, hi, tables.points[0], tables.points[-1])
    parts, between = pieces(tables, lo, hi, start, stop)
    results = []
    for c in rows:
        total = _moving(below / (hi - lo), parts[0].shares[0]) * _value(tables, c, 0)
        total += _moving(above / (hi - lo), 1 - parts[-1].shares[1]) * _value(tables, c, -1)
        total += sum(_of_part(part, lo, hi, c) for part in parts)
        if between is not None:
            total += between(c) / (hi - lo)
        results.append(total)
    return results


@dataclasses.dataclass(frozen=True)
class _Part:
    """A part of a piece: the piece's beginning and lines; ends of the part, and their shares of the range, which may move."""

    point: Array
    base: Array | list[Array]
    slope: Array | list[Array]
    ends: tuple[Array, Array]
    shares: tuple[Array, Array]


def _moving(value: Array, like: Array) -> Array:
    """`value`, with the derivatives of `like`."""
    return lax.stop_gradient(value) + (like - lax.stop_gradient(like))


def _of_part(part: _Part, lo: Array, hi: Array, channel: int) -> Array:
    """What a part adds to a mean."""
    (begin, end), (before, after) = part.ends, part.shares
    weight = _moving((end - begin) / (hi - lo), after - before)
    width = _moving(end - begin, (after - before) * (hi - lo))
    place = _moving((begin - part.point) + (end - begin) / 2, lo + (before + after) / 2 * (hi - lo) - part.point)
    value = part.base[channel] + part.slope[channel] * place
    if channel < 3:
        value = value * (part.base[3] + part.slope[3] * place) + part.slope[channel] * part.slope[3] * width * width / 12
    return weight * value


def _few_pieces(tables: MeanTables, lo: Array, hi: Array, start: Array, stop: Array) -> tuple[list[_Part], None]:
    """All pieces; control points at jumps move through the range, others stay at their share of it."""
    count = tables.points.shape[0]
    jump = jnp.concatenate([jnp.zeros(1, bool), tables.inverse[:-1] == 0, jnp.zeros(1, bool)])
    shares, ends = [], []
    for k in range(count):
        share = jnp.clip((tables.points[k] - lo) / (hi - lo), 0, 1)
        shares.append(jnp.where(jump[k] | jump[k + 1], share, lax.stop_gradient(share)))
        ends.append(jnp.clip(tables.points[k], start, stop))
    last = max(count - 1, 1)
    return [
        _Part(
            tables.points[k],
            tables.base[:, k],
            tables.slope[:, k],
            (ends[k], ends[min(k + 1, count - 1)]),
            (shares[k], shares[min(k + 1, count - 1)]),
        )
        for k in range(last)
    ], None


def _many_pieces(tables: MeanTables, lo: Array, hi: Array, start: Array, stop: Array) -> tuple[list[_Part], Callable]:
    """The first and the last piece, and integrals over those between."""
    points, count = tables.points, tables.points.shape[0]
    i, j = (locate(tables.segments, lax.stop_gradient(place / tables.unit))[0] for place in (start, stop))
    after = jnp.minimum(i + 1, count - 1)
    same, apart = i == j, j > after
    limits = []
    for k, neighbour in ((0, 0), (count - 1, count - 2)):
        share = jnp.clip((points[k] - lo) / (hi - lo), 0, 1)
        limits.append(jnp.where(tables.inverse[neighbour] == 0, share, lax.stop_gradient(share)))
    inner = []
    for k in (after, j):
        share = (_at(points, k) - lo) / (hi - lo)
        inner.append(jnp.where(same, limits[1], jnp.where(apart, share, lax.stop_gradient(share))))
    end = jnp.where(same, stop, _at(points, after))
    begin = jnp.where(same, stop, _at(points, j))

    def part(k: Array, ends: tuple[Array, Array], shares: tuple[Array, Array]) -> _Part:
        base, slope = ([_at(row, k) for row in table] for table in (tables.base, tables.slope))
        return _Part(_at(points, k), base, slope, ends, shares)

    def between(channel: int) -> Array:
        sums = tables.before[channel]
        difference = _at(sums, j) - _at(sums, after)
        return jnp.where(same, 0, difference.real + difference.imag)

    return [part(i, (start, end), (limits[0], inner[0])), part(j, (begin, stop), (inner[1], limits[1]))], between


jax.tree_util.register_dataclass(MeanTables, data_fields=[f.name for f in dataclasses.fields(MeanTables)], meta_fields=[])
