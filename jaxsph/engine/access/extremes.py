"""Extremes of a quantity over the windows of slabs, without a loop over their particles.

Flow: lists, slab windows -> [extremes] -> control.

The lists of all bundles are one array, which is taken a piece at a time; pieces overlap by `LONGEST` entries, so that any
window no longer than that lies in one. A piece is cut into blocks of `BLOCK` entries. Of these, the extremes of all runs of 1,
2, 4, ... are found (a sparse table); two such runs that overlap hold any window. A window is rounded outwards to whole blocks,
whose entries may be of other slabs or of other bundles: what is found encloses the window's own extremes. Of longer windows
nothing is known.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.compaction import running_sum
from jaxsph.engine.access.grid import SlabWindows
from jaxsph.engine.access.lists import BundleLists
from jaxsph.numerics.compiled import apart_of, fusion_barrier, greater, lesser, together_of

BLOCK = 8
RUNS = 8  # lengths of runs of blocks
LONGEST = BLOCK << (RUNS - 1)  # particles of a window
PIECE = 1 << 16  # entries: their table stays in the second-level cache
WINDOWS = 1 << 10  # slabs that are looked up together


def window_extremes(
    quantity: Float[Array, " particles"], lists: BundleLists, windows: SlabWindows
) -> tuple[Float[Array, "slabs bundles"], Float[Array, "slabs bundles"]]:
    """At most the least and at least the greatest quantity over the windows of each slab; of empty ones, inf and -inf."""
    (classes, slabs, bundles), dtype, step = windows.begin.shape, quantity.dtype, PIECE - LONGEST
    number, nowhere = lists.end.max(initial=0), slabs * bundles
    order = jnp.argsort(lists.start).astype(jnp.int32)  # as lists follow each other
    item, first_item = _items(windows.count > 0, order)
    start, end, item = lists.start[order], lax.cummax(lists.end[order]), jnp.pad(item, (0, WINDOWS), constant_values=nowhere)
    begin, length = (value.reshape(classes, nowhere) for value in (windows.begin, windows.length))
    used = jnp.where((length > 0).any(1), jnp.arange(1, classes + 1, dtype=jnp.int32), 0).max()
    rank = jnp.pad(lists.rank, (0, max(PIECE - lists.rank.shape[0], 0)))  # what is no list is never read: it may be most of it
    last = rank.shape[0] - PIECE

    def of_piece(nth: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        first = jnp.minimum(nth * step, last)  # the last piece ends where the room does, and has all windows up to there
        until = first + jnp.where(first < last, step, PIECE)
        table = _runs(quantity, lax.dynamic_slice(rank, (first,), (PIECE,)), number - first)
        some = first_item[jnp.searchsorted(end, first, side="right")], first_item[jnp.searchsorted(start, until)]

        def of_windows(turn: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
            place = some[0] + turn * WINDOWS
            at = lax.dynamic_slice(item, (place,), (WINDOWS,))
            at = jnp.where(place + jnp.arange(WINDOWS, dtype=jnp.int32) < some[1], at, nowhere)

            def of_class(kind: Array, ends: Any) -> Any:
                here, long = (value.at[kind, at].get(mode="fill", fill_value=0) for value in (begin, length))
                mine = (here >= first) & (here < until) & (long > 0)
                known = mine & (long <= LONGEST - BLOCK)
                own = fusion_barrier(nth >= 0, _of_windows, table, jnp.where(known, here - first, 0), jnp.where(known, long, 1))
                least = jnp.where(mine, jnp.where(known, own[0], -jnp.inf), jnp.inf)
                greatest = jnp.where(mine, jnp.where(known, own[1], jnp.inf), -jnp.inf)
                return lesser(least, ends[0]), greater(greatest, ends[1])

            ends = lax.fori_loop(0, used, of_class, tuple(side[at] for side in found))
            return tuple(side.at[at].set(own, mode="promise_in_bounds") for side, own in zip(found, ends, strict=True))  # type: ignore[return-value]

        return lax.fori_loop(0, (some[1] - some[0] + WINDOWS - 1) // WINDOWS, of_windows, found)

    nothing = jnp.full(nowhere + 1, jnp.inf, dtype)
    found = lax.fori_loop(0, (number + step - 1) // step, of_piece, (nothing, -nothing))
    return tuple(side[:-1].reshape(slabs, bundles) for side in found)  # type: ignore[return-value]


def _items(
    filled: Bool[Array, "slabs bundles"], order: Int[Array, " bundles"]
) -> tuple[Int[Array, " items"], Int[Array, " bundles_and_one"]]:
    """Filled slabs, `slab * bundles + bundle`, of one bundle after the other; and where those of each begin, in that order."""
    slabs, bundles = filled.shape
    nth = running_sum(filled.astype(jnp.int32), 0)
    first = jnp.pad(running_sum(nth[-1, order]), (1, 0))
    of_bundle = jnp.zeros(bundles, jnp.int32).at[order].set(first[:-1])
    target = jnp.where(filled, of_bundle + nth - 1, slabs * bundles)
    item = jnp.full(slabs * bundles + 1, slabs * bundles, jnp.int32)
    return item.at[target.ravel()].set(jnp.arange(slabs * bundles, dtype=jnp.int32), mode="promise_in_bounds"), first


def _runs(quantity: Array, rank: Array, number: Array) -> Any:
    """Least and greatest of runs of blocks, those of `2**k` blocks in row k, by their first block, see `together_of`."""
    value = fusion_barrier(number > 0, lambda: quantity.at[rank].get(mode="clip"))
    real = jnp.arange(PIECE, dtype=jnp.int32) < number

    def of_blocks() -> Any:
        each = [(real[k::BLOCK], value[k::BLOCK]) for k in range(BLOCK)]
        least = functools.reduce(jnp.minimum, [jnp.where(inside, own, jnp.inf) for inside, own in each])
        return together_of(least, functools.reduce(jnp.maximum, [jnp.where(inside, own, -jnp.inf) for inside, own in each]))

    def doubled(row: Any, step: int) -> Any:
        (least, greatest), (ahead, other) = (apart_of(row), apart_of(jax.tree.map(lambda one: one[step:], row)))
        size = ahead.shape[0]
        return together_of(jnp.minimum(least[:size], ahead), jnp.maximum(greatest[:size], other))

    rows = [fusion_barrier(number > 0, of_blocks)]
    for run in range(RUNS - 1):
        rows.append(fusion_barrier(number > 0, functools.partial(doubled, step=1 << run), rows[-1]))
    size = PIECE // BLOCK
    return jax.tree.map(lambda *of: jnp.concatenate([jnp.pad(row, (0, size - row.shape[0])) for row in of]), *rows)


def _of_windows(table: Any, begin: Array, length: Array) -> tuple[Array, Array]:
    first, last = begin // BLOCK, (begin + length - 1) // BLOCK
    run = 31 - lax.clz(last - first + 1)
    row = run * (PIECE // BLOCK)
    ends = []
    for at in (row + first, row + last + 1 - (1 << run)):
        ends.append(apart_of(jax.tree.map(lambda one, at=at: one.at[at].get(mode="promise_in_bounds"), table)))
    (least, greatest), (other_least, other_greatest) = ends
    return jnp.minimum(least, other_least), jnp.maximum(greatest, other_greatest)
