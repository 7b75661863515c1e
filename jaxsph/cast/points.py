r"""Ray casting of particles: thread-coherent marching of the first paper's section 6.3, as a few fat XLA kernels.

Flow: cells -> [points] -> image.

Every bundle's filled cells are stacked front to back without gaps, and marched layer by layer of that stack: first every
bundle's first filled cell, then its second. In a layer, bundles are ordered by the number of particles of their cell and taken
`chunk` at a time, so that a chunk's trip counts are nearly their mean and empty space costs nothing. A cell is marched slab by
slab, and blocks of `BLOCK` particles are added to all samples of a slab at once. Shapes, once: accumulators are (chunk, samples
of a slab, 8 rows, 8 columns).

The perspective grid makes the squared distance separable. A sample sits at $(a_k u_c, a_k v_r, s_k)$ with $a = s$
(perspective) or 1 (orthographic), so the squared distance in supports is $A_{kc} + D_{kr}$ with $A_{kc} = ((a_k u_c - X) / H)^2$
and $D_{kr} = ((s_k - Z) / H)^2 + ((a_k v_r - Y) / H)^2$: one addition a sample, or for poly6 one subtraction from the margin
$1 - D_{kr}$. Differences to the particle are taken before they are squared, so nothing cancels.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.access.cells import Cells
from jaxsph.access.lists import BUNDLE, BundleLists
from jaxsph.access.ordering import Ordered
from jaxsph.model import kernels
from jaxsph.model.camera import Camera
from jaxsph.model.transfer import Segments, TransferFunction, look_up
from jaxsph.numerics.staging import computed_once

BLOCK = 16  # particles unrolled in the inner loop


@dataclasses.dataclass(frozen=True)
class CastPlan:
    """Static sizes of the march.

    Attributes:
        chunk: bundles marched together.
        slab_samples: samples that share a window of particles.
        slabs_per_cell: slabs marched in a row, for which the state of the rays is fetched and stored once.
    """

    chunk: int
    slab_samples: int
    slabs_per_cell: int

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if getattr(self, field.name) < 1:
                raise ValueError(f"`{field.name}` must be at least 1, got {getattr(self, field.name)}")

    @property
    def cell_samples(self) -> int:
        """Samples of a cell along depth (D_z in the first paper)."""
        return self.slab_samples * self.slabs_per_cell


@dataclasses.dataclass(frozen=True)
class Rays:
    """State of all rays of a band: premultiplied colour, transmittance, depth of half transmittance, kernel evaluations."""

    color: Float[Array, "3 bundles 8 8"]
    transmittance: Float[Array, "bundles 8 8"]
    depth: Float[Array, "bundles 8 8"]
    evaluations: Float[Array, " bundles"]


def cast_points(
    ordered: Ordered,
    lists: BundleLists,
    cells: Cells,
    origins: tuple[Int[Array, " bundles"], Int[Array, " bundles"]],
    camera: Camera,
    transfer: TransferFunction,
    depths: Float[Array, " samples"],
    edges: Float[Array, " samples_and_one"],
    kernel: str,
    plan: CastPlan,
) -> Rays:
    """March all bundles of a band at full rate.

    Args:
        ordered, lists, cells: the sparse perspective grid.
        origins: pixel row and column of each bundle.
        depths, edges: view depths of the samples and of the borders between them, length units.
        kernel: name of the smoothing kernel.
    """
    slabs, num_bundles = cells.count.shape
    dtype = ordered.x.dtype
    in_slab = jnp.minimum(plan.slab_samples, depths.shape[0] - jnp.arange(slabs) * plan.slab_samples)
    evaluations = (cells.count.astype(jnp.float32) * in_slab[:, None].astype(jnp.float32)).sum(0)
    missing = -slabs % plan.slabs_per_cell
    count = jnp.pad(cells.count, ((0, missing), (0, 0))).reshape(-1, plan.slabs_per_cell, num_bundles).sum(1)
    cell_of, order, num_chunks = _schedule(count, plan.chunk)
    padding = (slabs + missing) * plan.slab_samples - depths.shape[0]
    depths = jnp.pad(depths, (0, padding), mode="edge")
    edges = jnp.pad(edges, (0, padding), mode="edge")  # samples past the end have length zero
    segments = transfer.segments()
    state = (
        *(jnp.zeros((num_bundles + 1, BUNDLE, BUNDLE), dtype) for _ in range(3)),
        jnp.ones((num_bundles + 1, BUNDLE, BUNDLE), dtype),
        jnp.full((num_bundles + 1, BUNDLE, BUNDLE), jnp.inf, dtype),
    )
    row, column = (jnp.append(origin, 0) for origin in origins)
    begin, length = (jnp.pad(window, ((0, 0), (0, missing), (0, 1))) for window in (cells.begin, cells.length))

    def march_layer(layer: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        def march_chunk(chunk: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
            bundle = lax.dynamic_slice(order, (layer, chunk * plan.chunk), (1, plan.chunk))[0]
            pixel = jnp.arange(BUNDLE, dtype=jnp.int32)
            u = camera.column((column[bundle][:, None] + pixel).astype(dtype) + 0.5)
            v = camera.row((row[bundle][:, None] + pixel).astype(dtype) + 0.5)

            def march_slab(k: Array, rays: list[Array]) -> list[Array]:
                slab = cell_of[layer, bundle] * plan.slabs_per_cell + k
                sample = (slab * plan.slab_samples)[:, None] + jnp.arange(plan.slab_samples + 1, dtype=jnp.int32)
                s, border = depths[sample[:, :-1]], edges[sample]
                window = begin[:, slab, bundle], length[:, slab, bundle]
                sums = _gather_field(ordered, lists.rank, window, (u, v, s), camera.is_perspective, kernel)
                shade = functools.partial(_shade, perspective=camera.is_perspective)
                shaded = computed_once(k >= 0, shade, *sums, (u, v, border), segments)
                return _composite(rays, shaded, border)

            rays = lax.fori_loop(0, plan.slabs_per_cell, march_slab, [field[bundle] for field in state])
            return tuple(field.at[bundle].set(new) for field, new in zip(state, rays, strict=True))

        return lax.fori_loop(0, num_chunks[layer], march_chunk, state)

    layers = (num_chunks > 0).sum()
    *color, transmittance, depth = (field[:-1] for field in lax.fori_loop(0, layers, march_layer, state))
    return Rays(jnp.stack(color), transmittance, depth, evaluations)


def _schedule(count: Int[Array, "cells bundles"], chunk: int) -> tuple[Array, Array, Array]:
    """Which cells are marched when.

    Returns:
        The place along depth of each bundle's filled cells, front to back, (layers, bundles + 1); for each layer the bundles
        that have one, fullest first, padded to whole chunks with the dummy bundle; and each layer's number of chunks.
    """
    depth, bundles = count.shape
    filled = count > 0
    layer = jnp.where(filled, jnp.cumsum(filled, 0) - 1, depth)
    every = jnp.broadcast_to(jnp.arange(bundles), count.shape)
    cell_of = jnp.zeros((depth, bundles + 1), jnp.int32)
    cell_of = cell_of.at[layer, every].set(jnp.arange(depth, dtype=jnp.int32)[:, None], mode="drop")
    stacked = jnp.zeros_like(count).at[layer, every].set(count, mode="drop")
    bits = (bundles + 1).bit_length()
    key = (jnp.minimum(stacked, (1 << (32 - bits)) - 1).astype(jnp.uint32) << bits) | every.astype(jnp.uint32)
    key = ~lax.sort(~key, dimension=1)
    order = (key & jnp.uint32((1 << bits) - 1)).astype(jnp.int32)
    active = (stacked > 0).sum(1)
    order = jnp.where(jnp.arange(bundles) < active[:, None], order, bundles)
    order = jnp.pad(order, ((0, 0), (0, -bundles % chunk)), constant_values=bundles)
    return cell_of, order, (active + chunk - 1) // chunk


def _gather_field(
    ordered: Ordered,
    rank: Int[Array, " pairs"],
    window: tuple[Int[Array, "classes chunk"], Int[Array, "classes chunk"]],
    rays: tuple[Array, Array, Array],
    perspective: bool,
    kernel: str,
) -> tuple[Array, Array]:
    """Sums of V W and q V W (up to one common factor) at every sample of the chunk's cells.

    The two sums travel as one complex number: of a pair XLA makes two kernels, and each evaluates every weight again.
    """
    u, v, s = rays
    begin, length = window
    total = length.sum(0)
    spread = s if perspective else jnp.ones_like(s)
    su, sv = u[:, None, :] * spread[:, :, None], v[:, None, :] * spread[:, :, None]
    columns = (ordered.x, ordered.y, ordered.z, ordered.scale, ordered.size, ordered.quantity)
    smooth = kernels.by_name(kernel)

    def add_block(block: Array, sums: Array) -> Array:
        index = block * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)
        across, along, size, quantity = computed_once(block >= 0, separate, index)
        weight, weighted = sums.real, sums.imag
        for k in range(BLOCK):
            rest = across[:, k, :, None, :]
            w = smooth.weigh(along[:, k, :, :, None], rest, size[:, k, None, None, None], jnp)
            weight = weight + w
            weighted = weighted + w * quantity[:, k, None, None, None]
        return lax.complex(weight, weighted)

    def separate(index: Array) -> tuple[Array, ...]:
        """The two parts of the squared distance, sizes and quantities of a block of particles; size 0 past the last."""
        inside = index < total[:, None]
        particle = rank[jnp.clip(_position(index, begin, length), 0, rank.shape[0] - 1)]
        x, y, z, scale, size, quantity = (column[particle] for column in columns)
        scale, size = jnp.where(inside, scale, 0), jnp.where(inside, size, 0)
        x, y, z, scale = (value[:, :, None, None] for value in (x, y, z, scale))
        across = ((su[:, None] - x) * scale) ** 2
        along = ((s[:, None, :, None] - z) * scale) ** 2 + ((sv[:, None] - y) * scale) ** 2
        return across, smooth.prepare(along, size[:, :, None, None]), size, quantity

    zero = jnp.zeros((*su.shape[:2], BUNDLE, BUNDLE), su.dtype)
    blocks = (total.max() + BLOCK - 1) // BLOCK
    sums = lax.fori_loop(0, blocks, add_block, lax.complex(zero, zero))
    return sums.real, sums.imag


def _position(index: Array, begin: Array, length: Array) -> Array:
    """Where the `index`-th particle of a cell stands in the lists: the cell's windows, one class after the other."""
    position = begin[0][:, None] + index
    before = length[0]
    for k in range(1, begin.shape[0]):
        position = jnp.where(index >= before[:, None], (begin[k] - before)[:, None] + index, position)
        before = before + length[k]
    return position


def _shade(
    weight: Array, weighted: Array, geometry: tuple[Array, Array, Array], segments: Segments, *, perspective: bool
) -> list[Array]:
    """Red, green, blue, optical thickness and transmittance of every sample: first paper, equation 2 and section 2.2."""
    u, v, border = geometry
    inside = weight > 0
    quantity = jnp.where(inside, weighted / jnp.where(inside, weight, 1), 0)
    *channels, extinction = look_up(segments, quantity)
    per_depth = jnp.ones_like(u[:, None, :] * v[:, :, None])
    if perspective:
        per_depth = jnp.sqrt(1 + u[:, None, :] ** 2 + v[:, :, None] ** 2)
    step = border[:, 1:] - border[:, :-1]
    thickness = jnp.where(inside, extinction * (step[:, :, None, None] * per_depth[:, None]), 0)
    return [*channels, thickness, jnp.exp(-thickness)]


def _composite(rays: list[Array], shaded: list[Array], border: Array) -> list[Array]:
    """Front to back over the samples of the cells: first paper, equation 3.

    A sample adds its colour times the light it takes away, `T - T T_i`: however thin the samples, colours then add up to
    exactly the alpha that is lost.
    """
    *color, transmittance, depth = rays
    *channels, thickness, passed = shaded
    before, crossing, length, front = (jnp.full_like(depth, value) for value in (1, 1, 0, jnp.inf))
    for k in range(passed.shape[1]):
        behind = transmittance * passed[:, k]
        color = [total + (transmittance - behind) * channel[:, k] for total, channel in zip(color, channels, strict=True)]
        crossed = (transmittance > 0.5) & (behind <= 0.5)
        before = jnp.where(crossed, transmittance, before)
        crossing = jnp.where(crossed, thickness[:, k], crossing)
        start, end = border[:, k, None, None], border[:, k + 1, None, None]
        length = jnp.where(crossed, end - start, length)
        front = jnp.where(crossed, start, front)
        transmittance = behind
    depth = jnp.minimum(depth, front + jnp.log(2 * before) / crossing * length)
    return [*color, transmittance, depth]


jax.tree_util.register_dataclass(Rays, data_fields=["color", "transmittance", "depth", "evaluations"], meta_fields=[])
