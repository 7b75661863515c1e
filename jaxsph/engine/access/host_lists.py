"""The lists of bundles, for a frame that is run on CPUs stage by stage: searched by NumPy, tested by XLA.

Flow: view -> [host_lists] -> grid.

The same lists as those of `lists.build_lists`, which serves traces and accelerators. Particles stand in the order of their
ranks, so to pick those of a row of tiles, of these those of a tile, and of these those of a bundle, keeps them in order: nothing
is sorted at all. XLA tests pairs in batches, while NumPy picks the next.

XLA sorts by comparisons, 45 ns a particle (of a million, on one core of an AVX-512 machine), and selects by scatters, 4 ns an
entry; both on one thread. Of 16-bit numbers NumPy makes a radix sort, 5 ns a particle and digit, and it finds what is true in
half a nanosecond an entry.

Lists lie in the order of the rows of tiles, in a row by corner of the tile: their starts do not ascend.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.lists import BundleLists, ListPlan, Ranges, bundle_ranges, touched_bundles
from jaxsph.engine.access.view import Spheres, Viewed
from jaxsph.engine.runtime.programs import stage
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics import faults
from jaxsph.numerics.compiled import fusion_barrier

GROUP = 8  # places that entries are looked through for together, before they are for each
PER_THREAD = 1 << 16  # keys that a thread more pays for
SAMPLED = 1 << 10  # keys that the keys' middle is told from
PAIRS_AT_ONCE = 1 << 16  # that a program tests: with fewer, calling it costs more than what it does
ALIGNMENT = 64  # bytes that arrays are to begin at for XLA to take them without a copy
Test = Callable[[tuple[np.ndarray, ...]], Array]


def depth_order(viewed: Viewed, threads: int) -> Int[Array, " particles"]:
    """The order of particles' keys, on the device that holds them."""
    return jax.device_put(sorted_order(np.asarray(viewed.key), threads), may_alias=True)  # type: ignore[no-any-return]


def sorted_order(key: np.ndarray, threads: int) -> np.ndarray:
    """The order in which 32-bit keys ascend; equal ones in the order that they have. (entries,), int32.

    With several threads, keys are parted by how large they are, and the parts sorted side by side.
    """
    number = min(threads, -(-len(key) // PER_THREAD))
    if number <= 1:
        return _radix(key).astype(np.int32)
    some = np.sort(key[:: max(len(key) // SAMPLED, 1)])
    part = np.zeros(len(key), np.uint8)  # of ranges that hold about equally many
    for border in some[[len(some) * nth // number for nth in range(1, number)]]:
        part += key >= border
    parts = (np.flatnonzero(part == nth) for nth in range(number))
    with ThreadPoolExecutor(number) as pool:
        orders = pool.map(lambda part: part[_radix(key[part])].astype(np.int32), parts)
        return np.concatenate(list(orders))


def entries_at(values: np.ndarray, first: np.ndarray, last: np.ndarray, begin: int, end: int) -> Iterator[np.ndarray]:
    """For each place from `begin` to before `end`: `values` of the entries with `first <= place <= last`, in their order."""
    step = 1
    while step * GROUP < end - begin:
        step *= GROUP
    for low in range(begin, end, step):
        high = min(low + step, end)
        some = np.flatnonzero((first < high) & (last >= low))
        if step == 1:
            yield values[some]
        else:
            yield from entries_at(values[some], first[some], last[some], low, high)


def _radix(key: np.ndarray) -> np.ndarray:
    """By the lower half of the digits, then by the upper: NumPy's stable sort of 16-bit numbers goes by their digits."""
    order = np.argsort(key.astype(np.uint16), kind="stable")
    upper = (key >> 16).astype(np.uint16)
    return order[np.argsort(upper[order], kind="stable")]


class Sides(NamedTuple):
    """Tiles of a band that each particle can touch, first and last, in small integers; none if a first is past the last.

    Attributes:
        bundles: the same for bundles as in `Ranges`, packed into as few words as hold them.
        spheres: x, y, z and reach of each, side by side: to fetch them one by one is to miss the cache four times.
    """

    left: Int[Array, " particles"]
    right: Int[Array, " particles"]
    top: Int[Array, " particles"]
    bottom: Int[Array, " particles"]
    bundles: tuple[Int[Array, " particles"], ...]
    spheres: Float[Array, "particles 4"]


class _Pairs(NamedTuple):
    """(Particle, tile) pairs of a band by tile and rank, filled up to whole batches.

    Attributes:
        rank: of the particle.
        down, across: row and column of the tile in the band.
        touched: which of its bundles, see `lists.touched_bundles`.
        start: (rows, columns + 1): where the pairs of each tile begin, and those of the row end.
    """

    rank: np.ndarray
    down: np.ndarray
    across: np.ndarray
    touched: np.ndarray
    start: np.ndarray


@stage("lists", quickly=True)
def find_sides(ordered: Spheres, camera: Camera, first_row: Int[Array, ""], *, lists: ListPlan) -> Sides:
    """What all particles of a band are picked by."""
    ranges, kind = bundle_ranges(ordered, camera, lists, first_row), _small(lists)
    nowhere = (ranges.right <= ranges.left) | (ranges.bottom <= ranges.top)
    left, top = (jnp.where(nowhere, jnp.iinfo(kind).max, side >> 1).astype(kind) for side in (ranges.left, ranges.top))
    right, bottom = (jnp.where(nowhere, 0, (side - 1) >> 1).astype(kind) for side in (ranges.right, ranges.bottom))
    sides = [side.astype(jnp.uint32) for side in (ranges.left, ranges.right, ranges.top, ranges.bottom)]
    bits = jnp.iinfo(kind).bits
    each = 32 // bits
    words = [[side << (bits * nth) for nth, side in enumerate(sides[k : k + each])] for k in range(0, 4, each)]
    lane, spheres = jnp.arange(4, dtype=jnp.int32), jnp.zeros((*ordered.x.shape, 4), ordered.x.dtype)
    for nth, column in enumerate((ordered.x, ordered.y, ordered.z, ordered.reach)):
        spheres = jnp.where(lane == nth, column[:, None], spheres)
    return Sides(left, right, top, bottom, tuple(functools.reduce(jnp.bitwise_or, word) for word in words), spheres)


@stage(quickly=True)
def find_touched(
    spheres: Float[Array, "particles 4"],
    bundles: tuple[Int[Array, " particles"], ...],
    camera: Camera,
    first_row: Int[Array, ""],
    pairs: tuple[Int[Array, " pairs"], Int[Array, " pairs"], Int[Array, " pairs"]],
) -> Int[Array, " pairs"]:
    """As `lists.touched_bundles`, for `pairs` of a rank and a tile's row and column."""
    rank, down, across = pairs

    def fetch(rank: Array) -> tuple[Array, ...]:
        return tuple(column.at[rank].get(mode="promise_in_bounds") for column in (spheres, *bundles))

    def test(sphere: Array, *words: Array) -> Array:
        bits = 8 * len(words)
        sides = [(word >> (bits * nth)) & ((1 << bits) - 1) for word in words for nth in range(4 // len(words))]
        ranges = Ranges(*(side.astype(jnp.int32) for side in sides))
        places = down.astype(jnp.int32), across.astype(jnp.int32)
        return touched_bundles(sphere.T, ranges, camera, first_row, *places)

    # apart from each other the two vectorise: together they take four times as long
    return fusion_barrier(rank[0] >= 0, test, *fusion_barrier(rank[0] >= 0, fetch, rank))  # type: ignore[no-any-return]


def pair_shapes(plan: ListPlan) -> tuple[jax.ShapeDtypeStruct, ...]:
    """Of the pairs that are tested together."""
    return tuple(jax.ShapeDtypeStruct((PAIRS_AT_ONCE,), kind) for kind in (jnp.int32, _small(plan), _small(plan)))


def list_shapes(plan: ListPlan) -> BundleLists:
    """Of the lists of a band."""
    rank, bundle, word = ((plan.list_capacity + 1,), jnp.int32), ((plan.num_bundles,), jnp.int32), ((), jnp.uint32)
    shapes: list[Any] = [jax.ShapeDtypeStruct(*of) for of in (rank, bundle, bundle, word)]
    return BundleLists(*shapes)


def build_lists_on_host(sides: Sides, test: Test, plan: ListPlan, threads: int) -> BundleLists:
    """The lists of all bundles of a band; without room for them, a fault and none.

    Args:
        sides: of the particles, from `find_sides`.
        test: `find_touched` for pairs; it may return before it is done.
        plan: sizes of the band.
        threads: rows of tiles that are worked on side by side.
    """
    with ThreadPoolExecutor(threads) as pool:
        pairs = _pick(sides, test, plan, pool)
        if pairs is None:
            return _lists(plan, faults.TILE_OVERFLOW)
        found = _split(pairs, plan, pool)
    return _lists(plan, faults.LIST_OVERFLOW) if found is None else _lists(plan, 0, *found)


def _lists(plan: ListPlan, fault: int, rank: np.ndarray | None = None, borders: np.ndarray | None = None) -> BundleLists:
    rank = _zeros(plan.list_capacity + 1) if rank is None else rank
    start, end = np.zeros((2, plan.num_bundles), np.int32) if borders is None else borders
    return BundleLists(*(jax.device_put(value, may_alias=True) for value in (rank, start, end, np.uint32(fault))))


def _pick(sides: Sides, test: Test, plan: ListPlan, pool: ThreadPoolExecutor) -> _Pairs | None:
    """All pairs, and which bundles they touch; None without room for so many."""
    left, right, top, bottom = (np.asarray(side) for side in sides[:4])
    rows = list(entries_at(np.arange(len(top), dtype=np.int32), top, bottom, 0, plan.tile_rows))
    columns = [(left[ranks], right[ranks]) for ranks in rows]
    counts = [len(first) + int(last.sum(dtype=np.int64) - first.sum(dtype=np.int64)) for first, last in columns]
    begin = np.concatenate([[0], np.cumsum(counts)])
    if begin[-1] > plan.tile_capacity:
        return None
    room, start = -(-int(begin[-1]) // PAIRS_AT_ONCE) * PAIRS_AT_ONCE, np.zeros((plan.tile_rows, plan.tile_columns + 1), np.int64)
    down, across = np.zeros((2, room), _small(plan))
    pairs = _Pairs(np.zeros(room, np.int32), down, across, np.empty(room, np.uint8), start)

    def pick(row: int) -> None:
        filled = int(begin[row])
        for column, some in enumerate(entries_at(rows[row], *columns[row], 0, plan.tile_columns)):
            place = slice(filled, filled + len(some))
            pairs.rank[place], pairs.across[place], pairs.start[row, column] = some, column, filled
            filled += len(some)
        pairs.down[begin[row] : filled], pairs.start[row, -1] = row, filled

    tests: list[Array] = []
    for row, _ in enumerate(pool.map(pick, range(plan.tile_rows))):
        whole = len(pairs.rank) if row == plan.tile_rows - 1 else int(begin[row + 1])
        while (len(tests) + 1) * PAIRS_AT_ONCE <= whole:
            batch = slice(len(tests) * PAIRS_AT_ONCE, (len(tests) + 1) * PAIRS_AT_ONCE)
            tests.append(test((pairs.rank[batch], pairs.down[batch], pairs.across[batch])))
    for nth, found in enumerate(tests):
        pairs.touched[nth * PAIRS_AT_ONCE : (nth + 1) * PAIRS_AT_ONCE] = found
    return pairs


def _split(pairs: _Pairs, plan: ListPlan, pool: ThreadPoolExecutor) -> tuple[np.ndarray, np.ndarray] | None:
    """Ranks of the lists, and where each begins and ends; None without room for so many."""
    rows = [slice(*map(int, start[[0, -1]])) for start in pairs.start]

    def look(row: int) -> list[np.ndarray]:
        return [pairs.touched[rows[row]] & (1 << child) != 0 for child in range(4)]

    # a row of tiles at a time: to hand a thread less takes longer than to do it
    touched = [found for of_row in pool.map(look, range(plan.tile_rows)) for found in of_row]
    begin = np.concatenate([[0], np.cumsum([np.count_nonzero(found) for found in touched])])
    if begin[-1] > plan.list_capacity:
        return None
    rank, borders = _zeros(plan.list_capacity + 1), np.zeros((2, plan.tile_rows, plan.tile_columns, 4), np.int32)

    def split(row: int) -> None:
        for child in range(4):
            nth = 4 * row + child
            some = np.flatnonzero(touched[nth])
            pairs.rank[rows[row]].take(some, out=rank[begin[nth] : begin[nth + 1]], mode="clip")
            places = begin[nth] + np.searchsorted(some, pairs.start[row] - pairs.start[row, 0])
            borders[0, row, :, child], borders[1, row, :, child] = places[:-1], places[1:]

    list(pool.map(split, range(plan.tile_rows)))
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
