"""Fetch particles: those in the windows of slabs, a block at a time; and the transpose of sums over blocks of them.

Flow: schedule -> [fetch] -> gather, nodes, transposed; cotangents of sums -> [fetch: by jax.vjp, block by block] -> of particles.

What a block adds is told by a `body`, in plain JAX. Backward, all blocks are met again: `jax.vjp` of the body gives rows of
cotangents that are added to a table of all particles (`pull_blocks`), so memory does not grow with the number of pairs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.view import Ordered
from jaxsph.numerics.trees import tree

Shared = TypeVar("Shared")


@tree()
class Block:
    """Some particles of each of some slabs; of size 0 past the last of a slab's windows.

    Attributes:
        x, y, z: view coordinates, length units.
        scale, size: reciprocal support and strength as folded into lengths, see `model.kernels`.
        quantities: relative to the references that were given.
    """

    x: Float[Array, "..."]
    y: Float[Array, "..."]
    z: Float[Array, "..."]
    scale: Float[Array, "..."]
    size: Float[Array, "..."]
    quantities: tuple[Float[Array, "..."], ...]


def known_at(rows: Array, index: Int[Array, "..."]) -> Array:
    """`rows[index]` where that is known to be one of them: a gather is not compiled for what else it might be."""
    return rows.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def position(index: Int[Array, "*some any"], begin: Int[Array, "classes *any"], length: Int[Array, "classes *any"]) -> Array:
    """Where the `index`-th particle of each slab stands in the lists: the slab's windows, one class after the other."""
    place, before = begin[0] + index, length[0]
    for k in range(1, begin.shape[0]):
        place = jnp.where(index >= before, (begin[k] - before) + index, place)
        before = before + length[k]
    return place


def particle_at(
    rank: Int[Array, " pairs"], begin: Int[Array, "classes ..."], length: Int[Array, "classes ..."], index: Int[Array, "..."]
) -> tuple[Int[Array, "..."], Bool[Array, "..."]]:
    """The `index`-th particle of windows, and whether there are so many; if not, it is any."""
    place = position(index, begin, length)
    return known_at(rank, jnp.clip(place, 0, rank.shape[0] - 1)), index < length.sum(0)


def fetch(
    ordered: Ordered,
    rank: Int[Array, " pairs"],
    windows: tuple[Array, Array],
    index: Int[Array, "..."],
    references: tuple[Float[Array, "..."], ...],
) -> tuple[Int[Array, "..."], Block]:
    """The `index`-th particles of windows (`begin`, `length`), by rank and as such; shapes are those that broadcasting gives."""
    particle, inside = particle_at(rank, *windows, index)
    x, y, z, scale, size, *quantities = (
        known_at(column, particle)
        for column in (ordered.x, ordered.y, ordered.z, ordered.scale, ordered.size, *ordered.quantities)
    )
    relative = tuple(quantity - reference for quantity, reference in zip(quantities, references, strict=True))
    return particle, Block(x, y, z, jnp.where(inside, scale, 0), jnp.where(inside, size, 0), relative)


def with_rows_at(
    table: Float[Array, "particles columns"], index: Int[Array, "..."], of: Any
) -> Float[Array, "particles columns"]:
    """A table of cotangents with more of some particles: rows, or a tuple of columns, of which the table may have more."""
    width = table.shape[1]
    if isinstance(of, tuple):
        of = jnp.stack([*of, *[jnp.zeros_like(of[0])] * (width - len(of))], -1)
    return table.at[index.ravel()].add(of.reshape(-1, width), mode="promise_in_bounds")


def pull_blocks(
    body: Callable[[Any, Shared, Any], Any],
    fetch: Callable[[Array], tuple[Int[Array, "..."], Any, Any]],
    turns: tuple[Any, Int[Array, ""]],
    table: Float[Array, "particles columns"],
    shared: Shared,
    cotangents: Any,
) -> tuple[Float[Array, "particles columns"], Shared]:
    """The transpose of a sum of `body(columns, shared, held)` over all blocks of particles.

    Args:
        body: in plain JAX.
        fetch: of a turn, which particles are met; what they have, rows or a tuple of columns; and what is held fixed of them.
        turns: the first of them, and the one past the last.
        table: of cotangents so far.
        shared: what all blocks are summed by.
        cotangents: of the sum.

    Returns:
        The table with what follows, and cotangents of `shared`.
    """

    def add(nth: Array, so_far: tuple[Array, Shared]) -> tuple[Array, Shared]:
        index, columns, held = fetch(nth)
        of_columns, more = jax.vjp(lambda columns, shared: body(columns, shared, held), columns, shared)[1](cotangents)
        return with_rows_at(so_far[0], index, of_columns), jax.tree.map(jnp.add, so_far[1], more)

    found: tuple[Array, Shared] = lax.fori_loop(*turns, add, (table, jax.tree.map(jnp.zeros_like, shared)))
    return found
