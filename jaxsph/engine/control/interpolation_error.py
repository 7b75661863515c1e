r"""How wrong light would be if slabs were interpolated from the lattice: by the lattice's own fourth differences.

Flow: lattice -> [interpolation_error] -> pilot -> schedule.

A cubic through four nodes errs by at most 3/128 of a fourth difference, about the middle between two nodes. So the lattice
tells how well it can be interpolated: fourth differences of $\sum q V W - Q \sum V W$ over $\sum V W$ are the error of Q, to
first order. It is of no known sign, so it is treated as noise: its variance is the mean over the nodes of a slab, its effect on
light that times the mean square slope of the transfer function over the quantities met, and slabs' variances add up along a
bundle. Errors are correlated over about as far as nodes are apart, across or in depth, whatever lies nearer: samples within count
as one. Narrow bands need no rule of their own: it is sums that are interpolated, not light, and where Q meets a steep part, its
mean square slope is large; a jump is never interpolated over. The integral of the squared slope up to any quantity tells the
mean over any range, as a difference of two: it is tabulated at uniform borders, so a range is read without a search.

A slab that is marched at `schedule.SUBSAMPLE` of its rays errs across only, and by `SUBSAMPLED_SHARE` of that variance: these
rays are up to three pixels apart, and where a kernel's third derivative jumps, errors fall with the third power of the distance.
The share was measured, not derived (`benchmarks/calibrate.py`).

Of two quantities each has errors of its own, by its own sums: those of the first change colours, those of the second extinction,
and as noise their variances add up.

The a-posteriori error of Kratz et al. 2011 (section 4) takes the same view of a finite element: the residual of the next order,
weighted.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.field.lattice import GAP, REACH, Lattice
from jaxsph.model.camera.camera import Camera
from jaxsph.model.transfer.function import Segments, TransferFunction, find, look_up, read
from jaxsph.numerics.compiled import fusion_barrier
from jaxsph.numerics.trees import tree

BUCKETS = 1024  # of the transfer function's domain: a slope is averaged over one at least
CUBIC = 3 / 128  # of a fourth difference: largest error of a cubic between its middle nodes
MIN_CLEARANCE = 12.0  # times its estimated error that the sum of weights is above zero wherever a slab is interpolated
MIN_DEVIATION = 8  # eps: what interpolated samples differ by, at least
SUBSAMPLED_SHARE = 0.2  # of the variance across, what is left between rays of `SUBSAMPLE`, where it is most: at free surfaces
DEVIATIONS_AROUND = 10.0  # of Q, by which quantities between nodes are taken to lie beyond those at the nodes
MIN_ACROSS = 1 / 64  # share of the variance that is across, at least
AXES = 2, 1, 0  # of a lattice: columns, rows, layers
Combine = Callable[[Array, Array], Array]
Carried = tuple[Array, Array, list["NodeValues"]]  # optical thickness in front; light, see `second_differences`; nodes


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


@tree()
class InterpolationError:
    """Of the slabs of a band.

    Attributes:
        variance: of the light of a slab, if it is interpolated, as it reaches the eye; infinite where it cannot be.
        subsampled_share: of the variance, what is left if the slab is marched at a few rays instead.
        bend: root mean square over the nodes of how much light bends along a slab, see `second_differences`.
    """

    variance: Float[Array, "slabs bundles"]
    subsampled_share: Float[Array, "slabs bundles"]
    bend: Float[Array, "slabs bundles"]


class NodeValues(NamedTuple):
    """What the nodes of some layers tell of one quantity.

    Attributes:
        variance: of Q between nodes: that of one sample, times how many in a row err as one. Infinite where the sum of weights
            is not clear of zero.
        across: the part of it that is across.
        quantity: Q.
        optics: red, green, blue and extinction of Q.
    """

    variance: Float[Array, "layers rows columns"]
    across: Float[Array, "layers rows columns"]
    quantity: Float[Array, "layers rows columns"]
    optics: tuple[Float[Array, "layers rows columns"], ...]


def interpolation_error(
    grid: Grid, lattice: Lattice, camera: Camera, transfer: TransferFunction, slab_samples: int
) -> InterpolationError:
    """Of a band; infinite variance wherever a stencil may leave the lattice, or there is none."""
    region, spacing, dtype = lattice.region, lattice.region.spacing, lattice.weight.dtype
    shape = grid.windows.count.shape[0], 3, region.rows, region.columns

    def nothing() -> Float[Array, "slabs 3 rows columns"]:
        return jnp.broadcast_to(jnp.asarray([jnp.inf, SUBSAMPLED_SHARE, 0], dtype)[:, None, None], shape)

    sweep = functools.partial(_sweep, grid, lattice, camera, transfer, slab_samples)
    found = lax.cond((lattice.evaluations > 0).any(), sweep, nothing)
    row, column, inside = region.place(grid)
    at = jnp.where(inside, row * region.columns + column, 0)
    variance, share, bend = jnp.moveaxis(found.reshape(*shape[:2], -1)[..., at], 1, 0)
    # cubics of the first and of the last slab take nodes beyond the lattice, and so do those of bundles at its sides
    slab, within = jnp.arange(shape[0], dtype=jnp.int32)[:, None], slab_samples // spacing.samples
    deep = (slab > 0) & ((slab + 1) * within < (grid.samples - 1) // spacing.samples)
    past = -(-2 // spacing.across)
    inside &= (row > 0) & (row < region.rows - past) & (column > 0) & (column < region.columns - past)
    variance += (MIN_DEVIATION * jnp.finfo(dtype).eps) ** 2
    return InterpolationError(jnp.where(deep & inside, variance, jnp.inf), share, bend)


def _sweep(
    grid: Grid, lattice: Lattice, camera: Camera, transfer: TransferFunction, slab_samples: int
) -> Float[Array, "slabs 3 rows columns"]:
    """Variance, share and bend of a region's bundles, slab by slab from front to back: what is at hand stays in the cache."""
    spacing, slabs = lattice.region.spacing, grid.windows.count.shape[0]
    within = slab_samples // spacing.samples  # layers of a slab
    beside = (0, 0), (REACH, 0), (REACH, 0)
    parts = transfer.parts()
    segments, squares = [part.segments() for part in parts], [squared_slopes(part) for part in parts]
    path, pool = _path_lengths(lattice, camera), functools.partial(_pooled, of_bundle=spacing.across)
    longest = pool(path[None], jnp.maximum)
    # one more border than there are samples, and layers past the last
    last = grid.half_steps.shape[0] - 1
    edges = grid.half_steps[jnp.minimum(2 * spacing.samples * jnp.arange(slabs * within + 1, dtype=jnp.int32), last)]
    pixel = 2 * camera.half_height.astype(path.dtype) / camera.height

    def judge(carried: Carried, slab: Array) -> tuple[Carried, Array]:
        (tau, light, before), always = carried, slab >= 0
        weight, *weighted = (
            jnp.pad(lax.dynamic_slice_in_dim(value, slab * within + 1, within + 2 * REACH), beside)
            for value in (lattice.weight, *lattice.weighted)
        )
        edge = lax.dynamic_slice_in_dim(edges, slab * within, within + 1)
        step, depth = edge[1:] - edge[:-1], edge[-1] - edge[0]
        node_distance = spacing.pixels * pixel * (edge[-1] if camera.is_perspective else 1)
        correlated = jnp.maximum(slab_samples * node_distance / depth, 1)
        at_nodes = functools.partial(_at_nodes, node_samples=spacing.samples)
        looks = zip(weighted, lattice.references, segments, strict=True)
        new = [fusion_barrier(always, at_nodes, weight, *one, correlated) for one in looks]
        layers: list[NodeValues] = jax.tree.map(lambda front, behind: jnp.concatenate([front[-1:], behind]), before, new)
        colors, extinction = layers[0].optics[:3], layers[-1].optics[3]
        absorbed = sum(extinction[k] * step[k] for k in range(within)) * path
        judged = [
            _light_of_slab(one, slopes, tau, absorbed, correlated, depth * longest, spacing.across)
            for one, slopes in zip(layers, squares, strict=True)
        ]
        variance = functools.reduce(jnp.add, [one for one, _ in judged]) / slab_samples
        share = functools.reduce(jnp.maximum, [one for _, one in judged])
        bend, light = fusion_barrier(always, second_differences, colors, extinction, step[:, None, None] * path, tau, light)
        bend = jnp.sqrt(pool(bend[None] ** 2, jnp.add)) / (spacing.across + 1)
        return (tau + absorbed, light, new), jnp.stack([variance, share, bend])

    def skip(carried: Carried, _: Array) -> tuple[Carried, Array]:
        """An empty slab before an empty one."""
        found = jnp.asarray([0, SUBSAMPLED_SHARE, 0], longest.dtype)[:, None, None]
        return (carried[0], *jax.tree.map(jnp.zeros_like, carried[1:])), jnp.broadcast_to(found, (3, *longest.shape))

    # the first layer counts as empty: its slab is not interpolated anyway
    nothing = jnp.zeros_like(path)
    layer = jnp.zeros((within, *path.shape), path.dtype)
    empty = [NodeValues(layer, layer, layer, (layer,) * 4) for _ in parts]
    filled = jnp.append((grid.windows.count > 0).any(1), False)
    each = jnp.arange(slabs, dtype=jnp.int32), filled[:-1] | filled[1:]  # the last layer of a slab is the first of the next
    start = nothing, jnp.stack([nothing] * 4), empty
    return lax.scan(lambda carried, x: lax.cond(x[1], judge, skip, carried, x[0]), start, each)[1]


def second_differences(
    colors: list[list[Float[Array, " nodes"]]],
    extinction: list[Float[Array, " nodes"]],
    step: Float[Array, "fewer nodes"],
    before: Float[Array, " nodes"],
    previous: Float[Array, "4 nodes"],
) -> tuple[Float[Array, " nodes"], Float[Array, "4 nodes"]]:
    """How much the light of a slab bends at the nodes: sum over layers of the largest second difference times the step.

    Args:
        colors, extinction: at the layers of nodes of a slab and at the first of the next.
        step: path length between layers.
        before: optical thickness in front of the slab.
        previous: what reaches the eye from a unit of length, of red, green, blue and as such, one layer before.

    Returns:
        The bend, and `previous` of the next slab.
    """
    light, behind = [], before
    for k in range(len(extinction)):
        seen = jnp.exp(-behind) * extinction[k]
        light.append([*(seen * color[k] for color in colors), seen])
        if k < step.shape[0]:
            behind = behind + extinction[k] * step[k]
    total, last = jnp.zeros_like(before), list(previous)
    for here, after, length in zip(light, light[1:], step, strict=False):
        of_channels = [jnp.abs(a - 2 * b + c) for a, b, c in zip(last, here, after, strict=True)]
        total, last = total + functools.reduce(jnp.maximum, of_channels) * length, here
    return total, jnp.stack(last)


def _at_nodes(
    weight: Float[Array, "_ _ _"],
    weighted: Float[Array, "_ _ _"],
    reference: Float[Array, ""],
    segments: Segments,
    correlated: Float[Array, ""],
    node_samples: int,
) -> NodeValues:
    """What nodes tell that have `REACH` others on every side: those have none of their own.

    Args:
        correlated: how many samples in a row err as one across.
        node_samples: fine samples from one layer to the next, that err as one in depth.
    """
    here, total = _shifted(weight), _shifted(weighted)
    inside = here > 0
    inverse = jnp.where(inside, 1 / jnp.where(inside, here, 1), 0)
    ratio = total * inverse
    of_weight = [_fourth_difference(weight, axis) for axis in AXES]
    of_weighted = [_fourth_difference(weighted, axis) for axis in AXES]
    along_columns, along_rows, along_layers = (
        (CUBIC * (b - ratio * a)) ** 2 for a, b in zip(of_weight, of_weighted, strict=True)
    )
    across = correlated * along_columns + correlated * along_rows
    variance = across + node_samples * along_layers
    clear = inside & (here > MIN_CLEARANCE * sum(CUBIC * jnp.abs(change) for change in of_weight))
    quantity = reference + ratio
    place = fusion_barrier(correlated > 0, find, segments, quantity)
    *colors, extinction = read(segments, place)
    optics = *colors, jnp.where(inside, extinction, 0)
    return NodeValues(jnp.where(clear, variance * inverse**2, jnp.inf), across * inverse**2, quantity, optics)


def _shifted(value: Float[Array, "_ _ _"], axis: int = 0, by: int = 0) -> Float[Array, "_ _ _"]:
    """The neighbours, so many nodes further along an axis, of all nodes that have `REACH` others on every side."""
    starts = [REACH + by * (axis == other) for other in range(3)]
    return value[tuple(slice(start, start + size - 2 * REACH) for start, size in zip(starts, value.shape, strict=True))]


def _fourth_difference(value: Float[Array, "_ _ _"], axis: int) -> Float[Array, "_ _ _"]:
    """Along an axis, at all nodes that have `REACH` others on every side."""
    left2, left, middle, right, right2 = (_shifted(value, axis, by) for by in range(-REACH, REACH + 1))
    return (left2 + right2) - 4 * (left + right) + 6 * middle


def _light_of_slab(
    layers: NodeValues,
    squares: SquaredSlopes,
    tau: Float[Array, "rows columns"],
    absorbed: Float[Array, "rows columns"],
    correlated: Float[Array, ""],
    length: Float[Array, "rows columns"],
    of_bundle: int,
) -> tuple[Float[Array, "rows columns"], Float[Array, "rows columns"]]:
    """Variance of a slab's light by one quantity, times its samples; and the share of it that is left at a few rays.

    Samples that err as one are in the deviation; the rest is independent: a sum grows by the root of its number, a mean falls so.

    Args:
        layers: of the slab's nodes, the first of the next slab among them.
        tau, absorbed: optical thickness in front of the slab, and its own, at the nodes.
        length: of the slab along the longest of a bundle's rays.
        of_bundle: nodes of a bundle, down and across.
    """
    pool = functools.partial(_pooled, of_bundle=of_bundle)
    number = layers.variance.shape[0] * (of_bundle + 1) ** 2

    def pooled() -> tuple[Array, ...]:
        total, lateral = pool(layers.variance, jnp.add), pool(layers.across, jnp.add)
        front, taken = jnp.exp(-pool(tau[None], jnp.minimum)), -jnp.expm1(-pool(absorbed[None], jnp.maximum))
        share = SUBSAMPLED_SHARE * jnp.clip(lateral / jnp.where(total > 0, total, 1), MIN_ACROSS, 1)
        low, high = pool(layers.quantity, jnp.minimum), pool(layers.quantity, jnp.maximum)
        return jnp.sqrt(total / number), share, low, high, front, taken

    deviation, share, low, high, front, taken = fusion_barrier(correlated > 0, pooled)
    around = DEVIATIONS_AROUND * deviation / jnp.sqrt(correlated)
    *of_colors, of_extinction = mean_square_slope(squares, low - around, high + around)
    light = of_extinction * length**2 + functools.reduce(jnp.maximum, of_colors) * taken**2
    return front**2 * deviation**2 * light, share


def _path_lengths(lattice: Lattice, camera: Camera) -> Float[Array, "rows columns"]:
    """Of the nodes' rays a unit of depth."""
    region, dtype = lattice.region, lattice.weight.dtype
    rows, columns = (number - GAP + 1 for number in lattice.weight.shape[1:])  # with those on the far borders of bundles
    if not camera.is_perspective:
        return jnp.ones((rows, columns), dtype)
    row, column = (region.spacing.pixels * jnp.arange(number, dtype=jnp.int32) for number in (rows, columns))
    u, v = camera.column((region.column + column).astype(dtype) + 0.5), camera.row((region.row + row).astype(dtype) + 0.5)
    return jnp.sqrt(1 + u**2 + v[:, None] ** 2)


def _pooled(value: Float[Array, "layers rows columns"], combine: Combine, of_bundle: int) -> Float[Array, "_ _"]:
    """Nodes combined over the layers and over each bundle, those on its far borders as well."""
    value = functools.reduce(combine, value)
    for axis in (1, 0):
        last = value.shape[axis] - of_bundle
        parts = [lax.slice_in_dim(value, k, k + last, of_bundle, axis) for k in range(of_bundle + 1)]
        value = functools.reduce(combine, parts)
    return value
