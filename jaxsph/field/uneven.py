"""Slabs of uneven fullness, marched together without waiting for the fullest.

Flow: task -> [uneven] -> gather, scattered, points.

The slabs of a task come in order of how many spheres their windows hold. Where those are clustered the first of them may hold a
thousand times as many as the last, and a loop over blocks of all would mostly add nothing. So all slabs are looped over until
only a quarter of them have anything left, then that quarter alone, and so on. Where slabs are out of order it takes longer.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxsph.field.tasks import SlabTask

Sums = TypeVar("Sums")
PARTS = 4, 16  # of the slabs of a task, the first quarter and the first sixteenth have loops of their own
FEWEST = 16  # slabs that are worth a loop: each is compiled


class Turns(NamedTuple):
    """Blocks of spheres from `begin` up to `end` of the first `number` slabs of a task, which are `task`."""

    number: int
    task: SlabTask
    begin: Int[Array, ""]
    end: Int[Array, ""]

    def of(self, sums: Sums) -> Sums:
        """Those of these slabs."""
        return jax.tree.map(lambda value: value[: self.number], sums)  # type: ignore[no-any-return]

    def put(self, some: Sums, sums: Sums) -> Sums:
        """All sums, with some of these slabs."""
        return jax.tree.map(lambda new, old: jnp.concatenate([new, old[self.number :]]), some, sums)  # type: ignore[no-any-return]


def turns_of(task: SlabTask, block: int) -> Iterator[Turns]:
    """All blocks of `block` spheres of all slabs, in order for each slab."""
    blocks = (task.entry.length.sum(0, dtype=jnp.int32) + block - 1) // block
    tasks = blocks.shape[0]
    numbers = [tasks, *(tasks // part for part in PARTS if tasks // part >= FEWEST), 0]
    begin = jnp.int32(0)
    for number, fewer in itertools.pairwise(numbers):
        end = jnp.maximum(blocks[fewer:number].max(), begin)
        yield Turns(number, task.first(number), begin, end)
        begin = end
