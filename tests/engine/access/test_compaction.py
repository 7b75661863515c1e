"""Compacted slabs hold every filled item once, front to back, tallest bundles first; running sums are those of NumPy."""

from __future__ import annotations

import hypothesis.extra.numpy as hnp
import jax
import numpy as np
from examples import examples
from hypothesis import given

from jaxsph.engine.access.compaction import STEP, compact, running_sum

compacted_of = jax.jit(compact)


@examples(30)
@given(hnp.arrays(bool, (5, 7)))
def test_layers_hold_the_nth_filled_item_of_every_bundle_in_order_of_height(filled):
    slabs, bundles = filled.shape
    compacted = compacted_of(filled)
    item, start, rank = (np.asarray(value) for value in (compacted.item, compacted.start, compacted.bundle_rank))
    height = filled.sum(0)
    assert sorted(rank) == list(range(bundles))
    bundle = np.argsort(rank)
    assert (np.diff(height[bundle]) <= 0).all()
    assert start[0] == 0 and start[-1] == filled.sum()
    assert (item[start[-1] :] == slabs * bundles).all()
    for layer in range(slabs):
        reached = bundle[: (height > layer).sum()]
        nth = [np.flatnonzero(filled[:, b])[layer] * bundles + b for b in reached]
        assert list(item[start[layer] : start[layer + 1]]) == nth


@jax.jit
def sums(values):
    """Along all axes of each, in one program."""
    return [[running_sum(value, axis) for axis in range(-1, value.ndim)] for value in values]


def test_sums_are_those_of_numpy():
    rng = np.random.default_rng(0)
    shapes = (0,), (1,), (STEP,), (STEP + 1,), (STEP**3 - 1,), (3, 0, 2), (STEP**2 + 5, 4), (2, 70, 3)
    values = [rng.integers(-9, 9, shape).astype(np.int32) for shape in shapes]
    values.append(np.full(20, np.uint32(1) << 31))  # which wraps
    for value, found in zip(values, sums(values), strict=True):
        for axis, one in enumerate(found, -1):
            assert one.dtype == value.dtype and np.array_equal(one, np.cumsum(value, axis, value.dtype))
