r"""Ray casting of particles: thread-coherent marching of the first paper's section 6.3, as a few fat XLA kernels.

Flow: cells -> [points] -> image.

Slabs are marched front to back. In each, the bundles that are not empty are ordered by their number of particles and taken
`chunk` at a time, so that a chunk's trip count is nearly its mean; then blocks of `BLOCK` particles are added to all samples
of a cell at once. Shapes, once: accumulators are (chunk, samples of a cell, 8 rows, 8 columns).

The perspective grid makes the squared distance separable. A sample sits at $(a_k u_c, a_k v_r, s_k)$ with $a = s$ (perspective)
or 1 (orthographic), so with
$A_{kc} = ((a_k u_c - X) / H)^2$ and $B_{kr} = 1 - ((s_k - Z) / H)^2 - ((a_k v_r - Y) / H)^2$
the margin of the kernel is $t = B_{kr} - A_{kc}$: one subtraction a sample. Differences to the particle are taken before they
are squared, so nothing cancels.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.access.cells import Cells
from jaxsph.access.lists import BUNDLE, BundleLists
from jaxsph.access.ordering import Ordered
from jaxsph.model import kernels
from jaxsph.model.camera import Camera
from jaxsph.model.transfer import TransferFunction

BLOCK = 16  # particles unrolled in the inner loop: with 8 or 12 XLA fuses A and B into every term and is 8 times slower


@dataclasses.dataclass(frozen=True)
class CastPlan:
    """Static sizes of the march: bundles marched together, and samples of a cell."""

    chunk: int
    cell_samples: int


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
    num_bundles = cells.count.shape[1]
    dtype = ordered.x.dtype
    order, num_chunks = _schedule(cells.count, plan.chunk)
    slabs = cells.count.shape[0]
    padding = slabs * plan.cell_samples - depths.shape[0]
    depths = jnp.pad(depths, (0, padding), mode="edge")
    edges = jnp.pad(edges, (0, padding), mode="edge")  # samples past the end have length zero
    state = (
        jnp.zeros((3, num_bundles + 1, BUNDLE, BUNDLE), dtype),
        jnp.ones((num_bundles + 1, BUNDLE, BUNDLE), dtype),
        jnp.full((num_bundles + 1, BUNDLE, BUNDLE), jnp.inf, dtype),
    )
    row, column = (jnp.append(origin, 0) for origin in origins)
    begin, length = (jnp.pad(window, ((0, 0), (0, 0), (0, 1))) for window in (cells.begin, cells.length))

    def march_slab(slab: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        s = lax.dynamic_slice_in_dim(depths, slab * plan.cell_samples, plan.cell_samples)
        border = lax.dynamic_slice_in_dim(edges, slab * plan.cell_samples, plan.cell_samples + 1)

        def march_chunk(chunk: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
            color, transmittance, depth = state
            bundle = lax.dynamic_slice(order, (slab, chunk * plan.chunk), (1, plan.chunk))[0]
            pixel = jnp.arange(BUNDLE, dtype=jnp.int32)
            u = camera.column((column[bundle][:, None] + pixel).astype(dtype) + 0.5)
            v = camera.row((row[bundle][:, None] + pixel).astype(dtype) + 0.5)
            window = begin[:, slab, bundle], length[:, slab, bundle]
            weight, weighted = _gather_field(ordered, lists.rank, window, (u, v, s), camera.is_perspective, kernel)
            rays = color[:, bundle], transmittance[bundle], depth[bundle]
            rays = _composite(rays, weight, weighted, (u, v, border), camera.is_perspective, transfer)
            return (
                color.at[:, bundle].set(rays[0]),
                transmittance.at[bundle].set(rays[1]),
                depth.at[bundle].set(rays[2]),
            )

        return lax.fori_loop(0, num_chunks[slab], march_chunk, state)

    color, transmittance, depth = lax.fori_loop(0, slabs, march_slab, state)
    in_slab = jnp.minimum(plan.cell_samples, depths.shape[0] - padding - jnp.arange(slabs) * plan.cell_samples)
    evaluations = (cells.count.astype(jnp.float32) * in_slab[:, None].astype(jnp.float32)).sum(0)
    return Rays(color[:, :-1], transmittance[:-1], depth[:-1], evaluations)


def _schedule(count: Int[Array, "slabs bundles"], chunk: int) -> tuple[Array, Array]:
    """Bundle ids of each slab, fullest first, padded to whole chunks with a dummy id, and the number of chunks to march."""
    slabs, bundles = count.shape
    bits = (bundles + 1).bit_length()
    key = (jnp.minimum(count, (1 << (32 - bits)) - 1).astype(jnp.uint32) << bits) | jnp.arange(bundles, dtype=jnp.uint32)
    key = ~lax.sort(~key, dimension=1)
    order = (key & jnp.uint32((1 << bits) - 1)).astype(jnp.int32)
    active = (count > 0).sum(1)
    order = jnp.where(jnp.arange(bundles) < active[:, None], order, bundles)
    order = jnp.pad(order, ((0, 0), (0, -bundles % chunk)), constant_values=bundles)
    return order, (active + chunk - 1) // chunk


def _gather_field(
    ordered: Ordered,
    rank: Int[Array, " pairs"],
    window: tuple[Int[Array, "classes chunk"], Int[Array, "classes chunk"]],
    rays: tuple[Array, Array, Array],
    perspective: bool,
    kernel: str,
) -> tuple[Array, Array]:
    """Sums of V W and q V W (up to one common factor) at every sample of the chunk's cells."""
    u, v, s = rays
    begin, length = window
    total = length.sum(0)
    spread = s if perspective else jnp.ones_like(s)
    su, sv = u[:, None, :] * spread[:, None], v[:, None, :] * spread[:, None]
    columns = (ordered.x, ordered.y, ordered.z, ordered.scale, ordered.weight, ordered.quantity)
    smooth = kernels.by_name(kernel)

    def add_block(block: Array, sums: tuple[Array, Array]) -> tuple[Array, Array]:
        weight, weighted = sums
        index = block * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)
        inside = index < total[:, None]
        particle = rank[jnp.clip(_position(index, begin, length), 0, rank.shape[0] - 1)]
        x, y, z, scale, strength, quantity = lax.optimization_barrier([column[particle] for column in columns])
        strength = jnp.where(inside, strength, 0)
        folded = smooth.homogeneous is not None
        scale, top = (jnp.where(inside, scale, 0), strength) if folded else (scale, jnp.ones_like(strength))
        x, y, z, scale, top = (value[:, :, None, None] for value in (x, y, z, scale, top))
        across = ((su[:, None] - x) * scale) ** 2
        along = top - ((s[:, None] - z) * scale) ** 2 - ((sv[:, None] - y) * scale) ** 2
        across, along, strength, quantity = lax.optimization_barrier((across, along, strength, quantity))
        for k in range(BLOCK):
            w = smooth.shape(along[:, k, :, :, None] - across[:, k, :, None, :], jnp)
            if not folded:
                w = w * strength[:, k, None, None, None]
            weight = weight + w
            weighted = weighted + w * quantity[:, k, None, None, None]
        return weight, weighted

    zero = jnp.zeros((*su.shape[:2], BUNDLE, BUNDLE), su.dtype)
    blocks = (total.max() + BLOCK - 1) // BLOCK
    return lax.fori_loop(0, blocks, add_block, (zero, zero))


def _position(index: Array, begin: Array, length: Array) -> Array:
    """Where the `index`-th particle of a cell stands in the lists: the cell's windows, one class after the other."""
    position = begin[0][:, None] + index
    before = length[0]
    for k in range(1, begin.shape[0]):
        position = jnp.where(index >= before[:, None], (begin[k] - before)[:, None] + index, position)
        before = before + length[k]
    return position


def _composite(
    rays: tuple[Array, Array, Array],
    weight: Array,
    weighted: Array,
    geometry: tuple[Array, Array, Array],
    perspective: bool,
    transfer: TransferFunction,
) -> tuple[Array, Array, Array]:
    """Front to back over the samples of the cells: first paper, equations 2 and 3, with `T_i = exp(-extinction * length)`."""
    color, transmittance, depth = rays
    u, v, border = geometry
    per_depth = jnp.sqrt(1 + u[:, None, :] ** 2 + v[:, :, None] ** 2) if perspective else jnp.ones_like(u[:, None] * v[:, :, None])
    inside = weight > 0
    quantity = jnp.where(inside, weighted / jnp.where(inside, weight, 1), 0)
    red, green, blue, extinction = transfer.interpolate(quantity)
    step = border[1:] - border[:-1]
    thickness = jnp.where(inside, extinction * (step[:, None, None] * per_depth[:, None]), 0)
    for k in range(weight.shape[1]):
        behind = transmittance * jnp.exp(-thickness[:, k])
        gained = transmittance * -jnp.expm1(-thickness[:, k])
        color = color + jnp.stack([gained * channel[:, k] for channel in (red, green, blue)])
        crossed = (transmittance > 0.5) & (behind <= 0.5)
        part = jnp.log(2 * jnp.where(crossed, transmittance, 1)) / jnp.where(crossed, thickness[:, k], 1)
        depth = jnp.where(crossed, border[k] + part * step[k], depth)
        transmittance = behind
    return color, transmittance, depth


jax.tree_util.register_dataclass(
    Rays, data_fields=["color", "transmittance", "depth", "evaluations"], meta_fields=[]
)
