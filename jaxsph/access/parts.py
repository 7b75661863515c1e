"""Parts of a band: bundles dealt out like cards, so that each part has about as much to do wherever the fluid is.

Flow: grid -> [parts] -> control, cast.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxsph.access.grid import Grid


def dealt(tree: Any, nth: Int[Array, ""] | int, parts: int) -> Any:
    """Of arrays whose last axis is bundles, every `parts`-th from the `nth` on."""
    if parts == 1:
        return tree
    return jax.tree.map(lambda value: value.reshape(*value.shape[:-1], -1, parts)[..., nth], tree)


def gathered(parts: tuple[Any, ...]) -> Any:
    """All bundles again, of those that were dealt."""
    if len(parts) == 1:
        return parts[0]
    return jax.tree.map(lambda *values: jnp.stack(values, -1).reshape(*values[0].shape[:-1], -1), *parts)


def part_of(grid: Grid, nth: Int[Array, ""] | int, parts: int) -> Grid:
    """The grid of every `parts`-th bundle from the `nth` on."""
    cells, row, column, start, end = dealt((grid.cells, grid.row, grid.column, grid.lists.start, grid.lists.end), nth, parts)
    lists = dataclasses.replace(grid.lists, start=start, end=end)
    return dataclasses.replace(grid, lists=lists, cells=cells, row=row, column=column)
