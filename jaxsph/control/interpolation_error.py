r"""How wrong light would be if slabs were interpolated from the lattice: by the lattice's own fourth differences.

Flow: lattice -> [interpolation_error] -> pilot -> worklist.

A cubic through four nodes errs by at most 3/128 of a fourth difference, about the middle between two nodes. So the lattice
tells how well it can be interpolated: fourth differences of $\sum q V W - Q \sum V W$ over $\sum V W$ are the error of Q, to
first order. It is a residual of no known sign, so it is treated as noise: its variance is the mean over the nodes of a slab,
its effect on light that times the mean square slope of the transfer function over the quantities met, and slabs' variances
add up along a bundle. Errors stay correlation_length for about as far as nodes are apart, across or in depth, whatever lies nearer: samples
within count as one. Narrow bands need no rule of their own: it is sums that are interpolated, not light, and where Q meets a
steep part, its mean square slope is large; a jump is never interpolated over.

A slab that is marched at `worklist.SUBSAMPLE` of its rays errs across only, and by `SUBSAMPLE_VARIANCE` of that variance: these rays are up to
three pixels apart, and where a kernel's third derivative jumps, errors fall with the third power of the distance. The share was
measured, not derived.

The a-posteriori error of Kratz et al. 2011 (section 4) takes the same view of a finite element: the residual of the next order,
weighted.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.access.grid import Grid
from jaxsph.control.slopes import mean_square_slope, squared_slopes
from jaxsph.control.spacing import second_differences
from jaxsph.field.lattice import GAP, REACH, Lattice
from jaxsph.model.camera import Camera
from jaxsph.model.transfer import Segments, TransferFunction, find, read
from jaxsph.numerics.fusion import fusion_barrier

CUBIC = 3 / 128  # of a fourth difference: largest error of a cubic between its middle nodes
MIN_CLEARANCE = 12.0  # times its estimated error that the sum of weights is above zero wherever a slab is interpolated
LEAST = 8  # eps: what interpolated samples differ by, at least
SUBSAMPLE_VARIANCE = (
    0.1  # of the variance across, between rays of `SUBSAMPLE`: 0.04 to 0.13 in the median over slabs, 0.31 in nine of ten
)
SMALLEST = 1 / 64  # share of the variance that is across, at least
Combine = Callable[[Array, Array], Array]


@dataclasses.dataclass(frozen=True)
class InterpolationError:
    """Of the slabs of a band.

    Attributes:
        variance: of the light of a slab, if it is interpolated, as it reaches the eye; infinite where it cannot be.
        subsampled_share: of the variance, what is left if the slab is marched at a few rays instead.
        bend: root mean square over the nodes of how much light bends along a slab, see `spacing.second_differences`.
    """

    variance: Float[Array, "slabs bundles"]
    subsampled_share: Float[Array, "slabs bundles"]
    bend: Float[Array, "slabs bundles"]


jax.tree_util.register_dataclass(InterpolationError, data_fields=["variance", "subsampled_share", "bend"], meta_fields=[])


def interpolation_error(
    grid: Grid, lattice: Lattice, camera: Camera, transfer: TransferFunction, slab_samples: int
) -> InterpolationError:
    """InterpolationError of a band; infinite variance wherever a stencil may leave the lattice, or there is none."""

    def nothing() -> InterpolationError:
        shape, dtype = grid.windows.count.shape, lattice.weight.dtype
        return InterpolationError(
            jnp.full(shape, jnp.inf, dtype), jnp.full(shape, SUBSAMPLE_VARIANCE, dtype), jnp.zeros(shape, dtype)
        )

    found = functools.partial(_residuals, grid, lattice, camera, transfer, slab_samples)
    return lax.cond((lattice.evaluations > 0).any(), found, nothing)


def _residuals(grid: Grid, lattice: Lattice, camera: Camera, transfer: TransferFunction, slab_samples: int) -> InterpolationError:
    """Slab by slab from front to back, such that what is at hand stays in the cache.

    Infinite variance where a cubic may take nodes beyond the lattice: at its first and last slabs, rows and columns.
    """
    slabs = grid.windows.count.shape[0]
    region, nodes = lattice.region, lattice.region.spacing
    within = slab_samples // nodes.samples
    down, across = (side - GAP for side in lattice.weight.shape[1:])
    rows, columns = region.rows, region.columns
    layer = (down + GAP) * (across + GAP)
    weight, weighted = (value.ravel() for value in (lattice.weight, *lattice.weighted))
    segments, squares = transfer.segments(), squared_slopes(transfer)
    path = _slant(lattice, camera, down + GAP, across + GAP).ravel()
    pooled = functools.partial(_pooled, down=down, across=across, of_bundle=nodes.across)
    longest = pooled(path, jnp.maximum)

    at_nodes = functools.partial(_at_nodes, across=across + GAP, layer=layer, node_samples=nodes.samples)
    pixel = 2 * camera.half_height.astype(path.dtype) / camera.height

    def one_slab(state: tuple[Array, ...], slab: Array) -> tuple[tuple[Array, ...], tuple[Array, Array, Array]]:
        before, previous, *first = state
        begin, number = (slab * within + 1) * layer, (within + 2 * REACH) * layer
        near = [lax.dynamic_slice_in_dim(value, begin, number) for value in (weight, weighted)]
        border = lax.dynamic_slice(edges, (slab * within,), (within + 1,))
        spacing = nodes.pixels * pixel * (border[-1] if camera.is_perspective else 1)
        correlation_length = jnp.maximum(
            slab_samples * spacing / (border[-1] - border[0]), 1
        )  # samples in a row that err correlation_length across
        new = fusion_barrier(slab >= 0, at_nodes, *near, lattice.reference_quantity, segments, correlation_length)
        spread, lateral, quantity, *colors, extinction = ([a, *b] for a, b in zip(first, new, strict=True))
        absorbed = sum(extinction[k] * (border[k + 1] - border[k]) for k in range(within)) * path

        def of_bundles(
            spread: list[Array], lateral: list[Array], quantity: list[Array], before: Array, absorbed: Array
        ) -> tuple[Array, ...]:
            def pool(layers: list[Array], combine: Combine) -> Array:
                return pooled(functools.reduce(combine, layers), combine)

            total, across = pool(spread, jnp.add), pool(lateral, jnp.add)
            deviation = jnp.sqrt(total / ((within + 1) * (nodes.across + 1) ** 2))
            share = SUBSAMPLE_VARIANCE * jnp.clip(across / jnp.where(total > 0, total, 1), SMALLEST, 1)
            front, taken = jnp.exp(-pool([before], jnp.minimum)), -jnp.expm1(-pool([absorbed], jnp.maximum))
            return deviation, share, pool(quantity, jnp.minimum), pool(quantity, jnp.maximum), front, taken

        pieces = spread, lateral, quantity, before, absorbed
        deviation, share, low, high, front, taken = fusion_barrier(slab >= 0, of_bundles, *pieces)
        around = 2 * deviation / jnp.sqrt(correlation_length)
        *of_colors, of_extinction = mean_square_slope(squares, low - around, high + around)
        length = (border[-1] - border[0]) * longest
        # what errs correlation_length is in the deviation; the rest is independent: a sum grows by the root of its number, a mean falls so
        light = of_extinction * length**2 + functools.reduce(jnp.maximum, of_colors) * taken**2
        step = (border[1:] - border[:-1])[:, None] * path
        bend, previous = fusion_barrier(slab >= 0, second_differences, colors, extinction, step, before, previous)
        bend = jnp.sqrt(pooled(bend**2, jnp.add)) / (nodes.across + 1)
        variance = front**2 * deviation**2 * light / slab_samples
        return (before + absorbed, previous, *(layers[-1] for layers in new)), (variance, share, bend)

    # one more border than there are samples, and layers past the last
    last = grid.half_steps.shape[0] - 1
    edges = grid.half_steps[jnp.minimum(2 * nodes.samples * jnp.arange(slabs * within + 1, dtype=jnp.int32), last)]
    # the first layer counts as empty: its slab is not interpolated anyway
    start = jnp.zeros_like(path), jnp.zeros((4, *path.shape), path.dtype), *([jnp.zeros_like(path)] * 7)

    def skip(state: tuple[Array, ...], _: Array) -> tuple[tuple[Array, ...], tuple[Array, Array, Array]]:
        nothing = jnp.zeros((rows, columns), path.dtype)
        return (state[0], *(jnp.zeros_like(value) for value in state[1:])), (nothing, nothing + SUBSAMPLE_VARIANCE, nothing)

    filled = jnp.append((grid.windows.count > 0).any(1), False)
    judged = filled[:-1] | filled[1:]  # the last layer of a slab is the first of the next
    each = jnp.arange(slabs, dtype=jnp.int32), judged
    _, (variance, share, bend) = lax.scan(lambda state, x: lax.cond(x[1], one_slab, skip, state, x[0]), start, each)
    variance += (LEAST * jnp.finfo(variance.dtype).eps) ** 2
    slab, row, column = (jnp.arange(n, dtype=jnp.int32) for n in (slabs, rows, columns))
    spared = (slab > 0) & ((slab + 1) * within < (grid.samples - 1) // nodes.samples)
    past = -(-2 // nodes.across)  # bundles at the far sides from which a cubic takes nodes beyond
    spared = spared[:, None, None] & ((row > 0) & (row < rows - past))[:, None] & ((column > 0) & (column < columns - past))
    row, column, inside = region.place(grid)
    at = jnp.where(inside, row * columns + column, 0)
    variance, share, bend = (value.reshape(slabs, -1)[:, at] for value in (jnp.where(spared, variance, jnp.inf), share, bend))
    return InterpolationError(jnp.where(inside, variance, jnp.inf), share, bend)


def _at_nodes(
    weight: Array,
    weighted: Array,
    reference_quantity: Array,
    segments: Segments,
    correlation_length: Array,
    *,
    across: int,
    layer: int,
    node_samples: int,
) -> tuple[Array, ...]:
    """Variance of Q between nodes, its part across, Q, and its optics: (layers, nodes of a layer), but `REACH` on either side.

    The variance is that of one sample times how many in a row err correlation_length; infinite where the sum of weights is not clear of zero.

    Args:
        correlation_length: how many samples in a row err correlation_length across.
        weight, weighted: sums at nodes in a row.
        across, layer: how far apart in memory neighbours are down and in depth.
        node_samples: fine samples from one layer to the next.
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
    spread, lateral, unsure = jnp.zeros_like(ratio), jnp.zeros_like(ratio), jnp.zeros_like(ratio)
    for stride in (1, across, layer):
        lateral = spread
        of_weight = fourth(weight, stride)
        unsure += CUBIC * jnp.abs(of_weight)
        error = (CUBIC * (fourth(weighted, stride) - ratio * of_weight)) ** 2
        spread += (node_samples if stride == layer else correlation_length) * error
    spread, lateral = jnp.where(inside & (here > MIN_CLEARANCE * unsure), spread * inverse**2, jnp.inf), lateral * inverse**2
    quantity = reference_quantity + ratio
    place = fusion_barrier(correlation_length > 0, find, segments, quantity)
    *colors, extinction = read(segments, place)
    found = spread, lateral, quantity, *colors, jnp.where(inside, extinction, 0)
    return tuple(value.reshape(-1, layer) for value in found)


def _slant(lattice: Lattice, camera: Camera, down: int, across: int) -> Array:
    """Path length of the nodes' rays a unit of depth, (down, across)."""
    dtype = lattice.weight.dtype
    if not camera.is_perspective:
        return jnp.ones((down, across), dtype)
    region = lattice.region
    row, column = (region.spacing.pixels * jnp.arange(number, dtype=jnp.int32) for number in (down, across))
    u, v = camera.column((region.column + column).astype(dtype) + 0.5), camera.row((region.row + row).astype(dtype) + 0.5)
    return jnp.sqrt(1 + u**2 + v[:, None] ** 2)


def _pooled(
    value: Float[Array, " nodes"], combine: Combine, *, down: int, across: int, of_bundle: int
) -> Float[Array, "rows columns"]:
    """Nodes of a layer combined over each bundle, those on the far borders as well."""
    for stride in (1, across + GAP):
        number = value.shape[0] - of_bundle * stride
        value = functools.reduce(combine, (value[k * stride : k * stride + number] for k in range(of_bundle + 1)))
    return value[: down * (across + GAP)].reshape(down, -1)[::of_bundle, :across:of_bundle]
