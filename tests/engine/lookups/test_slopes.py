"""Promises of derivatives of means: those of the exact integral, finite everywhere, free of noise where ranges are short."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.lookups.means import MeanTables, mean_light

CASES = {
    "one": np.array([0.5]),
    "five": np.array([-1, -0.4, 0.1, 0.9, 2]),
    "jumps": np.array([0, 0.3, 0.3, 0.7, 1, 1]),
    "even": np.linspace(-1, 2, 66),
    "uneven": np.sort(np.random.default_rng(1).uniform(-1, 2, 40)),
    "uneven with jumps": np.sort(np.append(np.random.default_rng(2).uniform(-1, 2, 40), [-1, -1, 0.5, 0.5, 2, 2])),
}
ARGUMENTS = ("values", "colors", "extinction", "near", "far")


@jax.jit
def means(values, colors, extinction, near, far):
    tables = MeanTables.of(js.TransferFunction(values, colors, extinction).segments())
    return jnp.stack(mean_light(tables, near, far, slice(0, 4)), -1)


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
    got = jax.jvp(means, given, change)[1]
    after, before = (means(*[a + s * step * b for a, b in zip(given, change, strict=True)]) for s in (1, -1))
    np.testing.assert_allclose(got, (after - before) / (2 * step), rtol=1e-5, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["jumps", "even", "uneven with jumps"])
def test_cotangents_are_the_transpose(case, x64):
    rng = np.random.default_rng(5)
    given = arguments(CASES[case], rng)
    change = [direction(given, which, rng)[which] for which in range(5)]
    out, pull = jax.vjp(means, *given)
    weights = rng.normal(size=out.shape)
    pushed = (weights * jax.jvp(means, given, change)[1]).sum()
    pulled = sum((a * b).sum() for a, b in zip(pull(weights), change, strict=True))
    np.testing.assert_allclose(pulled, pushed, rtol=1e-9)


@pytest.mark.parametrize("width", [0, 1e-7, 1e-5])
@pytest.mark.parametrize("case", ["five", "even", "uneven"])
def test_a_short_range_has_half_the_slope_at_each_end_in_float32(case, width):
    values = np.float32(CASES[case])
    rng = np.random.default_rng(6)
    extinction = np.float32(rng.uniform(0, 5, len(values)))
    k = len(values) // 2
    near = (values[k] + values[k + 1]) / 2
    given = values, np.zeros((len(values), 3), np.float32), extinction
    slopes = jax.grad(lambda *ends: means(*given, *ends)[3], (0, 1))(near, near + np.float32(width))
    slope = (extinction[k + 1] - extinction[k]) / (values[k + 1] - values[k])
    np.testing.assert_allclose(slopes, [slope / 2, slope / 2], rtol=1e-4)


@pytest.mark.parametrize("ends", [(0.3, 0.3), (1, 1), (0, 0), (1e30, 1e30), (-1e30, 3e30), (-1e38, 1e38), (np.inf, -np.inf)])
@pytest.mark.parametrize("case", ["one", "jumps", "even", "uneven with jumps"])
def test_derivatives_are_finite_everywhere(case, ends):
    rng = np.random.default_rng(7)
    given = [np.float32(value) for value in (*arguments(CASES[case], rng)[:3], *ends)]
    out, pull = jax.vjp(means, *given)
    assert all(np.isfinite(value).all() for value in (out, *pull(jnp.ones_like(out))))
