"""The sparse perspective grid: for every slab of a bundle, the windows of its list that can touch it.

Flow: lists -> [slab_windows] -> control, schedule.

A slab is some samples of all rays of a bundle, a cell as many slabs as have `CELL_SAMPLES` samples. Nothing is copied along
depth: a particle that touches ten slabs of a bundle is listed once and lies in ten windows. There is a window for each class
of supports.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxsph.engine.access.lists import BundleLists
from jaxsph.engine.access.ordering import Ordered
from jaxsph.numerics.trees import tree

MAX_LEVEL = 4  # at which a cell has one sample
CELL_SAMPLES = 1 << MAX_LEVEL  # fine samples of a cell along depth: D_z of Hochstetter et al. 2016


@tree()
class SlabWindows:
    """Windows `rank[begin : begin + length]` of a bundle's list, and their sum over classes.

    A slab with `count` 0 is empty: no particle can touch it.
    """

    begin: Int[Array, "classes slabs bundles"]
    length: Int[Array, "classes slabs bundles"]
    count: Int[Array, "slabs bundles"]


def find_slab_windows(ordered: Ordered, lists: BundleLists, beside: bool = False) -> SlabWindows:
    """Bisect every bundle's list for the first and last rank of every slab and class.

    `beside`: of slabs with all that lies between their samples and those of the next, for samples of any spacing.
    """
    first, last = (ordered.first_beside, ordered.last_beside) if beside else (ordered.first_rank, ordered.last_rank)
    wanted = jnp.stack([first, last])

    def of_class(nth: Array, found: Array) -> Array:
        return found.at[:, nth].set(_bisect(lists.rank, wanted[:, nth], lists.start, lists.end))

    if (classes := first.shape[0]) == 1:
        begin, end = _bisect(lists.rank, wanted, lists.start, lists.end)
    else:  # classes that nobody is in cost nothing
        used = jnp.max(jnp.where((first < last).any(1), jnp.arange(1, classes + 1, dtype=jnp.int32), 0))
        begin, end = lax.fori_loop(0, used, of_class, jnp.zeros((*wanted.shape, lists.start.shape[0]), jnp.int32))
    length = jnp.maximum(end - begin, 0)
    return SlabWindows(begin, length, length.sum(0, dtype=jnp.int32))


@tree()
class Window:
    """Windows of the bundle's list, for each class of supports, of slabs 2^l times as deep as those of the grid."""

    begin: Int[Array, "classes slabs bundles"]
    length: Int[Array, "classes slabs bundles"]


def coarser_windows(cells: SlabWindows) -> list[Window]:
    """Unions of the windows of 1, 2, 4, 8 and 16 slabs; the number of slabs is rounded up to a multiple of 16."""
    windows = [Window(pad_slabs(cells.begin, cells), pad_slabs(cells.length, cells))]
    for _ in range(MAX_LEVEL):
        begin, length = windows[-1].begin, windows[-1].length
        none = jnp.iinfo(begin.dtype).max
        first = jnp.where(length > 0, begin, none)
        end = jnp.where(length > 0, begin + length, 0)
        first = jnp.minimum(first[:, ::2], first[:, 1::2])
        length = jnp.maximum(jnp.maximum(end[:, ::2], end[:, 1::2]) - first, 0)
        windows.append(Window(jnp.where(length > 0, first, 0), length))
    return windows


def pad_slabs(value: Array, cells: SlabWindows) -> Array:
    """Round the number of slabs up to whole windows of the coarsest level."""
    missing = -cells.count.shape[0] % (1 << MAX_LEVEL)
    return jnp.pad(value, [(0, 0)] * (value.ndim - 2) + [(0, missing), (0, 0)])


def whole_cells(slabs: Bool[Array, "slabs bundles"], slab_samples: int) -> Bool[Array, "cells bundles"]:
    """Cells all of whose slabs are marked."""
    per_cell = CELL_SAMPLES // slab_samples
    padded = jnp.pad(slabs, ((0, -slabs.shape[0] % per_cell), (0, 0)), constant_values=True)
    return padded.reshape(-1, per_cell, slabs.shape[1]).all(1)


def _bisect(rank: Array, wanted: Array, low: Array, high: Array) -> Array:
    """First position in `[low, high)` of each bundle's list with `rank >= wanted`, for all (end, class, slab).

    By steps of powers of two from `low`, as long as all that is stepped over is smaller: one array goes round the loop, where
    of two ends XLA copies both in every turn.
    """
    bits = 32 - lax.clz((high - low).max(initial=0))
    wanted = wanted[..., None]

    def step(turn: Array, position: Array) -> Array:
        past = position + (1 << (bits - 1 - turn))
        smaller = rank[jnp.minimum(past, rank.shape[0]) - 1] < wanted
        return jnp.where((past <= high) & smaller, past, position)

    return lax.fori_loop(0, bits, step, jnp.broadcast_to(low, (*wanted.shape[:-1], low.shape[0])))
