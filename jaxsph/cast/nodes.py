"""Sums over particles at the nodes of a lattice, and at the samples between.

Flow: grid -> [nodes] -> control.pilot -> worklist -> points -> image.

A bundle owns so few nodes that cells, not rays, lie side by side in memory.
"""

from __future__ import annotations

import functools
import math

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, Int

from jaxsph.access.cells import position
from jaxsph.access.grid import Grid
from jaxsph.access.lattice import GAP, REACH, Lattice, Region, Spacing, between, cubic, node_at
from jaxsph.access.lists import BUNDLE
from jaxsph.access.stacks import fullest_first
from jaxsph.control.merge import coarser_windows
from jaxsph.control.worklist import CELL
from jaxsph.model import kernels
from jaxsph.model.camera import Camera
from jaxsph.numerics.staging import computed_once

CHUNK = 256  # cells at once
BLOCK = 8  # particles unrolled in the inner loop
NODES = 8  # at most, in depth and across, times those down, share a window: deeper ones hold particles that miss most of theirs


def sum_at_nodes(
    grid: Grid,
    camera: Camera,
    kernel: str,
    slab_samples: int,
    region: Region,
    origin: Float[Array, ""],
    wanted: Bool[Array, ""] | bool = True,
) -> Lattice:
    """Sums at the nodes of a region, zero where no particle can be; all zero, and for nothing, if they are not `wanted`.

    Args:
        grid: of a band, or of a part of it.
        region: of the band.
        origin: quantity that sums are taken relative to.
    """
    spacing, (row, column, has_nodes) = region.spacing, region.place(grid)
    across = spacing.across
    layers = max(min(NODES // across, CELL // spacing.samples), slab_samples // spacing.samples)
    depth = layers * spacing.samples
    cells = -(-grid.cells.count.shape[0] * slab_samples // depth)
    windows = coarser_windows(grid.cells, slab_samples)[(depth // slab_samples).bit_length() - 1]
    begin, length = windows.begin[:, :cells], windows.length[:, :cells]
    count = jnp.where(wanted & has_nodes, length.sum(0, dtype=jnp.int32), 0)
    bundles = count.shape[1]
    chunk = min(CHUNK, -(-cells * bundles // 16) * 16)
    order, number = fullest_first((count > 0).ravel(), count.ravel(), chunk)
    last = grid.half_steps.shape[0] - 1
    shape = REACH + cells * layers + GAP, *(across * number + GAP for number in (region.rows, region.columns))
    deep, down, right = (jnp.arange(n, dtype=jnp.int32) for n in (layers, across, across))

    def march(step: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        at = lax.dynamic_slice(order, (step * chunk,), (chunk,))
        real = step * chunk + jnp.arange(chunk, dtype=jnp.int32) < number
        cell, bundle = at // bundles, at % bundles
        u, v = (rays[:: spacing.pixels] for rays in grid.rays(camera, bundle))
        s = grid.half_steps[jnp.minimum(2 * (cell * depth + deep[:, None] * spacing.samples) + 1, last)]
        window = begin[:, cell, bundle], jnp.where(real, length[:, cell, bundle], 0)
        found = sums_at(grid, window, (u, v, s), origin, camera.is_perspective, kernel)
        first = row[bundle] * across, column[bundle] * across
        place = cell * layers + deep[:, None, None, None], first[0] + down[:, None, None], first[1] + right[:, None]
        target = jnp.where(real, node_at(shape, *place), math.prod(shape) - 1)  # the last one stays zero
        weight, weighted = (old.at[target].set(new, mode="promise_in_bounds") for old, new in zip(sums, found, strict=True))
        return weight, weighted

    nothing = jnp.zeros(math.prod(shape), grid.ordered.x.dtype)
    weight, weighted = lax.fori_loop(0, (number + chunk - 1) // chunk, march, (nothing, nothing))
    spent = count.astype(jnp.float32).sum(0) * (layers * across**2 / BUNDLE**2)
    return Lattice(weight.reshape(shape), weighted.reshape(shape), origin, region, spent)


def sums_at(
    grid: Grid, window: tuple[Array, Array], nodes: tuple[Array, Array, Array], origin: Array, perspective: bool, kernel: str
) -> Float[Array, "2 deep down across chunk"]:
    """Sums of V W and (q - origin) V W at the nodes of a chunk of cells; see `points.gather_field`.

    Args:
        window: where the particles of each cell begin in the lists, and how many there are, by class of supports.
        nodes: u (across, chunk), v (down, chunk) and depths (deep, chunk).
        origin: one for all cells, or one each.
    """
    ordered, rank = grid.ordered, grid.lists.rank
    u, v, s = nodes
    total = window[1].sum(0)
    spread = s if perspective else jnp.ones_like(s)
    su, sv = u * spread[:, None], v * spread[:, None]
    columns = (ordered.x, ordered.y, ordered.z, ordered.scale, ordered.size, ordered.quantity)
    smooth = kernels.by_name(kernel)

    def fetch(index: Array) -> list[Array]:
        inside = index < total
        place = position(index, window[0][:, None], window[1][:, None])
        particle = rank[jnp.clip(place, 0, rank.shape[0] - 1)]
        x, y, z, scale, size, quantity = (column[particle] for column in columns)
        return [x, y, z, jnp.where(inside, scale, 0), jnp.where(inside, size, 0), quantity - origin]

    def separate(*particles: Array) -> tuple[Array, Array]:
        """The two parts of the squared distance, see `points.gather_field`."""
        x, y, z, scale, size, _ = (column[..., None, None, :] for column in particles)
        across = ((su - x) * scale) ** 2
        along = ((s[:, None] - z) * scale) ** 2 + ((sv - y) * scale) ** 2
        return across, smooth.prepare(along, size)

    several = u.shape[0] > 1  # of a single node across, neither part would be read twice

    def add_block(block: Array, sums: Array) -> Array:
        index = block * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)[:, None]
        particles = computed_once(block >= 0, fetch, index)
        parts = computed_once(block >= 0, separate, *particles) if several else ()
        weight, weighted = sums.real, sums.imag
        for k in range(BLOCK):
            *_, size, quantity = one = [column[k] for column in particles]
            across, along = (part[k] for part in parts) if several else separate(*one)
            w = smooth.weigh(along[:, :, None], across[:, None], size, jnp)
            weight, weighted = weight + w, weighted + w * quantity
        return lax.complex(weight, weighted)

    zero = jnp.zeros((s.shape[0], v.shape[0], u.shape[0], s.shape[1]), s.dtype)
    sums = lax.fori_loop(0, (total.max() + BLOCK - 1) // BLOCK, add_block, lax.complex(zero, zero))
    return jnp.stack([sums.real, sums.imag])


def interpolate(
    lattice: Lattice, slab: Int[Array, " chunk"], corner: tuple[Array, Array], slab_samples: int, level: int = 0
) -> Complex[Array, "chunk samples 64"]:
    """Sums at all samples of slabs, by the tensor product of cubics through the nearest four nodes along each axis.

    Args:
        slab: slabs that lie inside the lattice, with a node to spare on every side.
        corner: first node of their bundles, down and across.
        slab_samples: samples of a slab.
        level: samples are `2**level` fine samples apart.

    Returns:
        V W as real, (q - origin) V W as imaginary part.
    """
    spacing, step = lattice.region.spacing, 1 << level
    within = slab_samples // spacing.samples
    first = jnp.stack([REACH + slab * within - 1, corner[0] - 1, corner[1] - 1], -1)
    near = functools.partial(_near, layers=within * step + 3)
    # at hand before anything is made of it: each of the nodes would be fetched for every sample that it is a part of
    nodes = computed_once(slab[0] >= 0, near, lattice, first)
    across = between(spacing.across, spacing.pixels)
    lateral = jnp.asarray(np.kron(across, across).T, nodes.real.dtype)

    def spread(nodes: Array) -> Array:
        return jnp.matmul(_in_depth(nodes, step, spacing, slab_samples), lateral, precision=lax.Precision.HIGHEST)

    return lax.complex(spread(nodes.real), spread(nodes.imag))


def _near(lattice: Lattice, first: Int[Array, "chunk 3"], *, layers: int) -> Complex[Array, "chunk layers nodes"]:
    """Both sums at the nodes around items, those of a layer in a row, from the `first` on."""
    around = lax.GatherDimensionNumbers(offset_dims=(1, 2, 3), collapsed_slice_dims=(), start_index_map=(0, 1, 2))
    across = lattice.region.spacing.across + 3
    size = layers, across, across
    found = (lax.gather(sums, first, around, size, mode="clip") for sums in (lattice.weight, lattice.weighted))
    return lax.complex(*found).reshape(first.shape[0], layers, -1)


def _in_depth(
    nodes: Float[Array, "chunk layers nodes"], step: int, spacing: Spacing, samples: int
) -> Float[Array, "chunk samples nodes"]:
    """Layers in the middle of every `step` fine samples."""
    each = max(spacing.samples // step, 1)  # samples past a layer of nodes, before the next
    stride = max(step // spacing.samples, 1)
    past = [((k + 0.5) * step - 0.5) / spacing.samples for k in range(each)]
    begin = int(past[0])
    taps, layers = jnp.asarray([cubic(t - begin) for t in past], nodes.dtype)[..., None], nodes[:, :, None]
    # broadcast over the samples past a node rather than stacked: of a stack XLA evaluates every row apart
    near = (layers[:, begin + k :: stride][:, : samples // each] for k in range(4))
    return functools.reduce(jnp.add, (taps[:, k] * at for k, at in enumerate(near))).reshape(nodes.shape[0], samples, -1)
