r"""Sums over particles at all samples of slabs, as a few fat XLA kernels.

Flow: schedule -> [gather] -> media.

Marching is thread-coherent as in Hochstetter et al. 2016, section 6.3: blocks of `BLOCK` particles are added to all samples of a
slab at once. Shapes, once: accumulators are (tasks, samples of a slab, rows, columns).

The perspective grid makes the squared distance separable. A sample sits at $(a_k u_c, a_k v_r, s_k)$ with $a = s$
(perspective) or 1 (orthographic), so the squared distance in supports is $A_{kc} + D_{kr}$ with $A_{kc} = ((a_k u_c - X) / H)^2$
and $D_{kr} = ((s_k - Z) / H)^2 + ((a_k v_r - Y) / H)^2$: one addition a sample, or for poly6 one subtraction from the margin
$1 - D_{kr}$. Differences to the particle are taken before they are squared, so nothing cancels.

Rays that are no tensor product (`gather_scattered`) have the same order of operations, so that a ray is the same bit for bit in
whichever packet it is cast: what rays of a row or a column would share is computed where it is added, but rounded as if it were
stored, as a compiler may contract a square and what it is added to into one operation.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxsph.engine.access.view import Ordered
from jaxsph.engine.field.sums import Sums, sums_of, with_block
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.particles import kernels
from jaxsph.numerics.extremes import lesser
from jaxsph.numerics.fusion import fusion_barrier

BLOCK = 16  # particles unrolled in the inner loop
PARTS = {False: (), True: (8,)}  # of the slabs of a task, that have loops of their own where they are crowded


def gather(ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str) -> Sums:
    """Sums (tasks, samples, rows, columns) at every sample of slabs, from all particles of their windows."""
    zero = jnp.zeros((*task.depth.shape, task.v.shape[1], task.u.shape[1]), task.depth.dtype)
    sums = sums_of([zero] * (1 + len(ordered.quantities)))
    for turns in task.turns(BLOCK, PARTS[task.crowded]):
        add = functools.partial(_add, ordered, rank, turns.task, kernel)
        sums = turns.put(lax.fori_loop(turns.begin, turns.end, add, turns.of(sums)), sums)
    return sums


def _add(ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str, nth: Array, sums: Sums) -> Sums:
    """With a block of particles more."""
    s, smooth = task.depth, kernels.by_name(kernel)
    lateral_scale = s if task.perspective else jnp.ones_like(s)
    su, sv = task.u[:, None, :] * lateral_scale[:, :, None], task.v[:, None, :] * lateral_scale[:, :, None]

    def separate(nth: Array) -> tuple[Array, Array, Array, tuple[Array, ...]]:
        """The two parts of the squared distance, sizes and quantities of a block of particles; size 0 past the last."""
        _, block = task.fetched(ordered, rank, BLOCK, nth)
        x, y, z, scale = (value[:, :, None, None] for value in (block.x, block.y, block.z, block.scale))
        across = ((su[:, None] - x) * scale) ** 2
        along = ((s[:, None, :, None] - z) * scale) ** 2 + ((sv[:, None] - y) * scale) ** 2
        return across, smooth.prepare(along, block.size[:, :, None, None]), block.size, block.quantities

    across, along, size, quantities = fusion_barrier(nth >= 0, separate, nth)

    def weighed(k: int) -> tuple[Array, list[Array]]:
        w = smooth.weigh(along[:, k, :, :, None], across[:, k, :, None, :], size[:, k, None, None, None], jnp)
        return w, [quantity[:, k, None, None, None] for quantity in quantities]

    return with_block(sums, [weighed(k) for k in range(BLOCK)])


def gather_scattered(ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str) -> Sums:
    """Sums (tasks, samples, 1, rays) at every sample of slabs, from all particles of their windows."""
    sums = sums_of([jnp.zeros(task.shape, task.depth.dtype)] * (1 + len(ordered.quantities)))
    for turns in task.turns(BLOCK, PARTS[task.crowded]):
        add = functools.partial(_add_scattered, ordered, rank, turns.task, kernel)
        sums = turns.put(lax.fori_loop(turns.begin, turns.end, add, turns.of(sums)), sums)
    return jax.tree.map(lambda value: value[:, :, None], sums)


def _add_scattered(ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str, nth: Array, sums: Sums) -> Sums:
    """With a block of particles more."""
    s, smooth = task.depth[..., None], kernels.by_name(kernel)
    lateral_scale = s if task.perspective else jnp.ones_like(s)
    su, sv = task.u[:, None] * lateral_scale, task.v[:, None] * lateral_scale
    largest = jnp.finfo(s.dtype).max
    block = fusion_barrier(nth >= 0, lambda: task.fetched(ordered, rank, BLOCK, nth)[1])

    def weighed(k: int) -> tuple[Array, tuple[Array, ...]]:
        one = jax.tree.map(lambda column: column[:, k, None, None], block)
        across = lesser(((su - one.x) * one.scale) ** 2, largest)  # what is between the two keeps them apart
        along = ((s - one.z) * one.scale) ** 2 + ((sv - one.y) * one.scale) ** 2
        return smooth.weigh(smooth.prepare(along, one.size), across, one.size, jnp), one.quantities

    return with_block(sums, (weighed(k) for k in range(BLOCK)))
