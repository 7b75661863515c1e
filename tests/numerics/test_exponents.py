"""Numbers are taken apart and put together exactly, to the ends of their range."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.numerics import exponents

split, power_of_two = jax.jit(exponents.split), jax.jit(exponents.power_of_two, static_argnums=1)


@given(x=st.floats(width=32, allow_nan=False, allow_infinity=False, allow_subnormal=False))
def test_mantissa_times_power_is_the_number(x):
    mantissa, exponent = split(np.float32(x))
    assert float(mantissa) * 2.0 ** int(exponent) == x
    assert x == 0 or 1 <= abs(float(mantissa)) < 2


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_powers_of_two_are_exact_and_end_at_zero_and_the_largest(dtype, x64):
    info = np.finfo(dtype)
    exponent = np.array([info.minexp - 1, info.minexp, -1, 0, 7, info.maxexp - 1, info.maxexp, 10 * info.maxexp])
    expected = np.ldexp(dtype(1), np.minimum(exponent, info.maxexp - 1)).astype(dtype)
    expected[0] = 0
    assert power_of_two(exponent, dtype).tolist() == expected.tolist()


def test_subnormal_numbers_are_known_as_such_under_jit():
    tiny = np.finfo(np.float32).tiny
    found = jax.jit(exponents.is_subnormal)(np.array([0, tiny, -tiny, tiny / 2, -tiny / 2, 1, np.inf, np.nan], np.float32))
    assert found.tolist() == [False, False, False, True, True, False, False, False]
