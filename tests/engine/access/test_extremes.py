"""Extremes of windows enclose what is in them, wherever pieces of lists end, and of long windows nothing is said."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st

from jaxsph.engine.access import extremes
from jaxsph.engine.access.extremes import LONGEST, window_extremes
from jaxsph.engine.access.grid import SlabWindows
from jaxsph.engine.access.lists import BundleLists

PARTICLES, CLASSES, SLABS, BUNDLES = 500, 2, 5, 12


@pytest.fixture(scope="module")
def found():
    """Extremes of windows, of lists in pieces that end within them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(extremes, "PIECE", 2 * LONGEST)
        patch.setattr(extremes, "WINDOWS", 16)
        yield functools.partial(jax.jit(lambda *given: window_extremes(*given)))


def lists_and_windows(seed, longest):
    """Lists of bundles in any order, with what is of no meaning past the last, and windows within them."""
    rng = np.random.default_rng(seed)
    lengths = rng.integers(0, 2 * longest, BUNDLES)
    lengths[rng.integers(BUNDLES)] = 0
    order = rng.permutation(BUNDLES)
    if seed % 2:  # there is no room left
        lengths[order[-1]] = 2 * BUNDLES * LONGEST - lengths.sum() + lengths[order[-1]]
    start = np.zeros(BUNDLES, np.int32)
    start[order] = np.cumsum(np.append(0, lengths[order][:-1]))
    end = (start + lengths).astype(np.int32)
    rank = rng.integers(-(2**31), 2**31, 2 * BUNDLES * LONGEST + 1).astype(np.int32)
    rank[: lengths.sum()] = rng.integers(0, PARTICLES, int(lengths.sum()))
    begin = rng.integers(start, end + 1, (CLASSES, SLABS, BUNDLES)).astype(np.int32)
    length = np.where(rng.uniform(size=begin.shape) < 0.2, 0, rng.integers(0, np.minimum(end - begin, longest) + 1)).astype(
        np.int32
    )
    windows = SlabWindows(begin, length, length.sum(0, dtype=np.int32))
    return BundleLists(rank, start, end, np.uint32(0)), windows


@pytest.mark.core
@examples(60)
@given(st.integers(0, 2**32 - 1), st.sampled_from([3, 40, LONGEST]))
def test_extremes_enclose_all_of_a_window(found, seed, longest):
    lists, windows = lists_and_windows(seed, longest)
    quantity = np.random.default_rng(seed).normal(size=PARTICLES).astype(np.float32)
    least, greatest = map(np.asarray, found(quantity, lists, windows))
    for slab, bundle in np.ndindex(SLABS, BUNDLES):
        inside = [
            quantity[lists.rank[begin : begin + length]]
            for begin, length in zip(windows.begin[:, slab, bundle], windows.length[:, slab, bundle], strict=True)
        ]
        all_of_it = np.concatenate(inside)
        low, high = least[slab, bundle], greatest[slab, bundle]
        if not len(all_of_it):
            assert low == np.inf and high == -np.inf
        else:
            assert low <= all_of_it.min() and all_of_it.max() <= high
            known = max(map(len, inside)) <= LONGEST - extremes.BLOCK
            assert np.isfinite([low, high]).all() == known


@pytest.mark.core
def test_extremes_are_those_of_whole_blocks(found):
    """Windows that begin and end with blocks have their own extremes."""
    rank = np.arange(PARTICLES, dtype=np.int32)
    quantity = np.random.default_rng(0).normal(size=PARTICLES).astype(np.float32)
    lists = BundleLists(rank, np.int32([0, 96]), np.int32([96, 400]), np.uint32(0))
    begin, length = np.int32([[[0, 96], [16, 200]]]), np.int32([[[96, 104], [8, 200]]])
    least, greatest = map(np.asarray, found(quantity, lists, SlabWindows(begin, length, length[0])))
    for slab, bundle in np.ndindex(2, 2):
        first = begin[0, slab, bundle]
        own = quantity[first : first + length[0, slab, bundle]]
        assert least[slab, bundle] == own.min() and greatest[slab, bundle] == own.max()
