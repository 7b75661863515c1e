"""Derivatives of means of a transfer function over ranges of the quantity.

Flow: tables -> [derivatives] -> means over ranges.

Moving the upper end of a range of length l changes the mean of f by (f(end) - mean) / l, which drowns in rounding where l is
short. So the mean is written with pieces that keep their shares of the range while it moves and stretches: what changes is the
value in their middles, by slopes. That pieces change their shares adds nothing where f is continuous, since what one loses the
next gains. Shares move only at jumps, and where whole pieces lie between the ends: such ranges are not short.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from jaxsph.engine.lookups.tables import EXTINCTION, FARTHEST, MeanTables, at, beyond, split, widened
from jaxsph.model.transfer.function import SELECT_ALL, locate


@dataclasses.dataclass(frozen=True)
class Part:
    """What of a piece lies in a range.

    Attributes:
        point: where the piece begins.
        base, slope: of red, green, blue and extinction.
        ends: positions of the part.
        shares: of the range before each end; they move if the ends do.
    """

    point: Array
    base: list[Array]
    slope: list[Array]
    ends: tuple[Array, Array]
    shares: tuple[Array, Array]

    def mean(self, lo: Array, hi: Array, row: int) -> Array:
        """What it adds to the mean from `lo` to `hi`."""
        (begin, end), (before, after) = self.ends, self.shares
        weight = _moving((end - begin) / (hi - lo), after - before)
        width = _moving(end - begin, (after - before) * (hi - lo))
        middle = _moving((begin - self.point) + width / 2, lo + (before + after) / 2 * (hi - lo) - self.point)
        value, slope = self.base[row] + self.slope[row] * middle, self.slope[row]
        if row == EXTINCTION:
            return weight * value
        extinction = self.base[EXTINCTION] + self.slope[EXTINCTION] * middle
        return weight * (value * extinction + slope * self.slope[EXTINCTION] * width * width / 12)


def smooth_means(rows: range, tables: MeanTables, near: Array, far: Array) -> list[Array]:
    """Means for their derivatives' sake; the values are right but for what rounding does to jumps."""
    lo, hi = _symmetric_ends(tables, near, far)
    below, above, start, stop = split(lo, hi, tables.points[0], tables.points[-1])
    few = tables.points.shape[0] <= SELECT_ALL
    parts = (_all_parts if few else _outer_parts)(tables, lo, hi, start, stop)
    results = []
    for row in rows:
        total = _moving(below / (hi - lo), parts[0].shares[0]) * beyond(tables, row, 0)
        total += _moving(above / (hi - lo), 1 - parts[-1].shares[1]) * beyond(tables, row, -1)
        results.append(total + sum(part.mean(lo, hi, row) for part in parts))
    if few:
        return results
    i, j = _found(tables, start, stop)
    return [total + _whole(tables, row, i, j) / (hi - lo) for row, total in zip(rows, results, strict=True)]


def _symmetric_ends(tables: MeanTables, near: Array, far: Array) -> tuple[Array, Array]:
    """Positions of both ends; where they are equal, each moves both by half."""
    near, far = (jnp.clip(end * tables.unit, -FARTHEST, FARTHEST) for end in (near, far))
    return jnp.minimum(near, far), widened(jnp.maximum(near, far), 1)


def _moving(value: Array, like: Array) -> Array:
    """`value`, with the derivatives of `like`."""
    return lax.stop_gradient(value) + (like - lax.stop_gradient(like))


def _share(point: Array, lo: Array, hi: Array, moves: Bool[Array, "..."]) -> Array:
    """Share of the range that lies before a control point, which moves in it or not."""
    share = (point - lo) / (hi - lo)
    return jnp.where(moves, share, lax.stop_gradient(share))


def _all_parts(tables: MeanTables, lo: Array, hi: Array, start: Array, stop: Array) -> list[Part]:
    """All pieces of few control points."""
    points, last = tables.points, tables.points.shape[0] - 1
    jump = jnp.pad(tables.inverse[:-1] == 0, 1)
    shares = [jnp.clip(_share(points[k], lo, hi, jump[k] | jump[k + 1]), 0, 1) for k in range(last + 1)]
    places = [jnp.clip(point, start, stop) for point in points]
    pairs = [(k, min(k + 1, last)) for k in range(max(last, 1))]
    return [
        Part(points[k], list(tables.base[:, k]), list(tables.slope[:, k]), (places[k], places[n]), (shares[k], shares[n]))
        for k, n in pairs
    ]


def _found(tables: MeanTables, start: Array, stop: Array) -> list[Array]:
    """Pieces of both ends."""
    return [locate(tables.segments, lax.stop_gradient(place / tables.unit))[0] for place in (start, stop)]


def _outer_parts(tables: MeanTables, lo: Array, hi: Array, start: Array, stop: Array) -> list[Part]:
    """The first and the last piece."""
    points, count = tables.points, tables.points.shape[0]
    i, j = _found(tables, start, stop)
    after = jnp.minimum(i + 1, count - 1)
    same, apart = i == j, j > after
    begin, end = jnp.where(same, stop, at(points, j)), jnp.where(same, stop, at(points, after))
    limits = ((points[0], tables.inverse[0]), (points[-1], tables.inverse[-2]))
    first, last = (jnp.clip(_share(point, lo, hi, inverse == 0), 0, 1) for point, inverse in limits)
    inner = [jnp.where(same, last, _share(at(points, k), lo, hi, apart)) for k in (after, j)]
    bases, slopes = ([[at(row, k) for row in table] for k in (i, j)] for table in (tables.base, tables.slope))
    return [
        Part(at(points, i), bases[0], slopes[0], (start, end), (first, inner[0])),
        Part(at(points, j), bases[1], slopes[1], (begin, stop), (inner[1], last)),
    ]


def _whole(tables: MeanTables, row: int, i: Array, j: Array) -> Array:
    """Integral over the pieces between two."""
    after = jnp.minimum(i + 1, tables.points.shape[0] - 1)
    integral = sum(at(table[row], j) - at(table[row], after) for table in (tables.sums, tables.lost))
    return jnp.where(j > after, integral, 0)
