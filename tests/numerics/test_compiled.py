"""Extremes and ratios are those of numpy, derivatives ask which is larger; numbers are taken apart; fusion heeds barriers."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from jaxsph.numerics import compiled
from jaxsph.numerics.compiled import LEAST, clamped, fusion_barrier, greater, lesser, ratio

NUMBERS = st.floats(width=32, allow_nan=False, allow_subnormal=False)  # which XLA takes for 0 on CPUs


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


@given(st.floats(2**-10, 1, width=32), st.sampled_from([-1, 1]), st.floats(-96, 30))
def test_derivatives_of_ratios_are_right_where_squares_of_divisors_underflow(share, sign, exponent):
    """In both modes, to some eps: a sum of weights near the end of a support may be 1e-30, and what it divides as small."""
    whole = np.float32(2**exponent)
    part = np.float32(sign * share) * whole
    found, pull = jax.vjp(ratio, part, whole)
    exact = np.float64(part) / np.float64(whole)
    wanted = 1 / np.float64(whole), -exact / np.float64(whole)
    rounded = 0 if jax.default_backend() == "cpu" else 2 * np.finfo(np.float32).eps  # GPUs divide by a reciprocal
    np.testing.assert_allclose(found, part / whole, rtol=rounded)
    np.testing.assert_allclose(pull(jnp.float32(1)), wanted, rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(ratio, (part, whole), (whole, whole))[1], 1 - exact, atol=1e-6)


@pytest.mark.parametrize("whole", [0.0, -1.0, np.nan, 1e-38, LEAST * np.finfo(np.float32).tiny])
def test_what_is_divided_by_next_to_nothing_has_no_derivatives(whole):
    part, whole = jnp.float32(1e-37), jnp.float32(whole)
    np.testing.assert_array_equal(jax.grad(ratio, (0, 1))(part, whole), (0, 0))
    assert np.isfinite(ratio(part, whole))


split, power = jax.jit(compiled.mantissa_and_exponent), jax.jit(compiled.power_of_two, static_argnums=1)


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
    assert power(exponent, dtype).tolist() == expected.tolist()


def test_subnormal_numbers_are_known_as_such_under_jit():
    tiny = np.finfo(np.float32).tiny
    found = jax.jit(compiled.is_subnormal)(np.array([0, tiny, -tiny, tiny / 2, -tiny / 2, 1, np.inf, np.nan], np.float32))
    assert found.tolist() == [False, False, False, True, True, False, False, False]


def held(witness, x):
    return fusion_barrier(witness > 0, lambda x: (x + 1) ** 2, x)


@pytest.mark.parametrize("witness", [1.0, -1.0, 0.0, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("transformed", [held, jax.jit(held), jax.jit(lambda w, x: jax.vmap(held)(w[None], x[None])[0])])
def test_no_witness_of_a_barrier_makes_zeros(transformed, witness):
    """NaN fails every comparison, and took the branch that nothing is computed in."""
    np.testing.assert_array_equal(transformed(np.float32(witness), np.arange(3, dtype=np.float32)), [1, 4, 9])


def test_derivatives_go_through_a_barrier():
    slope = jax.jit(jax.grad(lambda x: fusion_barrier(x[0] > np.nan, lambda x: x**2, x).sum()))(np.arange(3, dtype=np.float32))
    np.testing.assert_array_equal(slope, [0, 2, 4])


def test_a_barrier_is_still_there_when_compiled():
    """The point of it: a branch, that fusion respects on CPUs; elsewhere XLA takes it out."""
    with jax.default_device(jax.devices("cpu")[0]):
        lowered = jax.jit(lambda w, x: fusion_barrier(w > 0, jnp.sin, x)).lower(np.float32(1), np.ones(5, np.float32))
        assert "conditional" in lowered.compile().as_text()


@pytest.mark.core
def test_an_extent_is_that_of_what_counts():
    rng, sizes = np.random.default_rng(0), (0, 1, 5, 4096, 10_001)
    given = [(rng.normal(size=size).astype(np.float32), rng.uniform(size=size) < 0.5) for size in sizes]
    found = jax.jit(lambda given: [compiled.extent(*one) for one in given])(given)
    for (value, counts), (least, greatest) in zip(given, found, strict=True):
        assert (least, greatest) == (value[counts].min(initial=np.inf), value[counts].max(initial=-np.inf))
