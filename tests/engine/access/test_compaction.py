"""The compacted slabs hold every filled item once, front to back, tallest bundles first."""

from __future__ import annotations

import hypothesis.extra.numpy as hnp
import jax
import numpy as np
from examples import examples
from hypothesis import given

from jaxsph.engine.access.compaction import compact

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
