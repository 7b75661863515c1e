r"""What the samples of a bundle can see: certified bounds of the quantity and of the optics at every depth.

Flow: transfer function, cells -> [bounds] -> errors -> adapt -> cast -> image.

CSPH values are affine combinations of the quantities of the particles whose supports hold the sample, so the least and the
greatest quantity among the particles whose spheres meet a *sample slab* (the footprint of the bundle, between two borders of
fine samples) bound every sample in it, wherever it lies: fine ones, and coarse ones, which lie on the slab's border
(Hochstetter et al. 2016, section 4.1, over the whole slab instead of at one depth). A slab is *covered* when each of its
sub-rectangles lies inside the support of a single particle; in any other, a sample may be empty.

Why the bounds hold in floating point: a sphere counts as meeting the slab with its `reach`, outside which computed weights are
zero; it counts as holding a sub-rectangle with `2 H - reach`, inside of which the computed weight is positive, if the particle
is `SOLID` enough for that not to underflow. Boxes are made of the very numbers that the cast multiplies, and rounding is
monotone. Sums are taken of quantities relative to that of a particle near by: a quotient of two computed sums of n terms is
off by less than (n + 6) eps of how far quantities are from that reference, and adding it rounds once more.

Optics follow from the quantity by the ranges of the transfer function over intervals: a piecewise linear function on $[a, b]$ is
extreme at a, at b, or at a control point between. A sparse table (the extremes of every run of $2^k$ control points) gives the
latter from two overlapping runs: O(K log K) memory, O(1) a query.

Shapes, once: the last axis is bundles (times slabs of a cell), which vectorises.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import CELL_SAMPLES
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.access.precision import sum_rounding
from jaxsph.engine.access.view import Ordered
from jaxsph.engine.field.sums import particle_at
from jaxsph.model.transfer.function import SELECT_ALL, Segments, TransferFunction, look_up
from jaxsph.numerics.compiled import extent, fusion_barrier
from jaxsph.numerics.trees import tree

PARTICLES = 8  # unrolled in the inner loop; longer chains do not vectorise
COVERERS = 96  # particles in the middle of a window, that is nearest in depth, among which coverage is sought
SOLID = 0.01  # least `size`, as a share of the largest, for which weights just inside the support are far above underflow
EXTINCTION = 3  # channel, after those of colours
ROUNDING = 8  # eps: a looked up value is a sum and a product away from its control points
ROUNDING_OF_PLACE = 16  # eps of the largest value: where evenly spaced points are taken to lie


@tree()
class SampleBounds:
    """Bounds over each sample slab, for all rays of a bundle.

    Attributes:
        touched: whether a particle meets the slab; if not, every sample in it is empty.
        covered: whether no sample in it can be empty.
        lo, hi: red, green, blue and extinction of samples that are not empty.
    """

    touched: Bool[Array, "samples bundles"]
    covered: Bool[Array, "samples bundles"]
    lo: list[Float[Array, "samples bundles"]]
    hi: list[Float[Array, "samples bundles"]]


@tree()
class Spheres:
    """Particles in rank order: centres, reciprocals of outer and inner radii (infinite where they do not count), quantities.

    The latter are one array or two, see `access.view.Columns`.
    """

    x: Float[Array, " particles"]
    y: Float[Array, " particles"]
    z: Float[Array, " particles"]
    outer: Float[Array, " particles"]
    inner: Float[Array, " particles"]
    quantities: tuple[Float[Array, " particles"], ...]


def spheres(ordered: Ordered, inverse_radii: tuple[Array, Array] | None = None) -> Spheres:
    """Outside `1 / outer` a particle's computed weight is zero, inside `1 / inner` it is positive; found if not given."""
    outer, inner = inverse_radii or inverse_radii_of(ordered)
    return Spheres(ordered.x, ordered.y, ordered.z, outer, inner, ordered.quantities)


def inverse_radii_of(ordered: Ordered) -> tuple[Float[Array, " particles"], Float[Array, " particles"]]:
    """Reciprocals of outer and inner radii."""
    outer = jnp.where(ordered.size > 0, 1 / ordered.reach, jnp.inf)
    inner = 2 * ordered.size / jnp.where(ordered.scale > 0, ordered.scale, 1) - ordered.reach
    solid = (ordered.size > SOLID * jnp.maximum(extent(ordered.size, ordered.size > 0)[1], 0)) & (inner > 0)
    return outer, jnp.where(solid, 1 / jnp.where(solid, inner, 1), jnp.inf)


def sample_bounds(
    balls: Spheres,
    rank: Int[Array, " pairs"],
    window: tuple[Int[Array, "classes bundles"], Int[Array, "classes bundles"]],
    footprint: tuple[Float[Array, "8 bundles"], Float[Array, "8 bundles"]],
    front: Float[Array, "samples bundles"],
    back: Float[Array, "samples bundles"],
    references: tuple[tuple[Float[Array, " bundles"], Float[Array, " bundles"]], ...],
    tables: tuple[RangeTables, ...],
    perspective: bool,
    subdivisions: int,
) -> SampleBounds:
    """Bounds for samples that lie at any depths from `front` to `back`, from the particles of a window.

    Args:
        footprint: ray coordinates of each bundle's columns and of its rows, ascending.
        references: of each quantity, the least and the greatest that the sums of these samples may be taken relative to.
        tables: of the parts of the transfer function.
        subdivisions: sub-rectangles on each side of the footprint, for the test of coverage.
    """
    lateral_scales = (front[0], back[-1]) if perspective else (jnp.ones_like(front[0]),) * 2
    total = window[1].sum(0)
    (samples, bundles), dtype = front.shape, front.dtype
    box, boxes = ([_boxes(rays, lateral_scales, parts) for rays in footprint] for parts in (1, subdivisions))
    sides = jnp.asarray([-1, 1], dtype)[:, None, None]
    one_block = jnp.arange(PARTICLES, dtype=jnp.int32)[:, None]

    def add_nearest(block: Array, outermost: tuple[Array, ...]) -> tuple[Array, ...]:
        ball = fusion_barrier(block >= 0, _fetch, balls, rank, window, block * PARTICLES + one_block)
        near, near_depth = fusion_barrier(block >= 0, _nearest, ball, box, front, back)
        for k in range(PARTICLES):
            meets = near[k] + near_depth[k] <= 1
            ends = [jnp.where(meets, sides * quantity[k], -jnp.inf) for quantity in ball.quantities]
            outermost = tuple(map(jnp.maximum, outermost, ends))
        return outermost

    def add_farthest(block: Array, farthest: Array) -> Array:
        index = jnp.maximum(total // 2 - COVERERS // 2, 0) + block * PARTICLES + one_block
        ball = fusion_barrier(block >= 0, _fetch, balls, rank, window, index)
        column, row, depth = fusion_barrier(block >= 0, _farthest, ball, boxes, front, back)
        for k in range(PARTICLES):
            farthest = jnp.minimum(farthest, depth[k][:, None, None] + (row[k][:, None] + column[k]))
        return farthest

    fullest = total.max()
    outermost = (jnp.full((2, samples, bundles), -jnp.inf, dtype),) * len(balls.quantities)
    outermost = lax.fori_loop(0, (fullest + PARTICLES - 1) // PARTICLES, add_nearest, outermost)
    farthest = jnp.full((samples, subdivisions, subdivisions, bundles), jnp.inf, dtype)
    enough = jnp.minimum(fullest, COVERERS)
    farthest = lax.fori_loop(0, (enough + PARTICLES - 1) // PARTICLES, add_farthest, farthest)
    touched = outermost[0][1] > -jnp.inf
    quantities = [
        rounded_range(touched, -low, high, reference, total) for (low, high), reference in zip(outermost, references, strict=True)
    ]
    least, greatest = ranges_of_parts(tables, quantities)
    return SampleBounds(touched, touched & (farthest < 1).all((1, 2)), least, greatest)


def cell_bounds(
    balls: Spheres,
    rank: Int[Array, " pairs"],
    windows: list[Int[Array, "classes slabs bundles"]],
    depths: tuple[Float[Array, " samples"], Float[Array, " samples"]],
    cells: tuple[Array, Array, Array],
    rays: tuple[Array, Array],
    references: list[tuple[Array, Array]],
    tables: tuple[RangeTables, ...],
    slab_samples: int,
    subdivisions: int,
    perspective: bool,
) -> SampleBounds:
    """Bounds of all samples of some cells, (16, cells).

    Args:
        depths: where each sample of a ray may lie, from and to.
        cells: number, bundle and whether it is wanted.
        rays: ray coordinates of the cells' bundles, see `Grid.rays`.
    """
    (cell, bundle, real), (u, v), per_cell = cells, rays, CELL_SAMPLES // slab_samples
    slab = (cell * per_cell + jnp.arange(per_cell, dtype=jnp.int32)[:, None]).reshape(-1)
    begin, length = (value[:, slab, jnp.tile(bundle, per_cell)] for value in windows)
    window = begin, jnp.where(jnp.tile(real, per_cell), length, 0)
    front, back = (depth[slab * slab_samples + jnp.arange(slab_samples, dtype=jnp.int32)[:, None]] for depth in depths)
    footprint = jnp.tile(u, per_cell), jnp.tile(v[::-1], per_cell)
    several = tuple(jax.tree.map(lambda end: jnp.tile(end, per_cell), references))
    bounds = sample_bounds(balls, rank, window, footprint, front, back, several, tables, perspective, subdivisions)

    def by_samples(value: Array) -> Array:
        """(samples of a slab, slabs of cells) to (samples of a cell, cells)."""
        return jnp.moveaxis(value.reshape(slab_samples, per_cell, -1), 1, 0).reshape(CELL_SAMPLES, -1)

    return jax.tree.map(by_samples, bounds)


def rounded_range(touched: Array, lo: Array, hi: Array, reference: tuple[Array, Array], terms: Array) -> tuple[Array, Array]:
    """Least and greatest value that a computed mean of so many terms can have, of quantities between `lo` and `hi`."""
    lo, hi = jnp.where(touched, lo, 0), jnp.where(touched, hi, 0)
    eps = jnp.finfo(lo.dtype).eps
    farthest_off = jnp.maximum(jnp.maximum(hi - reference[0], reference[1] - lo), 0)
    rounding = sum_rounding(terms, lo.dtype) * farthest_off + 2 * eps * jnp.maximum(jnp.abs(lo), jnp.abs(hi))
    return lo - rounding, hi + rounding


def _boxes(rays: Array, lateral_scales: tuple[Array, Array], parts: int) -> tuple[Array, Array]:
    """Least and greatest view coordinate of each part of the footprint, (parts, bundles)."""
    first, last = rays[:: BUNDLE // parts], rays[BUNDLE // parts - 1 :: BUNDLE // parts]
    near, far = lateral_scales
    return jnp.minimum(near * first, far * first), jnp.maximum(near * last, far * last)


def _fetch(balls: Spheres, rank: Array, window: tuple[Array, Array], index: Array) -> Spheres:
    """A block of particles of each bundle's windows; past the last they do not count."""
    particle, inside = fusion_barrier(index[0, 0] >= 0, particle_at, rank, *window, index)
    found = jax.tree.map(lambda column: column.at[particle].get(mode="promise_in_bounds"), balls)
    outer, inner = (jnp.where(inside, inverse, jnp.inf) for inverse in (found.outer, found.inner))
    return dataclasses.replace(found, outer=outer, inner=inner)


def _nearest(ball: Spheres, boxes: list[tuple[Array, Array]], front: Array, back: Array) -> tuple[Array, Array]:
    """Squared distances, in outer radii, to the nearest points of slabs: across (particles, bundles) and along depth."""
    (left, right), (bottom, top) = boxes
    x = jnp.maximum(jnp.maximum(left - ball.x, ball.x - right), 0)
    y = jnp.maximum(jnp.maximum(bottom - ball.y, ball.y - top), 0)
    z = ball.z[:, None]
    z = jnp.maximum(jnp.maximum(front - z, z - back), 0)
    return _square(x, ball.outer) + _square(y, ball.outer), _square(z, ball.outer[:, None])


def _farthest(ball: Spheres, boxes: list[tuple[Array, Array]], front: Array, back: Array) -> tuple[Array, ...]:
    """Squared distances, in inner radii, to the farthest points of parts of slabs: across columns, rows, and along depth."""
    places = [(ball.x, *boxes[0]), (ball.y, *boxes[1]), (ball.z, front, back)]
    inner = ball.inner[:, None]
    column, row, depth = (_square(jnp.maximum(place[:, None] - low, high - place[:, None]), inner) for place, low, high in places)
    return column, row, depth


def _square(distance: Array, inverse: Array) -> Array:
    """(distance / radius)^2, infinite where the particle does not count."""
    share = distance * jnp.minimum(inverse, jnp.finfo(inverse.dtype).max)
    return jnp.where(inverse < jnp.inf, share * share, jnp.inf)


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
    lo, hi = lo - tables.fuzz, hi + tables.fuzz
    at_lo, at_hi = look_up(tables.segments, lo), look_up(tables.segments, hi)
    ends = [(jnp.minimum(one, other), jnp.maximum(one, other)) for one, other in zip(at_lo, at_hi, strict=True)]
    points = tables.values.shape[0]
    among = _each_point if points <= SELECT_ALL else _runs_of_points
    ends = among(tables, lo - tables.fuzz, hi + tables.fuzz, ends)
    rounding = ROUNDING * jnp.finfo(lo.dtype).eps * tables.scale
    least = [jnp.maximum(low - off, 0) for (low, _), off in zip(ends, rounding, strict=True)]
    return least, [high + off for (_, high), off in zip(ends, rounding, strict=True)]


Ends = list[tuple[Array, Array]]


def _each_point(tables: RangeTables, lo: Array, hi: Array, ends: Ends) -> Ends:
    """Ranges of all channels with the control points between `lo` and `hi`, of few: a chain of selects vectorises."""
    for nth in range(tables.values.shape[0]):
        inside = (tables.values[nth] >= lo) & (tables.values[nth] <= hi)
        here = tables.lo[:, nth]
        ends = [
            (jnp.where(inside, jnp.minimum(low, own), low), jnp.where(inside, jnp.maximum(high, own), high))
            for (low, high), own in zip(ends, here, strict=True)
        ]
    return ends


def _runs_of_points(tables: RangeTables, lo: Array, hi: Array, ends: Ends) -> Ends:
    """The same of many, by two overlapping runs."""
    points = tables.values.shape[0]
    first = jnp.searchsorted(tables.values, lo, side="left", method="scan_unrolled").astype(jnp.int32)
    past = jnp.searchsorted(tables.values, hi, side="right", method="scan_unrolled").astype(jnp.int32)
    inside = past > first
    run = 31 - lax.clz(jnp.maximum(past - first, 1))
    front = jnp.minimum(run * points + first, tables.lo.shape[1] - 1)
    back = run * points + jnp.maximum(past - (1 << run), 0)
    found = []
    for channel, (low, high) in enumerate(ends):
        lows, highs = (
            [row[channel].at[i].get(mode="promise_in_bounds") for i in (front, back)] for row in (tables.lo, tables.hi)
        )
        found.append(
            (
                jnp.where(inside, jnp.minimum(low, jnp.minimum(*lows)), low),
                jnp.where(inside, jnp.maximum(high, jnp.maximum(*highs)), high),
            )
        )
    return found
