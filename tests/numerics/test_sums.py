"""Running sums are those of NumPy, along any axis and for any length."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from jaxsph.numerics.sums import STEP, running_sum


@pytest.mark.parametrize("shape", [(0,), (1,), (STEP,), (STEP + 1,), (STEP**3 - 1,), (3, 0, 2), (STEP**2 + 5, 4), (2, 70, 3)])
def test_sums_are_those_of_numpy(shape):
    value = np.random.default_rng(0).integers(-9, 9, shape).astype(np.int32)
    for axis in range(-1, len(shape)):
        found = jax.jit(running_sum, static_argnums=1)(value, axis)
        assert found.dtype == value.dtype
        assert np.array_equal(found, np.cumsum(value, axis))


def test_sums_wrap_like_those_of_unsigned_words():
    value = np.full(20, np.uint32(1) << 31)
    assert np.array_equal(running_sum(value), np.cumsum(value, dtype=np.uint32))
