"""Sums over particles at the nodes of a lattice, or at a few rays of bundles.

Flow: grid -> [nodes] -> lattice -> control, media.

A bundle owns so few nodes that cells, not rays, lie side by side in memory: arrays have slabs (or cells) last.
"""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.compaction import fullest_first
from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.access.ordering import Ordered
from jaxsph.engine.access.slab_windows import CELL_SAMPLES, coarser_windows
from jaxsph.engine.field.fetch import Block, fetch
from jaxsph.engine.field.interpolation import spread_subsamples
from jaxsph.engine.field.lattice import GAP, REACH, Lattice, Region, node_at
from jaxsph.engine.field.schedule import MAX_SPACING_LEVEL, SUBSAMPLE
from jaxsph.engine.field.sums import Sums, sums_of, with_block
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles import kernels
from jaxsph.numerics.fusion import fusion_barrier

BLOCK = 8  # particles unrolled in the inner loop
MAX_NODES = 8  # in depth and across, times those down, that share a window: deeper ones hold particles that miss most of theirs


@dataclasses.dataclass(frozen=True)
class NodeRays:
    """Where nodes are: ray coordinates and depths, by cell."""

    u: Float[Array, "across cells"]
    v: Float[Array, "down cells"]
    depth: Float[Array, "deep cells"]


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
    windows = coarser_windows(grid.windows, slab_samples)[(depth // slab_samples).bit_length() - 1]  # as deep as a cell of nodes
    begin, length = windows.begin[:, :cells], windows.length[:, :cells]
    count = jnp.where(wanted & has_nodes, length.sum(0, dtype=jnp.int32), 0)
    bundles = count.shape[1]
    chunk = min(cells_at_once, -(-cells * bundles // 16) * 16)
    order, number = fullest_first((count > 0).ravel(), count.ravel(), chunk)
    last = grid.half_steps.shape[0] - 1
    widest = ((1 << MAX_SPACING_LEVEL) - 1) * slab_samples // spacing.samples  # layers that a stencil reads past a slab's own
    shape = REACH + cells * layers + widest + GAP, *(across * number + GAP for number in (region.rows, region.columns))
    deep, down, right = (jnp.arange(n, dtype=jnp.int32) for n in (layers, across, across))

    def march(step: Array, sums: tuple[Array, ...]) -> tuple[Array, ...]:
        at = lax.dynamic_slice(order, (step * chunk,), (chunk,))
        real = step * chunk + jnp.arange(chunk, dtype=jnp.int32) < number
        cell, bundle = at // bundles, at % bundles
        u, v = (rays[:: spacing.pixels] for rays in grid.rays(camera, bundle))
        s = grid.half_steps[jnp.minimum(2 * (cell * depth + deep[:, None] * spacing.samples) + 1, last)]
        window = begin[:, cell, bundle], jnp.where(real, length[:, cell, bundle], 0)
        rays = NodeRays(u, v, s)
        found = gather_nodes(grid.ordered, grid.lists.rank, window, rays, references, camera.is_perspective, kernel)
        first = row[bundle] * across, column[bundle] * across
        place = cell * layers + deep[:, None, None, None], first[0] + down[:, None, None], first[1] + right[:, None]
        target = jnp.where(real, node_at(shape, *place), math.prod(shape) - 1)  # the last one stays zero
        return tuple(old.at[target].set(new, mode="promise_in_bounds") for old, new in zip(sums, found.all, strict=True))

    nothing = jnp.zeros(math.prod(shape), grid.ordered.x.dtype)
    start = (nothing,) * (1 + len(grid.ordered.quantities))
    weight, *weighted = (value.reshape(shape) for value in lax.fori_loop(0, (number + chunk - 1) // chunk, march, start))
    spent = count.astype(jnp.float32).sum(0) * (layers * across**2 / BUNDLE**2)
    return Lattice(weight, tuple(weighted), references, region, spent)


def gather_nodes(
    ordered: Ordered,
    rank: Int[Array, " pairs"],
    window: tuple[Array, Array],
    rays: NodeRays,
    references: tuple[Array, ...],
    perspective: bool,
    kernel: str,
) -> Sums:
    """Sums (deep, down, across, cells) at the nodes of cells; see `field.gather`.

    Args:
        window: where the particles of each cell begin in the lists, and how many there are, by class of supports.
        references: quantities that sums are taken relative to: of all cells, or of each.
    """
    u, v, s = rays.u, rays.v, rays.depth
    total = window[1].sum(0)
    lateral_scale = s if perspective else jnp.ones_like(s)
    su, sv = u * lateral_scale[:, None], v * lateral_scale[:, None]
    windows = window[0][:, None], window[1][:, None]
    smooth = kernels.by_name(kernel)

    def fetched(index: Array) -> Block:
        return fetch(ordered, rank, windows, index, references)[1]

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
    """What `field.gather` sums up at every ray of a bundle, from its `SUBSAMPLE` rays; see `interpolation`."""
    few, entry = np.asarray(SUBSAMPLE), task.entry
    rays = NodeRays(task.u.T[few], task.v.T[few], task.depth.T)
    sums = gather_nodes(ordered, rank, (entry.begin, entry.length), rays, entry.references, task.perspective, kernel)
    return sums_of(list(spread_subsamples(jnp.stack(sums.all))))
