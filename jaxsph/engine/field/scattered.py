"""Sums over particles at the samples of rays that are no tensor product: each has a column and a row of its own.

Flow: schedule -> [scattered] -> media.

As `gather`, in the same order of operations, so that a ray is the same bit for bit in whichever packet it is cast. Nothing of the
squared distance is shared by rays of a row or a column, so it is computed where it is added, instead of being stored: but rounded
as if it were, as a compiler may contract a square and what it is added to into one operation.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Int

from jaxsph.engine.access.ordering import Ordered
from jaxsph.engine.field.fetch import Block, fetch, quantities_of
from jaxsph.engine.field.gather import BLOCK, PARTS
from jaxsph.engine.field.sums import Sums, sums_of, with_block
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.particles import kernels
from jaxsph.numerics.extremes import lesser
from jaxsph.numerics.fusion import fusion_barrier


def gather_scattered(ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str) -> Sums:
    """Sums (tasks, samples, 1, rays) at every sample of slabs, from all particles of their windows."""
    sums = sums_of([jnp.zeros(task.shape, task.depth.dtype)] * (1 + len(quantities_of(ordered))))
    for turns in task.turns(BLOCK, PARTS[task.crowded]):
        add = functools.partial(_add, ordered, rank, turns.task, kernel)
        sums = turns.put(lax.fori_loop(turns.begin, turns.end, add, turns.of(sums)), sums)
    return jax.tree.map(lambda value: value[:, :, None], sums)


def _add(ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, kernel: str, nth: Array, sums: Sums) -> Sums:
    """With a block of particles more."""
    entry, s = task.entry, task.depth[..., None]
    lateral_scale = s if task.perspective else jnp.ones_like(s)
    su, sv = task.u[:, None] * lateral_scale, task.v[:, None] * lateral_scale
    windows, references = (entry.begin[..., None], entry.length[..., None]), tuple(one[:, None] for one in entry.references)
    smooth, largest = kernels.by_name(kernel), jnp.finfo(s.dtype).max

    def fetched(index: Array) -> Block:
        return fetch(ordered, rank, windows, index, references)[1]

    block = fusion_barrier(nth >= 0, fetched, nth * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32))

    def weighed(k: int) -> tuple[Array, tuple[Array, ...]]:
        one = jax.tree.map(lambda column: column[:, k, None, None], block)
        across = lesser(((su - one.x) * one.scale) ** 2, largest)  # what is between the two keeps them apart
        along = ((s - one.z) * one.scale) ** 2 + ((sv - one.y) * one.scale) ** 2
        return smooth.weigh(smooth.prepare(along, one.size), across, one.size, jnp), one.quantities

    return with_block(sums, (weighed(k) for k in range(BLOCK)))
