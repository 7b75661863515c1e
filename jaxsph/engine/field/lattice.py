"""The lattice of nodes that neighbouring bundles share: sums over particles, for all samples between to be interpolated from.

Flow: grid -> [lattice] -> control, media.

Sums over particles are as smooth as the kernel, whatever the transfer function makes of their ratio. So nodes are every few
rays and every few fine samples, as far apart as supports allow: a small part of all samples. Samples between are found by cubics.
A bundle owns so few nodes that cells, not rays, lie side by side in memory: arrays of sums at nodes have slabs (or cells) last.

Where a lattice does not tell enough, the rays of `SUBSAMPLE` often do, at a quarter of the evaluations: they are up to three
pixels apart, and every sample along them is taken. No ray outside the bundle is needed, for which its lists would lack particles.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.compaction import fullest_first
from jaxsph.engine.access.grid import CELL_SAMPLES, Grid, coarser_windows
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.access.view import Ordered
from jaxsph.engine.field.sums import Block, Sums, fetch, particle_at, sums_of, with_block
from jaxsph.engine.field.tasks import MAX_SPACING_LEVEL, SUBSAMPLE, SlabTask, Spacing
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles import kernels
from jaxsph.numerics.compiled import barriers_kept, fusion_barrier
from jaxsph.numerics.trees import tree

REACH = 2  # nodes to either side that a fourth difference takes
GAP = REACH + 1  # nodes without anything past the last along each axis: a fourth difference, and the far border of a slab
BLOCK = 8  # particles unrolled in the inner loop
MAX_NODES = 8  # in depth and across, times those down, that share a window: deeper ones hold particles that miss most of theirs


@tree(static=("rows", "columns", "spacing"))
class Region:
    """The bundles of a band that have nodes: those around all that is seen, as far as there is room.

    Attributes:
        row, column: of pixels, of the first bundle.
        rows, columns: of bundles; static, as is the spacing.
        spacing: of nodes.
    """

    row: Int[Array, ""]
    column: Int[Array, ""]
    rows: int
    columns: int
    spacing: Spacing

    def place(self, grid: Grid) -> tuple[Int[Array, " bundles"], Int[Array, " bundles"], Bool[Array, " bundles"]]:
        """Row and column in the region of a grid's bundles, and whether they are of the region at all."""
        row, column = (grid.row - self.row) // BUNDLE, (grid.column - self.column) // BUNDLE
        return row, column, (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)


def region_of(grid: Grid, rows: int, columns: int, spacing: Spacing) -> Region:
    """From the first row and column of bundles on that any particle can touch."""
    touched, far = grid.lists.end > grid.lists.start, jnp.iinfo(jnp.int32).max  # none is inside of a region that begins there
    row, column = jnp.where(touched, jnp.stack([grid.row, grid.column]), far).min(1)
    return Region(row, column, rows, columns, spacing)


@tree()
class Lattice:
    """Sums at the nodes of a region, up to one common factor.

    With `REACH` layers of zeros in front and `GAP` zeros past the last node along each axis: one after the other in memory,
    neighbours along any axis are then one shift away.

    Attributes:
        weight: of V W.
        weighted: of (q - reference) V W, for each quantity q.
        references: of each quantity, one amid the particles'.
        region: where the nodes are.
        evaluations: kernel evaluations that the nodes took, for each ray of a bundle of the band.
    """

    weight: Float[Array, "layers rows columns"]
    weighted: tuple[Float[Array, "layers rows columns"], ...]
    references: tuple[Float[Array, ""], ...]
    region: Region
    evaluations: Float[Array, " bundles"]

    def sums(self, grid: Grid, task: SlabTask, kernel: str, dense: Callable[[], Sums]) -> Sums:
        """Sums of slabs (tasks, samples, 8, 8), by the method that they have in common: `dense`, or one of those here."""
        if task.entry.method is None:
            return dense()

        def interpolated() -> Sums:
            row, column = (side[task.bundle] * self.region.spacing.across for side in self.region.place(grid)[:2])
            found = interpolate(self, task.slab, (row, column), task.depth.shape[1], task.entry.level[0])
            shape = (*found.packed[0].shape[:2], BUNDLE, BUNDLE)
            return dataclasses.replace(found, packed=tuple(value.reshape(shape) for value in found.packed))

        subsampled = functools.partial(gather_subsampled, grid.ordered, grid.lists.rank, task, kernel)
        # by the first slab, which is no dummy: `schedule.DENSE`, `SUBSAMPLED`, and `INTERPOLATED` and on
        return lax.switch(task.entry.method[0], (dense, subsampled, interpolated))  # type: ignore[no-any-return]


def sum_at_nodes(
    grid: Grid,
    camera: Camera,
    kernel: str,
    slab_samples: int,
    region: Region,
    references: tuple[Float[Array, ""], ...],
    cells_at_once: int,
    wanted: Bool[Array, ""] | bool = True,
) -> Lattice:
    """Sums at the nodes of a region, zero where no particle can be; all zero, and for nothing, if they are not `wanted`.

    Args:
        grid: of a band, or of a shard of it.
        region: of the band.
        references: what sums of each quantity are taken relative to.
    """
    spacing, (row, column, has_nodes) = region.spacing, region.place(grid)
    across = spacing.across
    layers = max(min(MAX_NODES // across, CELL_SAMPLES // spacing.samples), slab_samples // spacing.samples)
    depth = layers * spacing.samples
    cells = -(-grid.windows.count.shape[0] * slab_samples // depth)
    windows = coarser_windows(grid.windows)[(depth // slab_samples).bit_length() - 1]  # as deep as a cell of nodes
    begin, length = windows.begin[:, :cells], windows.length[:, :cells]
    count = jnp.where(wanted & has_nodes, length.sum(0, dtype=jnp.int32), 0)
    bundles = count.shape[1]
    last = grid.half_steps.shape[0] - 1
    widest = ((1 << MAX_SPACING_LEVEL) - 1) * slab_samples // spacing.samples  # layers that a stencil reads past a slab's own
    shape = REACH + cells * layers + widest + GAP, *(across * number + GAP for number in (region.rows, region.columns))
    deep, down, right = (jnp.arange(n, dtype=jnp.int32) for n in (layers, across, across))

    def march(sums: tuple[Array, ...], at: Array, real: Array) -> tuple[Array, ...]:
        cell, bundle = at // bundles, at % bundles
        u, v = (rays[:: spacing.pixels] for rays in grid.rays(camera, bundle))
        s = grid.half_steps[jnp.minimum(2 * (cell * depth + deep[:, None] * spacing.samples) + 1, last)]
        window = begin[:, cell, bundle], jnp.where(real, length[:, cell, bundle], 0)
        found = gather_nodes(grid.ordered, grid.lists.rank, window, (u, v, s), references, camera.is_perspective, kernel)
        first = row[bundle] * across, column[bundle] * across
        layer = REACH + cell * layers + deep[:, None, None, None]
        node = (layer * shape[1] + first[0] + down[:, None, None]) * shape[2] + first[1] + right[:, None]
        target = jnp.where(real, node, math.prod(shape) - 1)  # the last one stays zero
        return tuple(old.at[target].set(new, mode="promise_in_bounds") for old, new in zip(sums, found.all, strict=True))

    nothing = jnp.zeros(math.prod(shape), grid.ordered.x.dtype)
    start = (nothing,) * (1 + len(grid.ordered.quantities))
    sums = fullest_first(march, start, (count > 0).ravel(), count.ravel(), cells_at_once)
    weight, *weighted = (value.reshape(shape) for value in sums)
    spent = count.astype(jnp.float32).sum(0) * (layers * across**2 / BUNDLE**2)
    return Lattice(weight, tuple(weighted), references, region, spent)


def gather_nodes(
    ordered: Ordered,
    rank: Int[Array, " pairs"],
    window: tuple[Array, Array],
    rays: tuple[Float[Array, "across cells"], Float[Array, "down cells"], Float[Array, "deep cells"]],
    references: tuple[Array, ...],
    perspective: bool,
    kernel: str,
) -> Sums:
    """Sums (deep, down, across, cells) at the nodes of cells; see `field.gather`.

    Args:
        window: where the particles of each cell begin in the lists, and how many there are, by class of supports.
        rays: where nodes are: ray coordinates u and v, and depths.
        references: quantities that sums are taken relative to: of all cells, or of each.
    """
    u, v, s = rays
    total = window[1].sum(0)
    lateral_scale = s if perspective else jnp.ones_like(s)
    su, sv = u * lateral_scale[:, None], v * lateral_scale[:, None]
    windows = window[0][:, None], window[1][:, None]
    smooth = kernels.by_name(kernel)

    def fetched(index: Array) -> Block:
        return fetch(ordered, *particle_at(rank, *windows, index), references)

    def separate(x: Array, y: Array, z: Array, scale: Array, size: Array) -> tuple[Array, Array]:
        """The two parts of the squared distance."""
        x, y, z, scale, size = (column[..., None, None, :] for column in (x, y, z, scale, size))
        across = ((su - x) * scale) ** 2
        along = ((s[:, None] - z) * scale) ** 2 + ((sv - y) * scale) ** 2
        return across, smooth.prepare(along, size)

    several = u.shape[0] > 1  # of a single node across, neither part would be read twice

    def add_block(nth: Array, sums: Sums) -> Sums:
        block = fusion_barrier(nth >= 0, fetched, nth * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)[:, None])
        columns = block.x, block.y, block.z, block.scale, block.size
        parts = fusion_barrier(nth >= 0, separate, *columns) if several else ()

        def weighed(k: int) -> tuple[Array, list[Array]]:
            across, along = (part[k] for part in parts) if several else separate(*(column[k] for column in columns))
            w = smooth.weigh(along[:, :, None], across[:, None], block.size[k], jnp)
            return w, [quantity[k] for quantity in block.quantities]

        return with_block(sums, [weighed(k) for k in range(BLOCK)])

    zero = jnp.zeros((s.shape[0], v.shape[0], u.shape[0], s.shape[1]), s.dtype)
    start = sums_of([zero] * (1 + len(ordered.quantities)))
    return lax.fori_loop(0, (total.max() + BLOCK - 1) // BLOCK, add_block, start)


def gather_subsampled(ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str) -> Sums:
    """What `field.gather` sums up at every ray of a bundle, from its `SUBSAMPLE` rays; by cubics through these."""
    few, entry = np.asarray(SUBSAMPLE), task.entry
    rays = task.u.T[few], task.v.T[few], task.depth.T
    sums = gather_nodes(ordered, rank, (entry.begin, entry.length), rays, entry.references, task.perspective, kernel)
    stacked = jnp.stack(sums.all)
    by_slab = jnp.moveaxis(stacked.reshape(*stacked.shape[:2], -1, stacked.shape[-1]), 3, 1)  # while they are few
    lateral = jnp.asarray(np.kron(between_subsamples(), between_subsamples()).T, by_slab.dtype)
    spread = jnp.matmul(by_slab, lateral, precision=lax.Precision.HIGHEST)
    return sums_of(list(spread.reshape(*spread.shape[:3], BUNDLE, BUNDLE)))


def interpolate(
    lattice: Lattice, slab: Int[Array, " tasks"], corner: tuple[Array, Array], slab_samples: int, level: Int[Array, ""] | int = 0
) -> Sums:
    """Sums (tasks, samples, 64) at all samples of slabs, by the tensor product of cubics through the nearest four nodes.

    Args:
        slab: slabs that lie inside the lattice, with a node to spare on every side.
        corner: first node of their bundles, down and across.
        slab_samples: samples of a slab.
        level: samples are `2**level` fine samples apart, up to `MAX_SPACING_LEVEL`.
    """
    spacing = lattice.region.spacing
    within, across = slab_samples // spacing.samples, spacing.across + 3
    first = jnp.stack([REACH + slab * within - 1, corner[0] - 1, corner[1] - 1], -1)
    each = [(within << k) + 3 for k in range(MAX_SPACING_LEVEL + 1)]
    around = lax.GatherDimensionNumbers(offset_dims=(1, 2, 3), collapsed_slice_dims=(), start_index_map=(0, 1, 2))

    def near(layers: int) -> Sums:
        """Sums at the nodes around slabs (tasks, room, nodes), those of a layer in a row, of so many layers."""
        size, missing = (layers, across, across), ((0, 0), (0, each[-1] - layers), (0, 0))
        found = (lax.gather(sums, first, around, size, mode="clip") for sums in (lattice.weight, *lattice.weighted))
        return sums_of([jnp.pad(one.reshape(-1, layers, across**2), missing) for one in found])

    # at hand before anything is made of it: each of the nodes would be fetched for every sample that it is a part of
    nodes = lax.switch(level, [functools.partial(near, number) for number in each]) if barriers_kept() else near(each[-1])
    weights = between_nodes(spacing.across, spacing.pixels)
    lateral = jnp.asarray(np.kron(weights, weights).T, lattice.weight.dtype)
    in_depth = jnp.stack([_in_depth(channel, level, spacing, slab_samples) for channel in nodes.all])
    return sums_of(list(jnp.matmul(in_depth, lateral, precision=lax.Precision.HIGHEST)))


def _in_depth(
    nodes: Float[Array, "tasks layers nodes"], level: Int[Array, ""] | int, spacing: Spacing, samples: int
) -> Float[Array, "tasks samples nodes"]:
    """Layers in the middle of every `2**level` fine samples."""
    steps = 1 << np.arange(MAX_SPACING_LEVEL + 1)[:, None]
    # nodes sit on fine samples, whose middles are where they are: so a window of `step` has its own half a sample before its end
    past = ((np.arange(samples) + 0.5) * steps - 0.5) / spacing.samples
    layer = past.astype(np.int32)
    taps = jnp.asarray(cubic(past - layer), nodes.dtype)[:, level, :, None]
    near = (nodes.at[:, jnp.asarray(layer)[level] + k].get(mode="promise_in_bounds") for k in range(4))
    return functools.reduce(jnp.add, (tap * at for tap, at in zip(taps, near, strict=True)))


def between_nodes(cells: int, every: int) -> Float[np.ndarray, "points nodes"]:
    """Weights of the cubic through the nearest four nodes, for points that divide `cells` cells by `every`.

    Nodes begin one before the first cell and end one after the last.
    """
    table = np.zeros((cells * every, cells + 3))
    for point in range(cells * every):
        cell = point // every
        table[point, cell : cell + 4] = cubic(point % every / every)
    return table


def cubic(t: Any) -> tuple[Any, Any, Any, Any]:
    """Weights of nodes at -1, 0, 1 and 2 for the cubic through them at `t`."""
    return -t * (t - 1) * (t - 2) / 6, (t + 1) * (t - 1) * (t - 2) / 2, -(t + 1) * t * (t - 2) / 2, (t + 1) * t * (t - 1) / 6


def between_subsamples() -> Float[np.ndarray, "8 4"]:
    """Weights of `SUBSAMPLE` rays for each ray along a side of a bundle: the cubic through them, which meets them exactly."""
    near = np.asarray(SUBSAMPLE, float)
    weights = np.ones((BUNDLE, near.size))
    for k, here in enumerate(near):
        for other in np.delete(near, k):
            weights[:, k] *= (np.arange(BUNDLE) - other) / (here - other)
    return weights
