"""Windows of deeper slabs hold those of all that they span. That windows hold all that can touch their slabs: `test_grid`."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from windows import windows_of

from jaxsph.engine.access.slab_windows import CELL_SAMPLES, MAX_LEVEL, coarser_windows

unions = jax.jit(coarser_windows, compiler_options=QUICKLY)


@pytest.mark.parametrize("slab_samples", [4, 8, 16])
def test_coarser_windows_are_unions_up_to_the_coarsest(slab_samples):
    windows = windows_of(slab_samples)
    begin, length = np.asarray(windows.begin), np.asarray(windows.length)
    found = jax.tree.map(np.asarray, unions(windows))
    assert len(found) == MAX_LEVEL + 1
    for level, window in enumerate(found):
        share = 1 << level
        assert window.begin.shape[1] == -(-begin.shape[1] // CELL_SAMPLES) * CELL_SAMPLES >> level
        for group in range(window.begin.shape[1]):
            part = np.s_[:, group * share : (group + 1) * share]
            filled = length[part] > 0
            first = np.where(filled, begin[part], 10**6).min(1, initial=10**6)
            past = np.where(filled, begin[part] + length[part], 0).max(1, initial=0)
            wanted = np.maximum(past - first, 0)
            np.testing.assert_array_equal(window.length[:, group], wanted)
            np.testing.assert_array_equal(window.begin[:, group][wanted > 0], first[wanted > 0])
