"""Sums over particles or points: fetched from the windows of slabs a block at a time, added up; and transposed.

Flow: schedule -> [sums] -> gather, nodes -> media; cotangents of sums -> [sums: by jax.vjp, block by block] -> of particles.

Sums are of weights, and of one or more quantities times weights. On CPUs XLA makes a kernel of every array that a loop carries,
and each evaluates every weight again. So two sums travel as one complex number there, and are taken apart where they are read;
elsewhere each is an array of its own (`runtime.tuning`). Three are what a reduction of three operands gives, which is one kernel
as well: with it, a block of particles with two quantities takes 1.1 to 1.25 times as long as with one, as three sums that a loop
carries it took 1.5 times.

What a block adds is told by a `body`, in plain JAX. Backward, all blocks are met again: `jax.vjp` of the body gives rows of
cotangents that are added to a table of all particles (`pull_blocks`), so memory does not grow with the number of pairs.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import custom_jvp, lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.view import Ordered
from jaxsph.numerics.compiled import barriers_kept
from jaxsph.numerics.trees import tree

REDUCED = 2  # quantities whose sums, of weights among them, are reduced rather than carried
Shared = TypeVar("Shared")


@tree(static=("num_quantities",))
class Sums:
    """Sums up to one common factor.

    Attributes:
        packed: one or two sums an array, in the order of `all`.
        num_quantities: how many there are besides that of weights.
    """

    packed: tuple[Array, ...]
    num_quantities: int

    @property
    def all(self) -> tuple[Float[Array, "..."], ...]:
        """Of V W, then of (q - reference) V W for each quantity q."""
        parts = [part for pair in self.packed for part in ((pair.real, pair.imag) if jnp.iscomplexobj(pair) else (pair,))]
        return tuple(parts[: 1 + self.num_quantities])


def sums_of(channels: list[Float[Array, "..."]]) -> Sums:
    """Those sums, that of weights first."""
    number = len(channels) - 1
    if not barriers_kept() or number in (0, REDUCED):
        return Sums(tuple(channels), number)
    seconds = [*channels[1::2], jnp.zeros_like(channels[0])]
    return Sums(tuple(lax.complex(*pair) for pair in zip(channels[::2], seconds, strict=False)), number)


def with_block(sums: Sums, block: Iterable[tuple[Array, Iterable[Array]]]) -> Sums:
    """Sums with a block of particles more: the weight of each, and what it is multiplied by for each quantity."""
    if not barriers_kept() or sums.num_quantities != REDUCED:
        channels = list(sums.all)
        for weight, factors in block:
            channels = [channels[0] + weight, *(old + weight * q for old, q in zip(channels[1:], factors, strict=True))]
        return sums_of(channels)
    added = in_halves([[weight, *(weight * q for q in factors)] for weight, factors in block])
    return sums_of([old + new for old, new in zip(sums.all, added, strict=True)])


@custom_jvp
def in_halves(parts: list[list[Array]]) -> tuple[Array, ...]:
    """Element-wise sums of lists, in one loop: within the halves of `parts` written out, over the halves by a reduction."""
    halves = [
        [functools.reduce(jnp.add, terms) for terms in zip(*half, strict=True)] for half in (parts[::2], parts[1::2]) if half
    ]
    operands = tuple(jnp.stack(pair) for pair in zip(*halves, strict=True))
    start = tuple(jnp.zeros((), value.dtype) for value in operands)
    return tuple(lax.reduce(operands, start, lambda a, b: tuple(p + q for p, q in zip(a, b, strict=True)), (0,)))


# JAX's own rule takes the reduction apart: its sums are rounded otherwise, and may lie on the other side of a kink
in_halves.defjvp(lambda parts, moves: (in_halves(*parts), in_halves(*moves)))


def by_rays(sums: Sums) -> list[Float[Array, "tasks samples rays"]]:
    """The sum of weights and those of quantities, rays in a row: short rows do not vectorise."""
    rows = tuple(value.reshape(*value.shape[:2], -1) for value in sums.packed)
    return list(dataclasses.replace(sums, packed=rows).all)


@tree()
class Block:
    """Some particles of each of some slabs; of size 0 past the last of a slab's windows.

    Attributes:
        x, y, z: view coordinates, length units.
        scale, size: reciprocal support and strength as folded into lengths, see `Kernel`.
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
    ordered: Ordered, particle: Int[Array, "..."], inside: Bool[Array, "..."], references: tuple[Float[Array, "..."], ...]
) -> Block:
    """Particles by rank, see `particle_at`; those that are not `inside` weigh nothing."""
    x, y, z, scale, size, *quantities = (
        known_at(column, particle)
        for column in (ordered.x, ordered.y, ordered.z, ordered.scale, ordered.size, *ordered.quantities)
    )
    relative = tuple(quantity - reference for quantity, reference in zip(quantities, references, strict=True))
    return Block(x, y, z, jnp.where(inside, scale, 0), jnp.where(inside, size, 0), relative)


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

    return lax.fori_loop(*turns, add, (table, jax.tree.map(jnp.zeros_like, shared)))  # type: ignore[no-any-return]
