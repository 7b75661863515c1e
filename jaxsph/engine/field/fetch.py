"""Fetch particles: those in the windows of slabs, a block at a time.

Flow: schedule -> [fetch] -> gather, nodes, transposed.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.view import Ordered
from jaxsph.numerics.trees import tree


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
