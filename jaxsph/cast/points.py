r"""Ray casting of particles: thread-coherent marching of the first paper's section 6.3, as a few fat XLA kernels.

Flow: worklist -> [points] -> image.

What a slab of samples does to light does not depend on what lies in front of it. So a stretch of slabs (`stretches`) is marched
in any order; what they emit and absorb is held, and then put into the rays' state layer by layer (`composite`). Blocks of
`BLOCK` particles are added to all samples of a slab at once. Shapes, once: accumulators are (chunk, samples of a slab, 8 rows,
8 columns).

The perspective grid makes the squared distance separable. A sample sits at $(a_k u_c, a_k v_r, s_k)$ with $a = s$
(perspective) or 1 (orthographic), so the squared distance in supports is $A_{kc} + D_{kr}$ with $A_{kc} = ((a_k u_c - X) / H)^2$
and $D_{kr} = ((s_k - Z) / H)^2 + ((a_k v_r - Y) / H)^2$: one addition a sample, or for poly6 one subtraction from the margin
$1 - D_{kr}$. Differences to the particle are taken before they are squared, so nothing cancels.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Complex, Float, Int

from jaxsph.access.cells import position
from jaxsph.access.grid import Grid
from jaxsph.access.lattice import Lattice
from jaxsph.access.lists import BUNDLE
from jaxsph.access.ordering import Ordered
from jaxsph.cast.composite import Light, State, composite, fresh, unlit
from jaxsph.cast.nodes import interpolate
from jaxsph.cast.shading import shade
from jaxsph.cast.sparse import gather_sparse
from jaxsph.cast.stretches import BLOCK, CastPlan, kind_of, stretches_of
from jaxsph.control.spacing import WIDEST
from jaxsph.control.worklist import SPARSE, Worklist
from jaxsph.model import kernels
from jaxsph.model.camera import Camera
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics.staging import computed_once


@dataclasses.dataclass(frozen=True)
class Rays:
    """What all rays of a band have met: premultiplied colour, transmittance, depth of half transmittance, kernel evaluations."""

    color: Float[Array, "3 bundles 8 8"]
    transmittance: Float[Array, "bundles 8 8"]
    depth: Float[Array, "bundles 8 8"]
    evaluations: Float[Array, " bundles"]


def cast_points(
    grid: Grid,
    work: Worklist,
    camera: Camera,
    transfer: TransferFunction,
    kernel: str,
    plan: CastPlan,
    lattice: Lattice | None = None,
) -> Rays:
    """March all bundles of a band.

    Args:
        work: the slabs of samples to march.
        kernel: name of the smoothing kernel.
        lattice: where the sums of interpolated slabs come from.
    """
    stretches, segments = stretches_of(grid, work, plan), transfer.segments()
    perspective = camera.is_perspective

    def march(at: Array) -> Light:
        """What the slabs `at` emit, as seen from right in front of each, and their samples' optical thickness."""
        item, slab, bundle = stretches.item(at)
        u, v = (rays.T for rays in grid.rays(camera, bundle))
        s, border = stretches.depths(item, slab)
        marched = functools.partial(gather_field, grid.ordered, grid.lists.rank, item, (u, v, s), perspective, kernel)
        if lattice is None:
            sums = marched()
        else:
            sparse = functools.partial(gather_sparse, grid, item, (u, v, s), perspective, kernel)
            sums = _with_lattice(lattice, grid, item, (slab, bundle), [marched, sparse], plan)
        return shade(sums, (u, v, border), segments, item, perspective)

    def march_stretch(nth: Array, state: tuple[State, Light]) -> tuple[State, Light]:
        rays, light = state
        stretch = stretches.stretch(nth)

        def march_chunk(chunk: Array, light: Light) -> Light:
            at, begin = stretches.chunk(stretch, chunk)
            found = march(at)
            return tuple(lax.dynamic_update_slice_in_dim(old, new, begin, 0) for old, new in zip(light, found, strict=True))

        light = lax.fori_loop(0, stretch.chunks, march_chunk, light)

        def border(at: Array) -> Array:
            item, slab, _ = stretches.item(stretch.items[at])
            return stretches.depths(item, slab)[1]

        return composite(rays, light, stretch.held_at, border, stretches.stacks.start, stretch.first, stretch.number), light

    dtype = grid.half_steps.dtype
    state = fresh(work.count.shape[1], dtype), unlit(stretches.places + 1, plan.slab_samples, dtype)
    state = lax.fori_loop(0, stretches.number, march_stretch, state)
    *color, transmittance, depth = (field[stretches.stacks.place].reshape(-1, BUNDLE, BUNDLE) for field in state[0])
    spent = evaluations(work, grid.samples, plan)
    spent = spent if lattice is None else spent + lattice.evaluations
    return Rays(jnp.stack(color), transmittance, depth, spent)


def evaluations(work: Worklist, samples: int, plan: CastPlan) -> Float[Array, " bundles"]:
    """Kernel evaluations that `work` takes for each ray of a bundle."""
    beyond = (jnp.arange(work.count.shape[0]) + 1) * plan.slab_samples - samples
    in_slab = plan.slab_samples - jnp.maximum(beyond, 0)[:, None] * (work.level == 0)
    rays = 1 if work.sparse is None else jnp.where(work.sparse, len(SPARSE) ** 2 / BUNDLE**2, 1)
    return (work.count.astype(jnp.float32) * rays * in_slab.astype(jnp.float32)).sum(0)


def _with_lattice(
    lattice: Lattice, grid: Grid, item: Worklist, at: tuple[Array, Array], marched: list[Callable[[], Array]], plan: CastPlan
) -> Array:
    """Sums of items, which are all of one kind: `marched` at all rays or at some, or from the lattice at their level."""
    slab, bundle = at
    row, column, _ = (side[bundle] * lattice.region.spacing.across for side in lattice.region.place(grid))
    found = functools.partial(interpolate, lattice, slab, (row, column), plan.slab_samples)

    def at_level(level: int) -> Array:
        return found(level).reshape(-1, plan.slab_samples, BUNDLE, BUNDLE)

    # a dummy reads some nodes and drops them
    kind = jnp.where(slab < grid.cells.count.shape[0], kind_of(item), 0).max()
    return lax.switch(kind, [*marched, *(functools.partial(at_level, level) for level in range(WIDEST + 1))])


def gather_field(
    ordered: Ordered,
    rank: Int[Array, " pairs"],
    item: Worklist,
    rays: tuple[Array, Array, Array],
    perspective: bool,
    kernel: str,
) -> Complex[Array, "chunk samples 8 8"]:
    """Sums of V W and (q - origin) V W (up to one common factor) at every sample of the chunk's items.

    The two travel as one complex number: of a pair XLA makes two kernels, and each evaluates every weight again.
    """
    u, v, s = rays
    begin, length = item.begin, item.length
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
        place = position(index, begin[..., None], length[..., None])
        particle = rank[jnp.clip(place, 0, rank.shape[0] - 1)]
        x, y, z, scale, size, quantity = (column[particle] for column in columns)
        scale, size = jnp.where(inside, scale, 0), jnp.where(inside, size, 0)
        x, y, z, scale = (value[:, :, None, None] for value in (x, y, z, scale))
        across = ((su[:, None] - x) * scale) ** 2
        along = ((s[:, None, :, None] - z) * scale) ** 2 + ((sv[:, None] - y) * scale) ** 2
        return across, smooth.prepare(along, size[:, :, None, None]), size, quantity - item.origin[:, None]

    zero = jnp.zeros((*su.shape[:2], BUNDLE, BUNDLE), su.dtype)
    blocks = (total.max() + BLOCK - 1) // BLOCK
    return lax.fori_loop(0, blocks, add_block, lax.complex(zero, zero))


jax.tree_util.register_dataclass(Rays, data_fields=["color", "transmittance", "depth", "evaluations"], meta_fields=[])
