"""Sums over the particles of many windows, a block of particles at a time; their transpose is the same loop.

Flow: lists -> [blocks] -> sums; cotangents of sums -> [blocks: by jax.vjp, block by block] -> those of particles.

What a block adds is told by a `body`, in plain JAX. Backward, all blocks are met again: `jax.vjp` of the body gives rows of
cotangents that are added to a table of all particles, so memory does not grow with the number of pairs. Windows come in chunks
that are summed together, those of about as many particles, as a chunk takes as many turns as its longest window. They come last
in all shapes, such that they are summed side by side: with 16 lanes that takes half of the time that rows of 8 pixels take.
"""

from __future__ import annotations

import functools
from collections.abc import Hashable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Float, Int

from jaxsph.engine.field.fetch import known_at
from jaxsph.numerics.checks import as_usual
from jaxsph.numerics.fusion import apart_of, fusion_barrier, together_of
from jaxsph.numerics.transposed import linear_map

TWICE = "second derivatives of a projection are not implemented; take differences of `jax.grad`"


class Body(Protocol, Hashable):  # type: ignore[misc]
    """What a block of particles adds to windows.

    Attributes:
        block: particles that are met at once; and `block_back`, backward, where more is held of each.
    """

    block: int
    block_back: int

    def prepare(self, rows: Float[Array, "particles windows columns"], each: Any, shared: Any) -> Any:
        """What is found once a particle and window, to be read at each place."""

    def sums(self, part: Any) -> list[Array]:
        """One or two sums (..., windows) over particles of what was prepared; of rows of zeros nothing."""


class Given(NamedTuple):
    """What sums are differentiated by.

    Attributes:
        table: of particles.
        each: a pytree of what there is for each window, (chunks, ..., windows).
        shared: a pytree of what all have in common.
    """

    table: Float[Array, "particles columns"]
    each: Any
    shared: Any


class Windows(NamedTuple):
    """Particles `rank[begin : begin + length]` for each window."""

    rank: Int[Array, " pairs"]
    begin: Int[Array, "chunks windows"]
    length: Int[Array, "chunks windows"]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def over_blocks(body: Body, given: Given, windows: Windows) -> list[Float[Array, "chunks ... windows"]]:
    """Sums over all windows.

    Differentiation:
        By all that is `given`, in both modes. Which particles there are is held fixed.
    """
    return _sum(body, given, windows)


@as_usual()
def _differentiate(body: Body, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[list[Array], list[Array]]:
    """Sums and their tangents, which are a linear map of the tangents with a transpose of its own."""
    given, windows = primals
    leaves, structure = jax.tree.flatten(given)
    result = over_blocks(body, given, windows)
    moves = jax.tree.leaves(tangents[0], is_leaf=lambda move: isinstance(move, SymbolicZero))
    moving = [i for i, move in enumerate(moves) if not isinstance(move, SymbolicZero)]
    if not moving:
        return result, jax.tree.map(jnp.zeros_like, result)

    def push(moves: list[Array]) -> list[Array]:
        def sums(parts: list[Array]) -> list[Array]:
            there = [parts[moving.index(i)] if i in moving else leaf for i, leaf in enumerate(leaves)]
            return _sum(body, jax.tree.unflatten(structure, there), windows)

        return jax.jvp(sums, ([leaves[i] for i in moving],), (moves,))[1]

    def pull(cotangents: list[Array]) -> list[Array]:
        found = jax.tree.leaves(_pull(body, given, windows, cotangents))
        return [found[i] for i in moving]

    return result, linear_map(push, pull, [moves[i] for i in moving], result, leaves, TWICE)


over_blocks.defjvp(_differentiate, symbolic_zeros=True)


def _sum(body: Body, given: Given, windows: Windows) -> list[Array]:
    table = _with_nothing(given.table)

    def one(chunk: tuple[Array, Array, Any]) -> list[Array]:
        begin, length, each = chunk

        def fetch(nth: Array) -> Array:
            return known_at(table, _particles(given.table, windows.rank, begin, length, nth, body.block))

        def found(nth: Array) -> list[Array]:
            rows = fusion_barrier(nth >= 0, fetch, nth)
            return body.sums(fusion_barrier(nth >= 0, body.prepare, rows, each, given.shared))

        zero = [jnp.zeros(shape.shape, shape.dtype) for shape in jax.eval_shape(found, jnp.int32(0))]
        if len(zero) == 1:
            return lax.fori_loop(0, _turns(length, body.block), lambda nth, total: [total[0] + found(nth)[0]], zero)

        def add(nth: Array, total: Any) -> Any:
            return jax.tree.map(jnp.add, total, together_of(*found(nth)))

        return list(apart_of(lax.fori_loop(0, _turns(length, body.block), add, together_of(*zero))))

    return lax.map(one, (windows.begin, windows.length, given.each))


def _pull(body: Body, given: Given, windows: Windows, cotangents: list[Array]) -> Given:
    """Cotangents of what is given, for those of the sums: all blocks are met again."""
    table = _with_nothing(given.table)

    def back(rows: Array, each: Any, shared: Any) -> list[Array]:
        return body.sums(body.prepare(rows, each, shared))

    def one(carry: tuple[Array, Any], chunk: tuple[Array, Array, Any, list[Array]]) -> tuple[tuple[Array, Any], Any]:
        begin, length, each, of_sums = chunk

        def add(nth: Array, so_far: tuple[Array, Any, Any]) -> tuple[Array, Any, Any]:
            total, of_each, of_shared = so_far
            particle = _particles(given.table, windows.rank, begin, length, nth, body.block_back)
            found, *more = jax.vjp(back, known_at(table, particle), each, given.shared)[1](of_sums)
            total = total.at[particle.ravel()].add(found.reshape(-1, total.shape[1]), mode="promise_in_bounds")
            return total, *jax.tree.map(jnp.add, (of_each, of_shared), tuple(more))

        start = carry[0], jax.tree.map(jnp.zeros_like, each), carry[1]
        total, of_each, of_shared = lax.fori_loop(0, _turns(length, body.block_back), add, start)
        return (total, of_shared), of_each

    start = jax.tree.map(jnp.zeros_like, (table, given.shared))
    (total, shared), each = lax.scan(one, start, (windows.begin, windows.length, given.each, cotangents))
    return Given(total[:-1], each, shared)


def _turns(length: Int[Array, " windows"], block: int) -> Int[Array, ""]:
    """Blocks of the longest window."""
    return (length.max() + block - 1) // block


def _with_nothing(table: Array) -> Array:
    """Behind all particles one that holds nothing."""
    return jnp.pad(table, ((0, 1), (0, 0)))


def _particles(table: Array, rank: Array, begin: Array, length: Array, nth: Array, block: int) -> Array:
    """The nth block of all windows, (particles, windows); past their ends the one that holds nothing."""
    index = nth * block + jnp.arange(block, dtype=jnp.int32)[:, None]
    inside = index < length
    return jnp.where(inside, known_at(rank, jnp.where(inside, begin + index, 0)), table.shape[0])
