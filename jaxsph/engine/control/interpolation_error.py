r"""How wrong light would be if slabs were interpolated from the lattice: by the lattice's own fourth differences.

Flow: lattice -> [interpolation_error] -> pilot -> schedule.

A cubic through four nodes errs by at most 3/128 of a fourth difference, about the middle between two nodes. So the lattice
tells how well it can be interpolated: fourth differences of $\sum q V W - Q \sum V W$ over $\sum V W$ are the error of Q, to
first order. It is of no known sign, so it is treated as noise: its variance is the mean over the nodes of a slab, its effect on
light that times the mean square slope of the transfer function over the quantities met, and slabs' variances add up along a
bundle. Errors are correlated over about as far as nodes are apart, across or in depth, whatever lies nearer: samples within count
as one. Narrow bands need no rule of their own: it is sums that are interpolated, not light, and where Q meets a steep part, its
mean square slope is large; a jump is never interpolated over.

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
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.control.slopes import SquaredSlopes, mean_square_slope, squared_slopes
from jaxsph.engine.control.spacing import second_differences
from jaxsph.engine.field.lattice import GAP, REACH, Lattice
from jaxsph.model.camera.camera import Camera
from jaxsph.model.transfer.function import Segments, TransferFunction, find, read
from jaxsph.numerics.fusion import fusion_barrier

CUBIC = 3 / 128  # of a fourth difference: largest error of a cubic between its middle nodes
MIN_CLEARANCE = 12.0  # times its estimated error that the sum of weights is above zero wherever a slab is interpolated
MIN_DEVIATION = 8  # eps: what interpolated samples differ by, at least
SUBSAMPLED_SHARE = 0.2  # of the variance across, what is left between rays of `SUBSAMPLE`, where it is most: at free surfaces
DEVIATIONS_AROUND = 10.0  # of Q, by which quantities between nodes are taken to lie beyond those at the nodes
MIN_ACROSS = 1 / 64  # share of the variance that is across, at least
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


class AtNodes(NamedTuple):
    """What the nodes of some layers tell of one quantity; of one layer, without the first axis.

    Attributes:
        variance: of Q between nodes: that of one sample, times how many in a row err as one. Infinite where the sum of weights
            is not clear of zero.
        across: the part of it that is across.
        quantity: Q.
        red, green, blue, extinction: its optics; of two quantities, the first tells colours, the last extinction.
    """

    variance: Float[Array, "layers nodes"]
    across: Float[Array, "layers nodes"]
    quantity: Float[Array, "layers nodes"]
    red: Float[Array, "layers nodes"]
    green: Float[Array, "layers nodes"]
    blue: Float[Array, "layers nodes"]
    extinction: Float[Array, "layers nodes"]


class Sweep(NamedTuple):
    """What a slab takes over from the one before it, at the nodes of a layer.

    Attributes:
        tau: optical thickness in front.
        light: what reaches the eye from a unit of length, one layer before, see `spacing.second_differences`.
        first: the slab's first layer, of each quantity.
    """

    tau: Float[Array, " nodes"]
    light: Float[Array, "4 nodes"]
    first: tuple[AtNodes, ...]


class OfBundles(NamedTuple):
    """A slab's nodes, pooled over each bundle.

    Attributes:
        deviation: root mean square error of Q.
        share: see `InterpolationError.subsampled_share`.
        low, high: least and greatest Q.
        front: most of the light that is let through in front.
        taken: most of what the slab takes of it.
    """

    deviation: Float[Array, "rows columns"]
    share: Float[Array, "rows columns"]
    low: Float[Array, "rows columns"]
    high: Float[Array, "rows columns"]
    front: Float[Array, "rows columns"]
    taken: Float[Array, "rows columns"]


def interpolation_error(
    grid: Grid, lattice: Lattice, camera: Camera, transfer: TransferFunction, slab_samples: int
) -> InterpolationError:
    """Of a band; infinite variance wherever a stencil may leave the lattice, or there is none."""

    def nothing() -> InterpolationError:
        shape, dtype = grid.windows.count.shape, lattice.weight.dtype
        return InterpolationError(
            jnp.full(shape, jnp.inf, dtype), jnp.full(shape, SUBSAMPLED_SHARE, dtype), jnp.zeros(shape, dtype)
        )

    found = functools.partial(_swept, grid, lattice, camera, transfer, slab_samples)
    return lax.cond((lattice.evaluations > 0).any(), found, nothing)


@dataclasses.dataclass(frozen=True)
class _Nodes:
    """The lattice in memory, and what all slabs of a band are judged by.

    Attributes:
        segments, squares: of the parts of the transfer function.
        path: path length of the nodes' rays a unit of depth, longest of each bundle as `longest`.
        edges: depths of layers.
        within: layers of a slab.
        pixel: size of a pixel at depth 1 (perspective) or any depth.
    """

    weight: Float[Array, " nodes"]
    weighted: tuple[Float[Array, " nodes"], ...]
    lattice: Lattice
    segments: tuple[Segments, ...]
    squares: tuple[SquaredSlopes, ...]
    path: Float[Array, " nodes"]
    longest: Float[Array, "rows columns"]
    edges: Float[Array, " layers"]
    pixel: Float[Array, ""]
    within: int
    perspective: bool

    @property
    def down_across(self) -> tuple[int, int]:
        """Nodes of a layer, without the gap."""
        rows, columns = self.lattice.weight.shape[1:]
        return rows - GAP, columns - GAP

    @property
    def layer(self) -> int:
        """How far apart in memory neighbours in depth are."""
        _, rows, columns = self.lattice.weight.shape
        return rows * columns

    def pooled(self, value: Float[Array, " nodes"], combine: Combine) -> Float[Array, "rows columns"]:
        """Nodes of a layer combined over each bundle."""
        down, across = self.down_across
        return _pooled(value, combine, down=down, across=across, of_bundle=self.lattice.region.spacing.across)

    def judge(self, sweep: Sweep, slab: Array) -> tuple[Sweep, tuple[Array, Array, Array]]:
        """Variance, share and bend of a slab, (rows, columns); and what the next takes over."""
        spacing, within, always = self.lattice.region.spacing, self.within, slab >= 0
        begin, number = (slab * within + 1) * self.layer, (within + 2 * REACH) * self.layer
        weight, *weighted = (lax.dynamic_slice_in_dim(value, begin, number) for value in (self.weight, *self.weighted))
        border = lax.dynamic_slice(self.edges, (slab * within,), (within + 1,))
        slab_samples = within * spacing.samples
        node_distance = spacing.pixels * self.pixel * (border[-1] if self.perspective else 1)
        correlated = jnp.maximum(slab_samples * node_distance / (border[-1] - border[0]), 1)
        at_nodes = functools.partial(
            _at_nodes, columns=self.lattice.weight.shape[2], layer=self.layer, node_samples=spacing.samples
        )
        looks = zip(weighted, self.lattice.references, self.segments, strict=True)
        new: list[AtNodes] = [fusion_barrier(always, at_nodes, weight, *one, correlated) for one in looks]
        layers = [
            AtNodes(*([a, *b] for a, b in zip(*both, strict=True)))  # type: ignore[arg-type]
            for both in zip(sweep.first, new, strict=True)
        ]
        extinction = list(layers[-1].extinction)
        absorbed = sum(extinction[k] * (border[k + 1] - border[k]) for k in range(within)) * self.path
        pool = functools.partial(_of_bundles, self.pooled, (within + 1) * (spacing.across + 1) ** 2)
        bundles: list[OfBundles] = [
            fusion_barrier(always, pool, list(one.variance), list(one.across), list(one.quantity), sweep.tau, absorbed)
            for one in layers
        ]
        length = (border[-1] - border[0]) * self.longest
        errors = (self._variance(*one, correlated, length) for one in zip(bundles, self.squares, strict=True))
        variance = functools.reduce(jnp.add, errors) / slab_samples
        colors = [list(layers[0].red), list(layers[0].green), list(layers[0].blue)]
        step = (border[1:] - border[:-1])[:, None] * self.path
        bends = fusion_barrier(always, second_differences, colors, extinction, step, sweep.tau, sweep.light)
        bend = jnp.sqrt(self.pooled(bends[0] ** 2, jnp.add)) / (spacing.across + 1)
        last = tuple(AtNodes(*(value[-1] for value in one)) for one in new)
        share = functools.reduce(jnp.maximum, (bundle.share for bundle in bundles))
        return Sweep(sweep.tau + absorbed, bends[1], last), (variance, share, bend)

    def _variance(
        self, bundle: OfBundles, squares: SquaredSlopes, correlated: Array, length: Array
    ) -> Float[Array, "rows columns"]:
        """Of a slab's light by one quantity, times its samples.

        Samples that err as one are in the deviation; the rest is independent: a sum grows by the root of its number, a mean
        falls so.
        """
        around = DEVIATIONS_AROUND * bundle.deviation / jnp.sqrt(correlated)
        *of_colors, of_extinction = mean_square_slope(squares, bundle.low - around, bundle.high + around)
        light = of_extinction * length**2 + functools.reduce(jnp.maximum, of_colors) * bundle.taken**2
        return bundle.front**2 * bundle.deviation**2 * light

    def skip(self, sweep: Sweep, _: Array) -> tuple[Sweep, tuple[Array, Array, Array]]:
        """An empty slab before an empty one."""
        nothing = jnp.zeros_like(self.longest)
        still = jax.tree.map(jnp.zeros_like, sweep)
        return still._replace(tau=sweep.tau), (nothing, nothing + SUBSAMPLED_SHARE, nothing)


def _swept(grid: Grid, lattice: Lattice, camera: Camera, transfer: TransferFunction, slab_samples: int) -> InterpolationError:
    """Slab by slab from front to back, such that what is at hand stays in the cache."""
    nodes = _nodes(grid, lattice, camera, transfer, slab_samples)
    slabs, path = grid.windows.count.shape[0], nodes.path
    # the first layer counts as empty: its slab is not interpolated anyway
    nothing = jnp.zeros_like(path)
    empty = (AtNodes(*[nothing] * len(AtNodes._fields)),) * len(nodes.segments)
    start = Sweep(nothing, jnp.zeros((4, *path.shape), path.dtype), empty)
    filled = jnp.append((grid.windows.count > 0).any(1), False)
    judged = filled[:-1] | filled[1:]  # the last layer of a slab is the first of the next
    each = jnp.arange(slabs, dtype=jnp.int32), judged
    found = lax.scan(lambda sweep, x: lax.cond(x[1], nodes.judge, nodes.skip, sweep, x[0]), start, each)[1]
    variance, share, bend = found
    variance += (MIN_DEVIATION * jnp.finfo(variance.dtype).eps) ** 2
    return _of_grid(grid, lattice, nodes.within, jnp.where(_spared(grid, lattice, nodes.within), variance, jnp.inf), share, bend)


def _nodes(grid: Grid, lattice: Lattice, camera: Camera, transfer: TransferFunction, slab_samples: int) -> _Nodes:
    spacing, slabs = lattice.region.spacing, grid.windows.count.shape[0]
    rows, columns = lattice.weight.shape[1:]
    within = slab_samples // spacing.samples
    weight, *weighted = (value.ravel() for value in (lattice.weight, *lattice.weighted))
    path = _slant(lattice, camera, rows, columns).ravel()
    longest = _pooled(path, jnp.maximum, down=rows - GAP, across=columns - GAP, of_bundle=spacing.across)
    # one more border than there are samples, and layers past the last
    last = grid.half_steps.shape[0] - 1
    edges = grid.half_steps[jnp.minimum(2 * spacing.samples * jnp.arange(slabs * within + 1, dtype=jnp.int32), last)]
    pixel = 2 * camera.half_height.astype(path.dtype) / camera.height
    parts = transfer.parts()
    tables = tuple(part.segments() for part in parts), tuple(map(squared_slopes, parts))
    return _Nodes(weight, tuple(weighted), lattice, *tables, path, longest, edges, pixel, within, camera.is_perspective)


def _spared(grid: Grid, lattice: Lattice, within: int) -> Array:
    """Slabs (slabs, rows, columns) whose cubics take no nodes beyond the lattice: not the first, nor the last."""
    region, spacing = lattice.region, lattice.region.spacing
    slab, row, column = (jnp.arange(n, dtype=jnp.int32) for n in (grid.windows.count.shape[0], region.rows, region.columns))
    inside = (slab > 0) & ((slab + 1) * within < (grid.samples - 1) // spacing.samples)
    past = -(-2 // spacing.across)  # bundles at the far sides from which a cubic takes nodes beyond
    inside_rows, inside_columns = (row > 0) & (row < region.rows - past), (column > 0) & (column < region.columns - past)
    return inside[:, None, None] & inside_rows[:, None] & inside_columns


def _of_grid(grid: Grid, lattice: Lattice, within: int, variance: Array, share: Array, bend: Array) -> InterpolationError:
    """From the bundles of a region (slabs, rows, columns) to those of a grid; infinite variance elsewhere."""
    row, column, inside = lattice.region.place(grid)
    at = jnp.where(inside, row * lattice.region.columns + column, 0)
    variance, share, bend = (value.reshape(value.shape[0], -1)[:, at] for value in (variance, share, bend))
    return InterpolationError(jnp.where(inside, variance, jnp.inf), share, bend)


def _of_bundles(
    pooled: Callable[[Array, Combine], Array],
    number: int,
    variance: list[Array],
    across: list[Array],
    quantity: list[Array],
    tau: Array,
    absorbed: Array,
) -> OfBundles:
    """The nodes of a slab's layers, those of the next slab's first among them, pooled over bundles of `number` nodes."""

    def pool(layers: Sequence[Array], combine: Combine) -> Array:
        return pooled(functools.reduce(combine, layers), combine)

    total, lateral = pool(variance, jnp.add), pool(across, jnp.add)
    deviation = jnp.sqrt(total / number)
    share = SUBSAMPLED_SHARE * jnp.clip(lateral / jnp.where(total > 0, total, 1), MIN_ACROSS, 1)
    front, taken = jnp.exp(-pool([tau], jnp.minimum)), -jnp.expm1(-pool([absorbed], jnp.maximum))
    return OfBundles(deviation, share, pool(quantity, jnp.minimum), pool(quantity, jnp.maximum), front, taken)


def _at_nodes(
    weight: Array,
    weighted: Array,
    reference: Array,
    segments: Segments,
    correlated: Array,
    *,
    columns: int,
    layer: int,
    node_samples: int,
) -> AtNodes:
    """What nodes in a row tell, without `REACH` layers on either side.

    Args:
        correlated: how many samples in a row err as one across.
        columns, layer: how far apart in memory neighbours are down and in depth.
        node_samples: fine samples from one layer to the next, that err as one in depth.
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
    variance, across, unsure = jnp.zeros_like(ratio), jnp.zeros_like(ratio), jnp.zeros_like(ratio)
    for stride in (1, columns, layer):
        across = variance
        of_weight = fourth(weight, stride)
        unsure += CUBIC * jnp.abs(of_weight)
        error = (CUBIC * (fourth(weighted, stride) - ratio * of_weight)) ** 2
        variance += (node_samples if stride == layer else correlated) * error
    clear = inside & (here > MIN_CLEARANCE * unsure)
    variance, across = jnp.where(clear, variance * inverse**2, jnp.inf), across * inverse**2
    quantity = reference + ratio
    place = fusion_barrier(correlated > 0, find, segments, quantity)
    *colors, extinction = read(segments, place)
    found = variance, across, quantity, *colors, jnp.where(inside, extinction, 0)
    return AtNodes(*(value.reshape(-1, layer) for value in found))


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


jax.tree_util.register_dataclass(InterpolationError, data_fields=["variance", "subsampled_share", "bend"], meta_fields=[])
