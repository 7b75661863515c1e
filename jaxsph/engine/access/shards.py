"""Shards of a band: bundles dealt out like cards, so that each shard has about as much to do wherever the fluid is.

Flow: grid -> [shards] -> control, cast.

On CPUs XLA splits every kernel among its threads, but those of a chunk of slabs are over before that pays: two threads were 1.1
to 1.3 times as fast as one, two programs side by side 1.9 times. So the bundles are dealt out, and each shard is a run of the
same program. What a bundle's rays meet does not depend on what it is marched with, so the image is the same bit for bit.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxsph.engine.access.grid import Grid


def shard(tree: Any, nth: Int[Array, ""] | int, shards: int) -> Any:
    """Of arrays whose last axis is bundles, every `shards`-th from the `nth` on."""
    if shards == 1:
        return tree
    return jax.tree.map(lambda value: value.reshape(*value.shape[:-1], -1, shards)[..., nth], tree)


def unshard(shards: tuple[Any, ...], axis: int = -1) -> Any:
    """All bundles again, of those that were dealt out along an axis."""
    if len(shards) == 1:
        return shards[0]

    def mixed(*values: Array) -> Array:
        place, shape = axis % values[0].ndim, values[0].shape
        return jnp.stack(values, place + 1).reshape(*shape[:place], -1, *shape[place + 1 :])

    return jax.tree.map(mixed, *shards)


def shard_of_grid(grid: Grid, nth: Int[Array, ""] | int, shards: int) -> Grid:
    """The grid of every `shards`-th bundle from the `nth` on."""
    windows, row, column, start, end = shard((grid.windows, grid.row, grid.column, grid.lists.start, grid.lists.end), nth, shards)
    lists = dataclasses.replace(grid.lists, start=start, end=end)
    return dataclasses.replace(grid, lists=lists, windows=windows, row=row, column=column)
