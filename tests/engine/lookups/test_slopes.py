"""Promises of derivatives of means: those of the exact integral, finite everywhere, free of noise where ranges are short."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.lookups.means import MeanTables, mean_light

CASES = {  # of three shapes, for few programs
    "one": np.array([0.5]),
    "six": np.array([-1, -0.4, 0.1, 0.9, 1.3, 2]),
    "jumps": np.array([0, 0.3, 0.3, 0.7, 1, 1]),
    "even": np.linspace(-1, 2, 46),
    "uneven": np.sort(np.random.default_rng(1).uniform(-1, 2, 46)),
    "uneven with jumps": np.sort(np.append(np.random.default_rng(2).uniform(-1, 2, 40), [-1, -1, 0.5, 0.5, 2, 2])),
}
ARGUMENTS = ("values", "colors", "extinction", "near", "far")


def means(values, colors, extinction, near, far):
    tables = MeanTables.of(js.TransferFunction(values, colors, extinction).segments())
    return jnp.stack(mean_light(tables, near, far, slice(0, 4)), -1)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def pushed(given, change):
    return jax.jvp(means, given, change)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def pulled(given, cotangent):
    out, pull = jax.vjp(means, *given)
    return out, pull(cotangent)


def arguments(values, rng, number=100):
    count = len(values)
    near = rng.uniform(-1.5, 2.5, number)
    far = near + rng.choice([1e-6, 0.01, 0.3, 2], number) * rng.uniform(-1, 1, number)
    return [values, rng.uniform(0, 1, (count, 3)), rng.uniform(0, 5, count), near, far]


def direction(given, which, rng):
    """Some change of one argument; jumps move as a whole."""
    found = [np.zeros_like(value) for value in given]
    found[which] = rng.normal(size=given[which].shape)
    if which == 0:
        later = np.flatnonzero(np.diff(given[0]) == 0) + 1
        found[0][later] = found[0][later - 1]
    return found


@pytest.mark.parametrize("which", range(5), ids=ARGUMENTS)
@pytest.mark.parametrize("case", CASES)
def test_derivatives_are_those_of_differences(case, which, x64):
    rng = np.random.default_rng(which)
    given = arguments(CASES[case], rng)
    change = direction(given, which, rng)
    step = 1e-7
    got = pushed(given, change)[1]
    moved = ([a + sign * step * b for a, b in zip(given, change, strict=True)] for sign in (1, -1))
    after, before = (np.asarray(pushed(ends, change)[0]) for ends in moved)
    np.testing.assert_allclose(got, (after - before) / (2 * step), rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["jumps", "even", "uneven with jumps"])
def test_cotangents_are_the_transpose(case, x64):
    rng = np.random.default_rng(5)
    given = arguments(CASES[case], rng)
    change = [direction(given, which, rng)[which] for which in range(5)]
    weights = rng.normal(size=(len(given[3]), 4))
    forward = (weights * np.asarray(pushed(given, change)[1])).sum()
    reverse = sum((np.asarray(a) * b).sum() for a, b in zip(pulled(given, weights)[1], change, strict=True))
    np.testing.assert_allclose(reverse, forward, rtol=1e-9)


@pytest.mark.parametrize("width", [0, 1e-7, 1e-5])
@pytest.mark.parametrize("case", ["six", "even", "uneven"])
def test_a_short_range_has_half_the_slope_at_each_end_in_float32(case, width):
    values = np.float32(CASES[case])
    rng = np.random.default_rng(6)
    extinction = np.float32(rng.uniform(0, 5, len(values)))
    k = len(values) // 2
    near = (values[k] + values[k + 1]) / 2
    given = [values, np.zeros((len(values), 3), np.float32), extinction, near, near + np.float32(width)]
    slopes = pulled(given, np.float32([0, 0, 0, 1]))[1][3:]
    slope = (extinction[k + 1] - extinction[k]) / (values[k + 1] - values[k])
    np.testing.assert_allclose(slopes, [slope / 2, slope / 2], rtol=1e-4)


@pytest.mark.parametrize("ends", [(0.3, 0.3), (1, 1), (0, 0), (1e30, 1e30), (-1e30, 3e30), (-1e38, 1e38), (np.inf, -np.inf)])
@pytest.mark.parametrize("case", ["one", "jumps", "even", "uneven with jumps"])
def test_derivatives_are_finite_everywhere(case, ends):
    rng = np.random.default_rng(7)
    given = [np.float32(value) for value in (*arguments(CASES[case], rng)[:3], *ends)]
    out, slopes = pulled(given, np.ones(4, np.float32))
    assert all(np.isfinite(value).all() for value in (out, *slopes))
