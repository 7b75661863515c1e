r"""Ray casting of particles: thread-coherent marching of the first paper's section 6.3, as a few fat XLA kernels.

Flow: cells -> [points] -> image.

Layers of cells are marched front to back. In each, the bundles that are not empty are ordered by their number of particles and
taken `chunk` at a time, so that a chunk's trip counts are nearly their mean; a cell is marched slab by slab, and in a slab
blocks of `BLOCK` particles are added to all samples at once. Shapes, once: accumulators are (chunk, samples of a slab, 8 rows,
8 columns).

The perspective grid makes the squared distance separable. A sample sits at $(a_k u_c, a_k v_r, s_k)$ with $a = s$ (perspective)
or 1 (orthographic), so with
$A_{kc} = ((a_k u_c - X) / H)^2$ and $B_{kr} = 1 - ((s_k - Z) / H)^2 - ((a_k v_r - Y) / H)^2$
the margin of the kernel is $t = B_{kr} - A_{kc}$: one subtraction a sample. Differences to the particle are taken before they
are squared, so nothing cancels.
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

BLOCK = 16  # particles unrolled in the inner loop: with 8 or 12 XLA fuses A and B into every term and is 8 times slower


@dataclasses.dataclass(frozen=True)
class CastPlan:
    """Static sizes of the march.

    Attributes:
        chunk: bundles marched together.
        slab_samples: samples whose windows are evaluated together.
        slabs_per_cell: slabs of a cell, between which the rays' state stays at hand.
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
    num_bundles = cells.count.shape[1]
    dtype = ordered.x.dtype
    order, num_chunks = _schedule(cells.count, plan)
    slabs = cells.count.shape[0]
    padding = slabs * plan.slab_samples - depths.shape[0]
    depths = jnp.pad(depths, (0, padding), mode="edge")
    edges = jnp.pad(edges, (0, padding), mode="edge")  # samples past the end have length zero
    state = (
        *(jnp.zeros((num_bundles + 1, BUNDLE, BUNDLE), dtype) for _ in range(3)),
        jnp.ones((num_bundles + 1, BUNDLE, BUNDLE), dtype),
        jnp.full((num_bundles + 1, BUNDLE, BUNDLE), jnp.inf, dtype),
    )
    segments = transfer.segments()
    row, column = (jnp.append(origin, 0) for origin in origins)
    begin, length = (jnp.pad(window, ((0, 0), (0, 0), (0, 1))) for window in (cells.begin, cells.length))

    def march_cells(layer: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
        def march_chunk(chunk: Array, state: tuple[Array, ...]) -> tuple[Array, ...]:
            bundle = lax.dynamic_slice(order, (layer, chunk * plan.chunk), (1, plan.chunk))[0]
            pixel = jnp.arange(BUNDLE, dtype=jnp.int32)
            u = camera.column((column[bundle][:, None] + pixel).astype(dtype) + 0.5)
            v = camera.row((row[bundle][:, None] + pixel).astype(dtype) + 0.5)

            def march_slab(slab: Array, rays: list[Array]) -> list[Array]:
                s = lax.dynamic_slice_in_dim(depths, slab * plan.slab_samples, plan.slab_samples)
                border = lax.dynamic_slice_in_dim(edges, slab * plan.slab_samples, plan.slab_samples + 1)
                window = begin[:, slab, bundle], length[:, slab, bundle]
                return lax.cond(window[1].any(), march_filled, lambda rays, *_: rays, rays, s, border, window)

            def march_filled(rays: list[Array], s: Array, border: Array, window: tuple[Array, Array]) -> list[Array]:
                sums = _gather_field(ordered, lists.rank, window, (u, v, s), camera.is_perspective, kernel)
                shade = functools.partial(_shade, perspective=camera.is_perspective)
                shaded = computed_once(border[0] < jnp.inf, shade, *sums, (u, v, border), segments)
                return _composite(rays, shaded, border)

            first = layer * plan.slabs_per_cell
            last = jnp.minimum(first + plan.slabs_per_cell, slabs)
            rays = lax.fori_loop(first, last, march_slab, [field[bundle] for field in state])
            return tuple(field.at[bundle].set(new) for field, new in zip(state, rays, strict=True))

        return lax.fori_loop(0, num_chunks[layer], march_chunk, state)

    *color, transmittance, depth = (field[:-1] for field in lax.fori_loop(0, order.shape[0], march_cells, state))
    in_slab = jnp.minimum(plan.slab_samples, depths.shape[0] - padding - jnp.arange(slabs) * plan.slab_samples)
    evaluations = (cells.count.astype(jnp.float32) * in_slab[:, None].astype(jnp.float32)).sum(0)
    return Rays(jnp.stack(color), transmittance, depth, evaluations)


def _schedule(count: Int[Array, "slabs bundles"], plan: CastPlan) -> tuple[Array, Array]:
    """Bundle ids of each layer of cells, fullest first, padded to whole chunks with a dummy id, and the chunks to march."""
    slabs, bundles = count.shape
    count = jnp.pad(count, ((0, -slabs % plan.slabs_per_cell), (0, 0)))
    count = count.reshape(-1, plan.slabs_per_cell, bundles).sum(1)
    bits = (bundles + 1).bit_length()
    key = (jnp.minimum(count, (1 << (32 - bits)) - 1).astype(jnp.uint32) << bits) | jnp.arange(bundles, dtype=jnp.uint32)
    key = ~lax.sort(~key, dimension=1)
    order = (key & jnp.uint32((1 << bits) - 1)).astype(jnp.int32)
    active = (count > 0).sum(1)
    order = jnp.where(jnp.arange(bundles) < active[:, None], order, bundles)
    order = jnp.pad(order, ((0, 0), (0, -bundles % plan.chunk)), constant_values=bundles)
    return order, (active + plan.chunk - 1) // plan.chunk


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
    su, sv = u[:, None, :] * spread[:, None], v[:, None, :] * spread[:, None]
    columns = (ordered.x, ordered.y, ordered.z, ordered.scale, ordered.weight, ordered.quantity)
    smooth = kernels.by_name(kernel)

    def add_block(block: Array, sums: Array) -> Array:
        weight, weighted = sums.real, sums.imag
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
        return lax.complex(weight, weighted)

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
    step = (border[1:] - border[:-1])[:, None, None]
    thickness = jnp.where(inside, extinction * (step * per_depth[:, None]), 0)
    return [*channels, thickness, jnp.exp(-thickness)]


def _composite(rays: list[Array], shaded: list[Array], border: Array) -> list[Array]:
    """Front to back over the samples of a slab: first paper, equation 3.

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
        length = jnp.where(crossed, border[k + 1] - border[k], length)
        front = jnp.where(crossed, border[k], front)
        transmittance = behind
    depth = jnp.minimum(depth, front + jnp.log(2 * before) / crossing * length)
    return [*color, transmittance, depth]


jax.tree_util.register_dataclass(Rays, data_fields=["color", "transmittance", "depth", "evaluations"], meta_fields=[])
