"""A linear map that brings its own transpose, for a custom rule that serves forward and reverse mode and `vmap`.

JAX takes such a pair as the solution of a linear system, the one public primitive that has a transpose given by hand and can be
batched: with $L = [[1, 0], [-A, 1]]$ the solution of $L x = (t, 0)$ is $(t, A t)$, and that of $L^T x = (0, c)$ is $(A^T c, c)$.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

Given = TypeVar("Given")
Result = TypeVar("Result")


def tangent_of(
    function: Callable[[Given], Result],
    pull: Callable[[Result], Given],
    given: Given,
    tangents: Given,
    result: Result,
    twice: str,
) -> Result:
    """The tangent of `result`, which is `function(given)`: by `jax.jvp`, and its transpose is `pull`.

    Args:
        tangents: of what is given; `SymbolicZero` of what is held fixed.
        twice: see `linear_map`.
    """
    leaves, structure = jax.tree.flatten(given)
    moves = jax.tree.leaves(tangents)
    moving = [i for i, move in enumerate(moves) if not isinstance(move, SymbolicZero)]
    if not moving:
        return jax.tree.map(jnp.zeros_like, result)  # type: ignore[no-any-return]

    def push(moves: list[Array]) -> Result:
        def of(parts: list[Array]) -> Result:
            there = [parts[moving.index(i)] if i in moving else leaf for i, leaf in enumerate(leaves)]
            return function(jax.tree.unflatten(structure, there))

        return jax.jvp(of, ([leaves[i] for i in moving],), (moves,))[1]

    def pulled(cotangents: Result) -> list[Array]:
        found = jax.tree.leaves(pull(cotangents))
        return [found[i] for i in moving]

    return linear_map(push, pulled, [moves[i] for i in moving], result, leaves, twice)


def linear_map(
    push: Callable[[list[Array]], Result],
    pull: Callable[[Result], list[Array]],
    moves: list[Array],
    like: Result,
    depends: list[Array],
    twice: str,
) -> Result:
    """`push(moves)`, whose transpose is `pull`.

    Args:
        push: linear in its argument.
        pull: its transpose, from cotangents of the result to those of `moves`.
        moves: at least one array, none of them empty.
        like: a pytree of arrays shaped as the result.
        depends: what else the map depends on.
        twice: what is said where it is differentiated by `depends`, as neither rule depends on them for JAX.

    Raises:
        NotImplementedError: where the map itself is differentiated.
    """
    dtype = jax.tree.leaves(like)[0].dtype

    def tied(moves: list[Array], depends: list[Array]) -> Result:
        """Zeros like the result that depend on `moves`, linearly, and on `depends`."""
        zero = 0 * functools.reduce(jnp.add, [leaf.ravel()[0].astype(dtype) for leaf in moves])
        zero = functools.reduce(lambda value, leaf: value * leaf.ravel()[0].astype(dtype), depends, zero)
        return jax.tree.map(lambda leaf: jnp.broadcast_to(zero, leaf.shape), like)

    def matrix(pair: tuple[list[Array], Result]) -> tuple[list[Array], Result]:
        return pair[0], jax.tree.map(jnp.subtract, pair[1], tied(pair[0], [_once(leaf, twice) for leaf in depends]))

    def solve(_: object, right: tuple[list[Array], Result]) -> tuple[list[Array], Result]:
        return right[0], jax.tree.map(jnp.add, right[1], push(right[0]))

    def solve_transposed(_: object, right: tuple[list[Array], Result]) -> tuple[list[Array], Result]:
        return [value + pulled for value, pulled in zip(right[0], pull(right[1]), strict=True)], right[1]

    found: Result = lax.custom_linear_solve(matrix, (moves, tied(moves, [])), solve, solve_transposed)[1]
    return found


@functools.partial(jax.custom_jvp, nondiff_argnums=(1,))
def _once(value: Array, twice: str) -> Array:
    return value


@_once.defjvp
def _twice(twice: str, primals: object, tangents: object) -> tuple[Array, Array]:
    raise NotImplementedError(twice)
