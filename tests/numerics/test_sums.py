"""Running sums are those of NumPy, along any axis and for any length."""

from __future__ import annotations

import jax
import numpy as np

from jaxsph.engine.access.compaction import STEP, running_sum


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
