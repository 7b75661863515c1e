r"""The pilot estimator: which slabs may be interpolated from the lattice, by how wrong that is estimated to be.

Flow: lattice -> [pilot] -> worklist -> cast -> image.

A cubic through four nodes errs by at most 3/128 of a fourth difference, about the middle between two nodes. So the lattice
tells how well it can be interpolated: fourth differences of $\sum q V W - Q \sum V W$ over $\sum V W$ are the error of Q, to
first order. It is a residual of no known sign, so it is treated as noise: its variance is the mean over the nodes of a slab,
its effect on light that times the mean square slope of the transfer function over the quantities met, and slabs' variances
add up along a bundle. Errors stay alike for about as far as nodes are apart, across or in depth, whatever lies nearer: samples
within count as one. `DEVIATIONS` standard deviations are the estimate. Narrow bands need no rule of their own: every sample is
shaded, and where Q meets a steep part, its mean square slope is large; a jump is never interpolated over.

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
from jaxsph.access.lattice import GAP, NODE_PIXELS, NODE_SAMPLES, REACH, Lattice
from jaxsph.access.lists import BUNDLE
from jaxsph.control.worklist import Worklist, full_rate
from jaxsph.model.camera import Camera
from jaxsph.model.transfer import Segments, TransferFunction, look_up
from jaxsph.numerics.staging import computed_once

DEVIATIONS = 5.25  # standard deviations that pixels are taken to stay within
CUBIC = 3 / 128  # of a fourth difference: largest error of a cubic between its middle nodes
CLEAR = 12.0  # times its estimated error that the sum of weights is above zero wherever a slab is interpolated
RESOLVED = 1.5  # node spacings that a support must reach: some node is then well inside it, and its fourth differences show it
LEAST = 8  # eps: what interpolated samples differ by, at least
WORTHWHILE = 0.25  # least share of a band's work that the lattice must resolve: sampling it costs up to a tenth
HALVINGS = 16  # of the range of prices in octaves
NARROWEST = 1e-3  # of the transfer function's domain that a slope is averaged over, at least
ACROSS = BUNDLE // NODE_PIXELS
Combine = Callable[[Array, Array], Array]


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
    """Variance of light of every slab, if it is interpolated, as it reaches the eye, (slabs, bundles); and where it can be.

    Slab by slab from front to back, such that what is at hand stays in the cache.
    """
    slabs = grid.cells.count.shape[0]
    within = slab_samples // NODE_SAMPLES
    down, across = (side - GAP for side in lattice.weight.shape[1:])
    rows, columns = down // ACROSS, across // ACROSS
    layer = (down + GAP) * (across + GAP)
    weight, weighted = (value.ravel() for value in (lattice.weight, lattice.weighted))
    segments, squares = transfer.segments(), _squared_slopes(transfer)
    path = _slant(grid, camera, down + GAP, across + GAP).ravel()
    longest = _pooled(path, jnp.maximum, down, across)

    at_nodes = functools.partial(_at_nodes, across=across + GAP, layer=layer)
    pixel = 2 * camera.half_height.astype(path.dtype) / camera.height

    def one_slab(before: Array, slab: Array) -> tuple[Array, Array]:
        near = [lax.dynamic_slice(v, (slab * within * layer,), ((within + 1 + 2 * REACH) * layer,)) for v in (weight, weighted)]
        border = lax.dynamic_slice(edges, (slab * within,), (within + 1,))
        spacing = NODE_PIXELS * pixel * (border[-1] if camera.is_perspective else 1)
        alike = jnp.maximum(slab_samples * spacing / (border[-1] - border[0]), 1)  # samples in a row that err alike across
        spread, quantity, extinction = computed_once(slab >= 0, at_nodes, *near, lattice.origin, segments, alike)
        absorbed = sum(extinction[k] * (border[k + 1] - border[k]) for k in range(within)) * path

        def pool(value: Array, combine: Combine) -> Array:
            return _pooled(functools.reduce(combine, value), combine, down, across)

        deviation = jnp.sqrt(pool(spread, jnp.add) / ((within + 1) * (ACROSS + 1) ** 2))
        low, high = pool(quantity, jnp.minimum), pool(quantity, jnp.maximum)
        front, taken = jnp.exp(-pool(before[None], jnp.minimum)), -jnp.expm1(-pool(absorbed[None], jnp.maximum))
        around = 2 * deviation / jnp.sqrt(alike)
        *of_colors, of_extinction = _mean_square_slope(squares, low - around, high + around)
        length = (border[-1] - border[0]) * longest
        # what errs alike is in the deviation; the rest is independent: a sum grows by the root of its number, a mean falls so
        light = of_extinction * length**2 + functools.reduce(jnp.maximum, of_colors) * taken**2
        return before + absorbed, front**2 * deviation**2 * light / slab_samples

    # one more border than there are samples, and layers past the last
    last = grid.half_steps.shape[0] - 1
    edges = grid.half_steps[jnp.minimum(2 * NODE_SAMPLES * jnp.arange(slabs * within + 1, dtype=jnp.int32), last)]
    _, variance = lax.scan(one_slab, jnp.zeros_like(path), jnp.arange(slabs, dtype=jnp.int32))
    variance += (LEAST * jnp.finfo(variance.dtype).eps) ** 2
    slab, row, column = (jnp.arange(n, dtype=jnp.int32) for n in (slabs, rows, columns))
    spared = (slab > 0) & ((slab + 1) * within < (grid.samples - 1) // NODE_SAMPLES)
    spared = spared[:, None, None] & ((row > 0) & (row < rows - 1))[:, None] & ((column > 0) & (column < columns - 1))
    variance = _by_bundle(jnp.where(spared, variance, jnp.inf))
    return variance, jnp.isfinite(variance)


def _at_nodes(
    weight: Array, weighted: Array, origin: Array, segments: Segments, alike: Array, *, across: int, layer: int
) -> tuple[Array, ...]:
    """Variance of Q between nodes, Q, and extinction, (layers, nodes of a layer), of all layers but `REACH` on either side.

    The variance is that of one sample times how many in a row err alike; infinite where the sum of weights is not clear of zero.

    Args:
        alike: how many samples in a row err alike across.
        weight, weighted: sums at nodes in a row.
        across, layer: how far apart neighbours are down and in depth.
    """
    number = weight.shape[0] - 2 * REACH * layer

    def shifted(value: Array, by: int) -> Array:
        return value[REACH * layer + by :][:number]

    def fourth(value: Array, stride: int) -> Array:
        left2, left, middle, right, right2 = (shifted(value, by * stride) for by in range(-REACH, REACH + 1))
        return (left2 + right2) - 4 * (left + right) + 6 * middle

    here = shifted(weight, 0)
    inside = here > 0
    inverse = jnp.where(inside, 1 / jnp.where(inside, here, 1), 0)
    ratio = shifted(weighted, 0) * inverse
    spread, unsure = jnp.zeros_like(ratio), jnp.zeros_like(ratio)
    for stride in (1, across, layer):
        of_weight = fourth(weight, stride)
        unsure += CUBIC * jnp.abs(of_weight)
        error = (CUBIC * (fourth(weighted, stride) - ratio * of_weight)) ** 2
        spread += (NODE_SAMPLES if stride == layer else alike) * error
    spread = jnp.where(inside & (here > CLEAR * unsure), spread * inverse**2, jnp.inf)
    quantity = origin + ratio
    found = spread, quantity, jnp.where(inside, look_up(segments, quantity)[3], 0)
    return tuple(value.reshape(-1, layer) for value in found)


def _slant(grid: Grid, camera: Camera, down: int, across: int) -> Array:
    """Path length of the nodes' rays a unit of depth, (down, across)."""
    dtype = grid.half_steps.dtype
    if not camera.is_perspective:
        return jnp.ones((down, across), dtype)
    u = camera.column(NODE_PIXELS * jnp.arange(across, dtype=dtype) + 0.5)
    v = camera.row((grid.row[0] + NODE_PIXELS * jnp.arange(down, dtype=jnp.int32)).astype(dtype) + 0.5)
    return jnp.sqrt(1 + u**2 + v[:, None] ** 2)


def _pooled(value: Float[Array, " nodes"], combine: Combine, down: int, across: int) -> Float[Array, "rows columns"]:
    """Nodes of a layer combined over each bundle, those on the far borders as well."""
    for stride in (1, across + GAP):
        number = value.shape[0] - ACROSS * stride
        value = functools.reduce(combine, (value[k * stride : k * stride + number] for k in range(ACROSS + 1)))
    return value[: down * (across + GAP)].reshape(down, -1)[::ACROSS, :across:ACROSS]


def _by_bundle(value: Array) -> Array:
    """(slabs, rows, columns) to (slabs, bundles), four bundles a tile."""
    slabs, rows, columns = value.shape
    value = value.reshape(slabs, rows // 2, 2, columns // 2, 2)
    return jnp.transpose(value, (0, 1, 3, 2, 4)).reshape(slabs, -1)


def _squared_slopes(transfer: TransferFunction) -> Segments:
    """Integrals from the first control point on of the squared slopes of red, green, blue and extinction; number of jumps."""
    segments = transfer.segments()
    run = jnp.append(transfer.values[1:] - transfer.values[:-1], 0)
    change = jnp.where(run > 0, segments.change / jnp.where(run > 0, run, 1), 0) ** 2 * run
    jumps = ((run <= 0) & (segments.change != 0).any(0)).astype(run.dtype)
    added = jnp.append(change, jumps[None], 0)
    return dataclasses.replace(segments, base=jnp.cumsum(added, 1) - added, change=added.at[-1].set(0))


def _mean_square_slope(squares: Segments, low: Array, high: Array) -> list[Array]:
    """Mean over `[low, high]` of the squared slope of red, green, blue and extinction; infinite with a jump inside.

    With what the difference of two integrals may have lost to rounding.
    """
    least = NARROWEST * (squares.start[-1] - squares.start[0])
    extent = jnp.maximum(high - low, jnp.where(least > 0, least, 1))
    *upper, jumps = look_up(squares, low + extent)
    *lower, before = look_up(squares, low)
    lost = 4 * jnp.finfo(low.dtype).eps
    means = [((b - a) + lost * b) / extent for a, b in zip(lower, upper, strict=True)]
    return [jnp.where(jumps > before, jnp.inf, mean) for mean in means]
