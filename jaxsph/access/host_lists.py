"""The lists of bundles, for a frame that is run on CPUs stage by stage: searched by NumPy, tested by XLA.

Flow: ordering -> [host_lists] -> slab_windows.

The same lists as those of `lists.build_lists`, which serves traces and accelerators. Particles stand in the order of their
ranks, so to pick those of a row of tiles, of these those of a tile, and of these those of a bundle, keeps them in order: nothing
is sorted at all. XLA tests pairs in batches, while NumPy picks the next.

Lists lie in the order of the rows of tiles, in a row by corner of the tile: their starts do not ascend.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxsph.access.host_sorting import entries_at
from jaxsph.access.lists import BundleLists, ListPlan, Ranges, Sphere, bundle_ranges, children_mask, touched_bundles
from jaxsph.access.ordering import Ordered
from jaxsph.model.camera import Camera
from jaxsph.numerics import faults
from jaxsph.numerics.fusion import fusion_barrier

PAIRS_AT_ONCE = 1 << 16  # that a program tests: with fewer, calling it costs more than what it does
ALIGNMENT = 64  # bytes that arrays are to begin at for XLA to take them without a copy
Test = Callable[[tuple[np.ndarray, ...]], Array]


class Sides(NamedTuple):
    """Tiles of a band that each particle can touch, first and last, in small integers; none if a first is past the last.

    `bundles` are the same for bundles as in `Ranges`, packed into as few words as hold them.
    """

    left: Int[Array, " particles"]
    right: Int[Array, " particles"]
    top: Int[Array, " particles"]
    bottom: Int[Array, " particles"]
    bundles: tuple[Int[Array, " particles"], ...]


class _Pairs(NamedTuple):
    """(Particle, tile) pairs of a band by tile and rank, filled up to whole batches.

    Attributes:
        rank: of the particle.
        down, across: row and column of the tile in the band.
        start: (rows, columns + 1): where the pairs of each tile begin, and those of the row end.
    """

    rank: np.ndarray
    down: np.ndarray
    across: np.ndarray
    start: np.ndarray

    @classmethod
    def empty(cls, total: int, plan: ListPlan) -> _Pairs:
        """With room for so many."""
        room = -(-total // PAIRS_AT_ONCE) * PAIRS_AT_ONCE
        places = np.zeros((2, room), _small(plan))
        start = np.zeros((plan.tile_rows, plan.tile_columns + 1), np.int64)
        return cls(np.zeros(room, np.int32), places[0], places[1], start)


@functools.partial(jax.jit, static_argnames="lists")
def find_sides(ordered: Ordered, first_row: Int[Array, ""], *, lists: ListPlan) -> Sides:
    """What all particles of a band are picked by."""
    ranges, kind = bundle_ranges(ordered, lists, first_row), _small(lists)
    nowhere = (ranges.right <= ranges.left) | (ranges.bottom <= ranges.top)
    left, top = (jnp.where(nowhere, jnp.iinfo(kind).max, side >> 1).astype(kind) for side in (ranges.left, ranges.top))
    right, bottom = (jnp.where(nowhere, 0, (side - 1) >> 1).astype(kind) for side in (ranges.right, ranges.bottom))
    sides = [side.astype(jnp.uint32) for side in (ranges.left, ranges.right, ranges.top, ranges.bottom)]
    bits = jnp.iinfo(kind).bits
    each = 32 // bits
    words = [[side << (bits * nth) for nth, side in enumerate(sides[k : k + each])] for k in range(0, 4, each)]
    return Sides(left, right, top, bottom, tuple(functools.reduce(jnp.bitwise_or, word) for word in words))


@jax.jit
def find_touched(
    ordered: Ordered,
    bundles: tuple[Int[Array, " particles"], ...],
    camera: Camera,
    first_row: Int[Array, ""],
    pairs: tuple[Int[Array, " pairs"], Int[Array, " pairs"], Int[Array, " pairs"]],
) -> Int[Array, " pairs"]:
    """As `lists.children_mask`, for `pairs` of a rank and a tile's row and column."""
    rank, down, across = pairs
    columns = (ordered.x, ordered.y, ordered.z, ordered.reach, *bundles)

    def fetch(rank: Array) -> tuple[Array, ...]:
        return tuple(column.at[rank].get(mode="promise_in_bounds") for column in columns)

    def test(x: Array, y: Array, z: Array, reach: Array, *words: Array) -> Array:
        bits = 8 * len(words)
        sides = [(word >> (bits * nth)) & ((1 << bits) - 1) for word in words for nth in range(4 // len(words))]
        ranges = Ranges(*(side.astype(jnp.int32) for side in sides))
        places = down.astype(jnp.int32), across.astype(jnp.int32)
        return children_mask(touched_bundles(Sphere(x, y, z, reach), ranges, camera, first_row, *places))

    # apart from each other the two vectorise: together they take four times as long
    found: Array = fusion_barrier(rank[0] >= 0, test, *fusion_barrier(rank[0] >= 0, fetch, rank))
    return found


def pair_shapes(plan: ListPlan) -> tuple[jax.ShapeDtypeStruct, ...]:
    """Of the pairs that are tested together."""
    return tuple(jax.ShapeDtypeStruct((PAIRS_AT_ONCE,), kind) for kind in (jnp.int32, _small(plan), _small(plan)))


def list_shapes(plan: ListPlan) -> BundleLists:
    """Of the lists of a band."""
    rank, bundle, word = ((plan.list_capacity + 1,), jnp.int32), ((plan.num_bundles,), jnp.int32), ((), jnp.uint32)
    shapes: list[Any] = [jax.ShapeDtypeStruct(*of) for of in (rank, bundle, bundle, word)]
    return BundleLists(*shapes)


def build_lists_on_host(sides: Sides, test: Test, plan: ListPlan) -> BundleLists:
    """The lists of all bundles of a band.

    Args:
        sides: of the particles, from `find_sides`.
        test: `find_touched` for pairs; it may return before it is done.
        plan: sizes of the band.
    """
    picked = _pick(sides, test, plan)
    made = None if picked is None else _split(*picked, plan)
    fault = faults.TILE_OVERFLOW if picked is None else faults.LIST_OVERFLOW if made is None else 0
    rank = _zeros(plan.list_capacity + 1)
    borders = np.zeros((2, plan.num_bundles), np.int32)
    if made is not None:
        rank, borders = made
    return BundleLists(*(jax.device_put(value, may_alias=True) for value in (rank, *borders, np.uint32(fault))))


def _pick(sides: Sides, test: Test, plan: ListPlan) -> tuple[_Pairs, list[Array]] | None:
    """All pairs, and the tests of them, which may not be done yet; None where there is no room for so many."""
    left, right, top, bottom = (np.asarray(side) for side in sides[:4])
    rows = [
        (ranks, left[ranks], right[ranks])
        for ranks in entries_at(np.arange(len(top), dtype=np.int32), top, bottom, 0, plan.tile_rows)
    ]
    total = sum(len(ranks) + int(last.sum(dtype=np.int64)) - int(first.sum(dtype=np.int64)) for ranks, first, last in rows)
    if total > plan.tile_capacity:
        return None
    pairs, filled = _Pairs.empty(total, plan), 0
    tests: list[Array] = []
    for row, (ranks, first, last) in enumerate(rows):
        begin = filled
        for column, some in enumerate(entries_at(ranks, first, last, 0, plan.tile_columns)):
            pairs.start[row, column] = filled
            pairs.rank[filled : filled + len(some)] = some
            pairs.across[filled : filled + len(some)] = column
            filled += len(some)
        pairs.start[row, -1] = filled
        pairs.down[begin:filled] = row
        whole = len(pairs.rank) if row == plan.tile_rows - 1 else filled - filled % PAIRS_AT_ONCE
        for place in range(len(tests) * PAIRS_AT_ONCE, whole, PAIRS_AT_ONCE):
            batch = slice(place, place + PAIRS_AT_ONCE)
            tests.append(test((pairs.rank[batch], pairs.down[batch], pairs.across[batch])))
    return pairs, tests


def _split(pairs: _Pairs, tests: list[Array], plan: ListPlan) -> tuple[np.ndarray, np.ndarray] | None:
    """Ranks of the lists, and where each begins and ends; None where there is no room for so many."""
    rank, borders, filled = _zeros(plan.list_capacity + 1), np.zeros((2, plan.num_tiles, 4), np.int32), 0
    touched, known = np.empty(len(pairs.rank), np.uint8), 0
    for row, start in enumerate(pairs.start):
        begin, end = int(start[0]), int(start[-1])
        tiles = slice(row * plan.tile_columns, (row + 1) * plan.tile_columns)
        for place in range(known, end, PAIRS_AT_ONCE):
            touched[place : place + PAIRS_AT_ONCE] = tests[place // PAIRS_AT_ONCE]
            known = place + PAIRS_AT_ONCE
        for child in range(4):
            some = np.flatnonzero((touched[begin:end] & (1 << child)) != 0)
            if filled + len(some) > plan.list_capacity:
                return None
            pairs.rank[begin:end].take(some, out=rank[filled : filled + len(some)], mode="clip")
            places = filled + np.searchsorted(some, start - begin)
            borders[0, tiles, child], borders[1, tiles, child] = places[:-1], places[1:]
            filled += len(some)
    return rank, borders.reshape(2, -1)


def _small(plan: ListPlan) -> Any:
    """The smallest integers that count the bundles of a band."""
    return np.uint8 if max(plan.bundles) < 1 << 8 else np.uint16


def _zeros(number: int) -> np.ndarray:
    """So many 32-bit integers, where XLA can take them from without a copy."""
    size = np.dtype(np.int32).itemsize
    room = np.zeros(number + ALIGNMENT // size, np.int32)
    first = -room.ctypes.data % ALIGNMENT // size
    return room[first : first + number]
