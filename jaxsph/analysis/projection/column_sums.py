r"""Sums of columns over the particles of each bundle of pixels, a block of particles at a time.

Flow: pixel_lists, lists -> [column_sums] -> project; cotangents -> [column_sums: by jax.vjp, block by block].

Of a ray it is $\sum_j a_j F_j$, where F_j is the integral of a kernel of unit integral along the ray between two depths, and a_j
what the particle holds. Bundles come in order of how many particles their lists hold, such that those that are summed together
have about as many. Shapes, once: (bundles of a chunk, particles of a block, places down, places across).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, Float, Int

from jaxsph.analysis.projection.columns import column_between, pixel_shares, whole_column
from jaxsph.engine.access.lists import BUNDLE, BundleLists
from jaxsph.numerics.checks import as_usual
from jaxsph.numerics.fusion import fusion_barrier
from jaxsph.numerics.transposed import linear_map

BLOCK = 8  # particles whose columns are held at once
PLACE = 4  # columns of the table that say where a particle is; what it holds comes behind
TWICE = "second derivatives of a projection are not implemented; take differences of `jax.grad`"


@dataclasses.dataclass(frozen=True)
class ColumnMethod:
    """How columns are found, static.

    Attributes:
        kernel: name of the smoothing kernel.
        perspective: whether rays spread with depth.
        shares: whether pixels get exact shares of whole columns; else rays are followed.
        subrays: rays of a pixel on each axis.
        chunk: bundles that are summed together.
    """

    kernel: str
    perspective: bool
    shares: bool
    subrays: int
    chunk: int

    @property
    def places(self) -> int:
        """Places of a bundle down and across."""
        return BUNDLE if self.shares else BUNDLE * self.subrays

    def columns(
        self, rows: Float[Array, "bundles particles columns"], across: Array, down: Array, ends: Array
    ) -> Float[Array, "bundles particles down across"]:
        """Of particles that hold 1, at all places of bundles."""
        if self.shares:
            x, y, wide, high = (rows[:, :, k, None] for k in range(PLACE))
            return pixel_shares(self.kernel, (across[:, None] - x) * wide, (y - down[:, None]) * high)
        along = _along_perspective if self.perspective else _along_parallel
        square, start, end = along(rows, across, down, ends)
        z, inverse = rows[:, :, 2], rows[:, :, 3]
        cut = (inverse > 0) & (((z - ends[0]) * inverse < 1) | ((ends[1] - z) * inverse < 1))
        part, whole = functools.partial(column_between, self.kernel), functools.partial(whole_column, self.kernel)
        return lax.cond(cut.any(), part, lambda square, start, end: whole(square), square, start, end)  # type: ignore[no-any-return]


class ColumnInputs(NamedTuple):
    """What columns are differentiated by.

    Attributes:
        table: of particles. For rays: x, y, z, reciprocal support; for shares: ray coordinates of the centre, and the reciprocals
            of the support in them. Then what they hold.
        across, down: ray coordinates of columns and rows, or of the edges of pixels.
        ends: near and far depth.
    """

    table: Float[Array, "particles columns"]
    across: Float[Array, "bundles places"]
    down: Float[Array, "bundles places"]
    ends: Float[Array, "2"]


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def column_sums(method: ColumnMethod, inputs: ColumnInputs, lists: BundleLists) -> Float[Array, "bundles channels down across"]:
    """Sums over the lists of all bundles, for each of the amounts that particles hold.

    Differentiation:
        By all of `inputs`, in both modes; memory does not grow with the number of pairs. Which pairs there are is held fixed.
    """
    return _sum(method, inputs, lists)


@as_usual()
def _differentiate(method: ColumnMethod, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    """Sums and their tangent, which is a linear map of the tangents with a transpose of its own."""
    inputs, lists = primals
    leaves, structure = jax.tree.flatten(inputs)
    result = column_sums(method, inputs, lists)
    moves = list(tangents[0])
    moving = [i for i, move in enumerate(moves) if not isinstance(move, SymbolicZero)]
    if not moving:
        return result, jnp.zeros_like(result)

    def push(moves: list[Array]) -> Array:
        def sums(parts: list[Array]) -> Array:
            there = [parts[moving.index(i)] if i in moving else leaf for i, leaf in enumerate(leaves)]
            return _sum(method, jax.tree.unflatten(structure, there), lists)

        return jax.jvp(sums, ([leaves[i] for i in moving],), (moves,))[1]

    def pull(cotangent: Array) -> list[Array]:
        cotangents = _pull(method, inputs, lists, cotangent)
        return [cotangents[i] for i in moving]

    return result, linear_map(push, pull, [moves[i] for i in moving], result, leaves, TWICE)


column_sums.defjvp(_differentiate, symbolic_zeros=True)


def pixels_of(sums: Float[Array, "bundles channels down across"], subrays: int) -> Float[Array, "bundles 8 8 channels"]:
    """Means over the rays of each pixel, by Gauss-Legendre quadrature on either axis."""
    weights = jnp.asarray(subrays_of(subrays)[1], sums.dtype)
    parts = sums.reshape(*sums.shape[:2], BUNDLE, subrays, BUNDLE, subrays)
    return jnp.einsum("bkisjt,s,t->bijk", parts, weights, weights, precision="highest")


def subrays_of(subrays: int) -> tuple[Any, Any]:
    """Where rays go through pixels on one axis, in [0, 1], and the shares of a pixel that they stand for."""
    nodes, weights = np.polynomial.legendre.leggauss(subrays)
    return (nodes + 1) / 2, weights / 2


class _Some(NamedTuple):
    """A block of particles of each bundle of a chunk; holding nothing where there are no more."""

    rows: Float[Array, "bundles particles columns"]
    particle: Int[Array, "bundles particles"]
    inside: Bool[Array, "bundles particles"]


class _Chunk(NamedTuple):
    """Bundles that are summed together, past the last none; where their lists begin, and how long they are."""

    bundle: Int[Array, " some"]
    begin: Int[Array, " some"]
    length: Int[Array, " some"]
    across: Float[Array, "some places"]
    down: Float[Array, "some places"]

    @property
    def blocks(self) -> Int[Array, ""]:
        """Blocks of the longest list."""
        return (self.length.max() + BLOCK - 1) // BLOCK

    def fetch(self, table: Array, rank: Array, nth: Array) -> _Some:
        """The nth block of all lists."""
        index = nth * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)
        inside = index < self.length[:, None]
        particle = rank[jnp.clip(self.begin[:, None] + index, 0, rank.shape[0] - 1)]
        particle = jnp.where(inside, particle, 0)
        return _Some(jnp.where(inside[:, :, None], table[particle], 0), particle, inside)


def _sum(method: ColumnMethod, inputs: ColumnInputs, lists: BundleLists) -> Array:
    channels, places = inputs.table.shape[1] - PLACE, method.places

    def one(chunk: _Chunk) -> Array:
        def add(nth: Array, total: Array) -> Array:
            some = chunk.fetch(inputs.table, lists.rank, nth)
            return total + _of_block(method, chunk, some.rows, chunk.across, chunk.down, inputs.ends)

        nothing = jnp.zeros((method.chunk, channels, places, places), inputs.table.dtype)
        return lax.fori_loop(0, chunk.blocks, add, nothing)

    chunks, bundles = _chunks(method, inputs, lists), lists.start.shape[0]
    found = lax.map(one, chunks).reshape(-1, channels, places, places)
    placed = jnp.zeros((bundles + 1, *found.shape[1:]), found.dtype)
    return placed.at[chunks.bundle.ravel()].set(found)[:bundles]


def _pull(method: ColumnMethod, inputs: ColumnInputs, lists: BundleLists, cotangent: Array) -> ColumnInputs:
    """Cotangents of the inputs, for those of the sums: all blocks are met again."""
    padded = jnp.pad(cotangent, ((0, 1), (0, 0), (0, 0), (0, 0)))

    def one(carry: tuple[Array, Array], chunk: _Chunk) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        def add(nth: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
            table, ends, across, down = carry
            some = chunk.fetch(inputs.table, lists.rank, nth)
            of_block: Callable[..., Array] = functools.partial(_of_block, method, chunk)
            found = jax.vjp(of_block, some.rows, chunk.across, chunk.down, inputs.ends)[1](padded[chunk.bundle])
            rows = jnp.where(some.inside[:, :, None], found[0], 0).reshape(-1, table.shape[1])
            table = table.at[some.particle.ravel()].add(rows, mode="promise_in_bounds")
            return table, ends + found[3], across + found[1], down + found[2]

        start = (*carry, jnp.zeros_like(chunk.across), jnp.zeros_like(chunk.down))
        table, ends, across, down = lax.fori_loop(0, chunk.blocks, add, start)
        return (table, ends), (across, down)

    chunks = _chunks(method, inputs, lists)
    carry = jnp.zeros_like(inputs.table), jnp.zeros_like(inputs.ends)
    (table, ends), rays = lax.scan(one, carry, chunks)
    bundle = chunks.bundle.ravel()
    across, down = (
        jnp.zeros((like.shape[0] + 1, like.shape[1]), like.dtype).at[bundle].set(value.reshape(-1, like.shape[1]))[:-1]
        for like, value in zip((inputs.across, inputs.down), rays, strict=True)
    )
    return ColumnInputs(table, across, down, ends)


def _of_block(method: ColumnMethod, chunk: _Chunk, rows: Array, across: Array, down: Array, ends: Array) -> Array:
    """What a block of particles adds to the places of bundles, for each of the amounts."""
    found = fusion_barrier(chunk.blocks >= 0, method.columns, rows, across, down, ends)
    amounts = jnp.moveaxis(rows[:, :, PLACE:], 2, 1)
    return (amounts[..., None, None] * found[:, None]).sum(2)


def _chunks(method: ColumnMethod, inputs: ColumnInputs, lists: BundleLists) -> _Chunk:
    """All bundles, longest lists first, as chunks one above the other."""
    bundles, length = lists.start.shape[0], lists.end - lists.start
    room = -(-bundles // method.chunk) * method.chunk
    order = jnp.pad(jnp.argsort(-length).astype(jnp.int32), (0, room - bundles), constant_values=bundles)
    real, safe = order < bundles, jnp.minimum(order, bundles - 1)
    columns = order, lists.start[safe], jnp.where(real, length[safe], 0), inputs.across[safe], inputs.down[safe]
    return _Chunk(*(column.reshape(-1, method.chunk, *column.shape[1:]) for column in columns))


def _along_parallel(rows: Array, across: Array, down: Array, ends: Array) -> tuple[Array, Array, Array]:
    """Squared distances of rays from centres, and where their depths begin and end from the feet, in supports."""
    x, y, z, inverse = (rows[:, :, k, None, None] for k in range(PLACE))
    u, v = across[:, None, None, :], down[:, None, :, None]
    square = ((u - x) * inverse) ** 2 + ((v - y) * inverse) ** 2
    return square, (ends[0] - z) * inverse, (ends[1] - z) * inverse


def _along_perspective(rows: Array, across: Array, down: Array, ends: Array) -> tuple[Array, Array, Array]:
    """The same for rays from the eye; from the depth of the centre on, as what is small is no difference of what is large."""
    x, y, z, inverse = (rows[:, :, k, None, None] for k in range(PLACE))
    u, v = across[:, None, None, :], down[:, None, :, None]
    slant = 1 + u * u + v * v
    x, y = x - u * z, y - v * z
    further = (x * u + y * v) / slant
    away = (u * further - x) * inverse, (v * further - y) * inverse, further * inverse
    scale, foot = jnp.sqrt(slant) * inverse, z + further
    return away[0] ** 2 + away[1] ** 2 + away[2] ** 2, (ends[0] - foot) * scale, (ends[1] - foot) * scale
