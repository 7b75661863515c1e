r"""The pilot estimator: which slabs may be interpolated from the lattice, by how wrong that is estimated to be.

Flow: lattice -> [pilot] -> worklist -> cast -> image.

A cubic through four nodes errs by at most 3/128 of a fourth difference, about the middle between two nodes. So the lattice
tells how well it can be interpolated: fourth differences of $\sum q V W - Q \sum V W$ over $\sum V W$ are the error of Q, to
first order. It is a residual of no known sign, so it is treated as noise: its variance is the mean over the nodes of a slab,
its effect on light that times the mean square slope of the transfer function over the quantities met, and slabs' variances
add up along a bundle. `DEVIATIONS` standard deviations are the estimate. Narrow bands need no rule of their own: every sample
is shaded, and where Q meets a steep part, its mean square slope is large; a jump is never interpolated over.

This is an estimate, not a bound. The second paper's a-posteriori error (its section 4) takes the same view of a finite element:
the residual of the next order, weighted.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.access.grid import Grid
from jaxsph.access.lattice import NODE_PIXELS, NODE_SAMPLES, Lattice
from jaxsph.access.lists import BUNDLE
from jaxsph.control.worklist import Worklist, full_rate
from jaxsph.model.camera import Camera
from jaxsph.model.transfer import Segments, TransferFunction, look_up
from jaxsph.numerics.staging import computed_once

DEVIATIONS = 6.0  # standard deviations that pixels are taken to stay within
CUBIC = 3 / 128  # of a fourth difference: largest error of a cubic between its middle nodes
CLEAR = 12.0  # times its estimated error that the sum of weights is above zero wherever a slab is interpolated
RESOLVED = 1.5  # node spacings that a support must reach: some node is then well inside it, and its fourth differences show it
LEAST = 8  # eps: what interpolated samples differ by, at least
WORTHWHILE = 0.25  # least share of a band's work that the lattice must resolve: sampling it costs up to a tenth
HALVINGS = 24
ACROSS = BUNDLE // NODE_PIXELS
Combine = Callable[[Array, Array], Array]
REACH = 2  # nodes to either side that a fourth difference takes
GAP = REACH + 1  # nodes without anything past the last of a row: a fourth difference, and the far border of a slab


@dataclasses.dataclass(frozen=True)
class PilotPlan:
    """Static choices of the pilot estimator: none so far, but that it is wanted."""


def pilot(
    grid: Grid,
    lattice: Lattice,
    camera: Camera,
    transfer: TransferFunction,
    origin: Float[Array, "slabs bundles"],
    tolerance: Float[Array, ""],
    slab_samples: int,
) -> tuple[Worklist, Float[Array, " bundles"]]:
    """Choose the slabs that are interpolated: as many evaluations saved as the tolerance allows.

    Slabs whose stencils leave the band's lattice, that may hold empty space, or that hold supports too small for the lattice
    are marched at full rate.

    Returns:
        The work, and the estimated error of the pixels of each bundle: `DEVIATIONS` standard deviations, 0 where all is
        marched.
    """
    count = grid.cells.count
    deviations = functools.partial(_deviations, slab_samples=slab_samples)
    resolved = _resolved(grid, camera, slab_samples)
    nothing = jnp.zeros(count.shape, tolerance.dtype), jnp.zeros(count.shape, bool)
    variance, allowed = lax.cond((lattice.evaluations > 0).any(), deviations, lambda *_: nothing, grid, lattice, camera, transfer)
    allowed &= (count > 0) & resolved
    variance = jnp.where(allowed, variance, jnp.inf)
    budget = (tolerance / DEVIATIONS) ** 2
    allowed &= variance <= budget
    # of equal price, the smallest variance a saved evaluation: the highest price is sought that keeps the budget
    price = jnp.where(allowed, jnp.log2(variance) - jnp.log2(jnp.maximum(count, 1).astype(variance.dtype)), jnp.inf)
    low = jnp.full(count.shape[1], jnp.where(allowed, price, jnp.inf).min(initial=jnp.inf))
    high = jnp.full(count.shape[1], jnp.where(allowed, price, -jnp.inf).max(initial=-jnp.inf))

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        keeps = jnp.where(price <= middle, variance, 0).sum(0) <= budget
        return jnp.where(keeps, middle, low), jnp.where(keeps, high, middle)

    all_fit = jnp.where(allowed, variance, 0).sum(0) <= budget
    low = jnp.where(all_fit, high, lax.fori_loop(0, HALVINGS, halve, (low, high))[0])
    taken = allowed & (price <= low)
    total = jnp.where(taken, variance, 0).sum(0)
    taken &= total <= budget  # the least price alone may be too much
    estimate = jnp.where(taken.any(0), jnp.minimum(DEVIATIONS * jnp.sqrt(total), tolerance), 0)
    work = full_rate(grid.cells, jnp.where(taken, lattice.origin, origin))
    empty = {"length": jnp.where(taken, 0, work.length), "count": jnp.where(taken, 0, work.count)}
    return dataclasses.replace(work, **empty, interpolated=taken), estimate


def worthwhile(grid: Grid, camera: Camera, slab_samples: int) -> Bool[Array, ""]:
    """Whether the lattice resolves enough of a band's work to be sampled at all."""
    count = grid.cells.count.astype(jnp.float32)
    return jnp.where(_resolved(grid, camera, slab_samples), count, 0).sum() > WORTHWHILE * count.sum()


def _resolved(grid: Grid, camera: Camera, slab_samples: int) -> Bool[Array, "slabs bundles"]:
    """Slabs where all classes of supports reach several nodes."""
    slabs = grid.cells.count.shape[0]
    borders = grid.borders(slabs * slab_samples)
    back = borders[slab_samples::slab_samples]
    pixel = 2 * camera.half_height / camera.height * (back if camera.is_perspective else jnp.ones_like(back))
    deep = back - borders[slab_samples - NODE_SAMPLES :: slab_samples][: back.shape[0]]
    spacing = jnp.maximum(NODE_PIXELS * pixel, deep)
    reach, live = grid.ordered.reach, grid.ordered.live
    classes = grid.cells.length.shape[0]
    octaves = jnp.exp2(-1.0 - jnp.arange(classes, dtype=reach.dtype))
    least = jnp.where(live, reach, jnp.inf).min(initial=jnp.inf)
    smallest = jnp.maximum(jnp.where(live, reach, 0).max(initial=0) * octaves, least).at[-1].set(least)
    small = smallest[:, None] < RESOLVED * spacing
    return ~((grid.cells.length > 0) & small[..., None]).any(0)


def _deviations(
    grid: Grid, lattice: Lattice, camera: Camera, transfer: TransferFunction, *, slab_samples: int
) -> tuple[Array, Array]:
    """Variance of light of every slab, if it is interpolated, as it reaches the eye, (slabs, bundles); and where it can be."""
    slabs = grid.cells.count.shape[0]
    within = slab_samples // NODE_SAMPLES
    rows, columns = (size // ACROSS for size in lattice.weight.shape[1:])
    spread, quantity, extinction = computed_once(grid.row[0] >= 0, _at_nodes, lattice, transfer.segments())
    last = grid.half_steps.shape[0] - 1
    borders = grid.half_steps[jnp.minimum(4 * jnp.arange(spread.shape[0] + 1, dtype=jnp.int32), last)]
    path = _slant(grid, camera, *spread.shape[1:])
    thickness = extinction * ((borders[1:] - borders[:-1])[:, None, None] * path)
    absorbed = functools.reduce(jnp.add, (thickness[k : k + slabs * within : within] for k in range(within)))
    before = jnp.cumsum(absorbed, 0) - absorbed

    pool = functools.partial(_pooled, slabs=slabs, within=within)
    deviation = jnp.sqrt(pool(spread, jnp.add) / ((within + 1) * (ACROSS + 1) ** 2))
    low, high = pool(quantity, jnp.minimum), pool(quantity, jnp.maximum)
    front = jnp.exp(-_pooled_across(before, jnp.minimum))
    taken = -jnp.expm1(-_pooled_across(absorbed, jnp.maximum))
    slope = _mean_square_slope(transfer, low - 2 * deviation, high + 2 * deviation)
    edges = grid.borders(slabs * slab_samples)[::slab_samples]
    length = (edges[1:] - edges[:-1])[:, None, None] * _pooled_across(path[None], jnp.maximum)
    of_colors = jnp.maximum(jnp.maximum(slope[0], slope[1]), slope[2])
    # a slab's samples err independently: their sum by the root of their number, their mean by one over it
    variance = front**2 * deviation**2 * (slope[3] * length**2 + of_colors * taken**2) / slab_samples
    variance += (LEAST * jnp.finfo(variance.dtype).eps) ** 2
    slab, row, column = (jnp.arange(n, dtype=jnp.int32) for n in (slabs, rows, columns))
    spared = (slab > 0) & ((slab + 1) * within < (grid.samples - 1) // NODE_SAMPLES)
    spared = spared[:, None, None] & ((row > 0) & (row < rows - 1))[:, None] & ((column > 0) & (column < columns - 1))
    return tuple(_by_bundle(value) for value in (variance, spared & jnp.isfinite(variance)))  # type: ignore[return-value]


def _at_nodes(lattice: Lattice, segments: Segments) -> tuple[Array, Array, Array]:
    """Variance of Q between the nodes, Q, and extinction; with `GAP` more nodes on the far sides, where nothing is.

    The variance is infinite where the sum of weights is not clear of zero.
    """
    deep, down, across = (size + GAP for size in lattice.weight.shape)
    stride = (down * across, across, 1)
    number = deep * stride[0]
    flat = [_with_gaps(value, (deep, down, across)) for value in (lattice.weight, lattice.weighted)]

    def shifted(value: Array, by: int) -> Array:
        return value[REACH * stride[0] + by :][:number]

    def fourth(value: Array, axis: int) -> Array:
        left2, left, middle, right, right2 = (shifted(value, by * stride[axis]) for by in range(-REACH, REACH + 1))
        return (left2 + right2) - 4 * (left + right) + 6 * middle

    weight, weighted = (shifted(value, 0) for value in flat)
    inside = weight > 0
    inverse = jnp.where(inside, 1 / jnp.where(inside, weight, 1), 0)
    ratio = weighted * inverse
    spread, unsure = jnp.zeros_like(ratio), jnp.zeros_like(ratio)
    for axis in range(3):
        of_weight, of_weighted = (fourth(value, axis) for value in flat)
        unsure += CUBIC * jnp.abs(of_weight)
        spread += (CUBIC * (of_weighted - ratio * of_weight)) ** 2
    spread = jnp.where(inside & (weight > CLEAR * unsure), spread * inverse**2, jnp.inf)
    quantity = lattice.origin + ratio
    found = spread, quantity, jnp.where(inside, look_up(segments, quantity)[3], 0)
    first, second, third = (value.reshape(deep, down, across) for value in found)
    return first, second, third


def _with_gaps(value: Array, shape: tuple[int, int, int]) -> Array:
    """All nodes in one row, with zeros between rows and layers: neighbours along any axis are then one shift away."""
    flat = jnp.zeros(shape, value.dtype).at[: value.shape[0], : value.shape[1], : value.shape[2]].set(value).ravel()
    around = REACH * shape[1] * shape[2]
    return jnp.zeros(flat.shape[0] + 2 * around, value.dtype).at[around : around + flat.shape[0]].set(flat)


def _slant(grid: Grid, camera: Camera, down: int, across: int) -> Array:
    """Path length of the nodes' rays a unit of depth, (down, across)."""
    dtype = grid.half_steps.dtype
    if not camera.is_perspective:
        return jnp.ones((down, across), dtype)
    u = camera.column(NODE_PIXELS * jnp.arange(across, dtype=dtype) + 0.5)
    v = camera.row((grid.row[0] + NODE_PIXELS * jnp.arange(down, dtype=jnp.int32)).astype(dtype) + 0.5)
    return jnp.sqrt(1 + u**2 + v[:, None] ** 2)


def _pooled(value: Array, combine: Combine, *, slabs: int, within: int) -> Array:
    """Nodes of each slab and bundle combined, those on the far borders as well, (slabs, rows, columns)."""
    value = _pooled_across(value, combine)
    value = jnp.pad(value, ((0, max(0, slabs * within + 1 - value.shape[0])), (0, 0), (0, 0)), mode="edge")
    return functools.reduce(combine, (value[k : k + (slabs - 1) * within + 1 : within] for k in range(within + 1)))


def _pooled_across(value: Array, combine: Combine) -> Array:
    """The same of each layer."""
    for axis in (2, 1):
        number = value.shape[axis] - GAP
        parts = (lax.slice_in_dim(value, k, k + number - ACROSS + 1, ACROSS, axis) for k in range(ACROSS + 1))
        value = functools.reduce(combine, parts)
    return value


def _by_bundle(value: Array) -> Array:
    """(slabs, rows, columns) to (slabs, bundles), four bundles a tile."""
    slabs, rows, columns = value.shape
    value = value.reshape(slabs, rows // 2, 2, columns // 2, 2)
    return jnp.transpose(value, (0, 1, 3, 2, 4)).reshape(slabs, -1)


def _mean_square_slope(transfer: TransferFunction, low: Array, high: Array) -> list[Array]:
    """Mean over `[low, high]` of the squared slope of red, green, blue and extinction; infinite with a jump inside."""
    values = transfer.values
    table = jnp.concatenate([transfer.colors, transfer.extinction[:, None]], 1).T
    rise, run = table[:, 1:] - table[:, :-1], values[1:] - values[:-1]
    jump = ((run <= 0) & (rise != 0).any(0)).astype(jnp.int32)
    square = jnp.where(run > 0, rise / jnp.where(run > 0, run, 1), 0) ** 2
    square = jnp.pad(square, ((0, 0), (1, 1)))  # constant before the first control point and past the last
    width = jnp.pad(run, (1, 0))
    area = jnp.cumsum(square[:, :-1] * width, 1)  # up to each control point
    jumps = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(jump)])
    first = jnp.searchsorted(values, low, side="left", method="scan_unrolled").astype(jnp.int32)
    past = jnp.searchsorted(values, high, side="right", method="scan_unrolled").astype(jnp.int32)
    begin, end = jnp.minimum(first, values.shape[0] - 1), jnp.maximum(past - 1, 0)
    within, extent = past > first, high - low
    clean = ~within | (jumps[end] <= jumps[begin])
    found = []
    for channel in range(4):
        slope, sums = square[channel], area[channel]
        ends = slope[first] * (values[begin] - low) + slope[past] * (high - values[end])
        mean = (sums[end] - sums[begin] + ends) / jnp.where(extent > 0, extent, 1)
        mean = jnp.where(within & (extent > 0), jnp.maximum(mean, 0), slope[first])
        found.append(jnp.where(clean, mean, jnp.inf))
    return found
