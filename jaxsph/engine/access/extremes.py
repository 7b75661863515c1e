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
from jaxtyping import Array, Float

from jaxsph.engine.access.grid import SlabWindows
from jaxsph.engine.access.lists import BundleLists
from jaxsph.numerics.compiled import apart_of, fusion_barrier, together_of

BLOCK = 8
RUNS = 8  # lengths of runs of blocks
LONGEST = BLOCK << (RUNS - 1)  # particles of a window
PIECE = 1 << 16  # entries: their table stays in the second-level cache
BUNDLES = 64  # whose windows are looked up together


def window_extremes(
    quantity: Float[Array, " particles"], lists: BundleLists, windows: SlabWindows
) -> tuple[Float[Array, "slabs bundles"], Float[Array, "slabs bundles"]]:
    """At most the least and at least the greatest quantity over the windows of each slab; of empty ones, inf and -inf."""
    (_, slabs, bundles), dtype, step = windows.begin.shape, quantity.dtype, PIECE - LONGEST
    order = jnp.argsort(lists.start).astype(jnp.int32)  # as lists follow each other
    number = lists.end.max(initial=0)
    rank, start, end = jnp.pad(lists.rank, (0, PIECE)), lists.start[order], lax.cummax(lists.end[order])
    group = min(BUNDLES, bundles)
    begin, length = windows.begin[..., order], windows.length[..., order]

    def of_piece(nth: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        first = nth * step
        table = _runs(quantity, lax.dynamic_slice(rank, (first,), (PIECE,)), number - first)
        some = jnp.searchsorted(end, first, side="right"), jnp.searchsorted(start, first + step)

        def of_bundles(turn: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
            which = jnp.minimum(some[0] + turn * group, bundles - group)
            here, long = (lax.dynamic_slice_in_dim(value, which, group, 2) for value in (begin, length))
            here = here - first
            mine = (here >= 0) & (here < step) & (long > 0)
            known = mine & (long <= LONGEST - BLOCK)
            ends = fusion_barrier(nth >= 0, _of_windows, table, jnp.where(known, here, 0), jnp.where(known, long, 1))
            least = jnp.where(mine, jnp.where(known, ends[0], -jnp.inf), jnp.inf).min(0)
            greatest = jnp.where(mine, jnp.where(known, ends[1], jnp.inf), -jnp.inf).max(0)
            old = [lax.dynamic_slice_in_dim(side, which, group, 1) for side in found]
            new = jnp.minimum(old[0], least), jnp.maximum(old[1], greatest)
            return tuple(lax.dynamic_update_slice_in_dim(side, own, which, 1) for side, own in zip(found, new, strict=True))  # type: ignore[return-value]

        return lax.fori_loop(0, (some[1] - some[0] + group - 1) // group, of_bundles, found)

    nothing = jnp.full((slabs, bundles), jnp.inf, dtype)
    found = lax.fori_loop(0, (number + step - 1) // step, of_piece, (nothing, -nothing))
    place = jnp.zeros(bundles, jnp.int32).at[order].set(jnp.arange(bundles, dtype=jnp.int32))
    return tuple(side[:, place] for side in found)  # type: ignore[return-value]


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
