"""Minimum and maximum are those of numpy, and their derivatives ask which number is larger, never which the result equals."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.numerics.extremes import clamped, greater, lesser

NUMBERS = st.floats(width=32, allow_nan=False)


@jax.jit
def compared(value, a, b):
    return lesser(a, b), greater(a, b), clamped(value, a, b)


def found(*numbers):
    return tuple(map(np.asarray, compared(*numbers)))


@given(NUMBERS, NUMBERS)
def test_they_are_those_of_numpy(a, b):
    a, b = np.float32(a), np.float32(b)
    assert found(a, a, b)[:2] == (np.minimum(a, b), np.maximum(a, b))


@given(NUMBERS, st.tuples(NUMBERS, NUMBERS).map(sorted))
def test_what_is_clamped_is_between_its_bounds(value, bounds):
    low, high = map(np.float32, bounds)
    assert found(np.float32(value), low, high)[2] == np.clip(np.float32(value), low, high)


def test_nan_stays_where_the_other_number_is_a_constant():
    assert np.isnan(jax.jit(lambda nan: (clamped(nan, 0, 1), lesser(0, nan), greater(0, nan)))(np.float32(np.nan))).all()


@pytest.mark.parametrize("which", [lesser, greater, lambda a, b: clamped(a, 0, b)], ids=["lesser", "greater", "clamped"])
def test_no_derivative_asks_whether_two_numbers_are_equal(which):
    asked = jax.make_jaxpr(lambda a, b: jax.jvp(which, (a, b), (a, b)))(0.5, 2.0)
    assert " eq " not in str(asked)
    towards_a, towards_b = jax.jit(jax.grad(which, (0, 1)))(0.5, 2.0)
    assert (float(towards_a), float(towards_b)) == ((0, 1) if which is greater else (1, 0))
