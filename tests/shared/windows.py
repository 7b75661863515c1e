"""Windows of slabs, drawn at random: what control makes coarser, and what a schedule counts."""

from __future__ import annotations

import numpy as np

from jaxsph.engine.access.grid import CELL_SAMPLES, SlabWindows

CLASSES, CELLS, BUNDLES = 2, 17, 3


def windows_of(slab_samples):
    """Windows of slabs that begin one after the other, some of them empty."""
    rng = np.random.default_rng(slab_samples)
    shape = (CLASSES, CELLS * CELL_SAMPLES // slab_samples, BUNDLES)
    begin = np.sort(rng.integers(0, 900, shape), 1).astype(np.int32)
    length = np.where(rng.uniform(size=shape) < 0.3, 0, rng.integers(1, 40, shape)).astype(np.int32)
    return SlabWindows(begin, length, length.sum(0, dtype=np.int32))
