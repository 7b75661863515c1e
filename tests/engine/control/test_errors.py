"""Errors of single cells: relaxed only in cells that are nowhere partly empty, and they grow with the level."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsph.engine.access.slab_windows import CELL_SAMPLES
from jaxsph.engine.control.bounds import SampleBounds
from jaxsph.engine.control.errors import EXPONENTIAL, SUPER_PIXEL, cell_errors

BUNDLES = 64
errors_of = jax.jit(functools.partial(cell_errors, fitting=2), compiler_options={"xla_backend_optimization_level": 0})


def found(relax):
    """Cells whose samples are all touched and covered, some in part empty, some with slabs that nothing touches."""
    rng = np.random.default_rng(0)
    shape = (CELL_SAMPLES, BUNDLES)
    touched = rng.uniform(size=shape) < np.where(np.arange(BUNDLES) % 4 == 3, 0.8, 1)
    covered = touched & (rng.uniform(size=shape) < np.where(np.arange(BUNDLES) % 4 == 1, 0.8, 1))
    low = [rng.uniform(0, 0.5, shape) for _ in range(4)]
    high = [value + rng.uniform(0, 0.3, shape) for value in low]
    low, high = ([np.float32(value) for value in side] for side in (low, high))
    bounds = SampleBounds(touched, covered, low, high)
    borders = np.tile(np.linspace(1, 2, CELL_SAMPLES + 1, dtype=np.float32)[:, None], BUNDLES)
    path, none = np.ones(BUNDLES, np.float32), np.zeros(BUNDLES, np.float32)
    errors = errors_of(bounds, borders, path, path, (none, none), np.float32(relax))
    return np.asarray(errors.error), np.asarray(errors.strict), (covered | ~touched).all(0)


def test_cells_that_may_be_partly_empty_are_never_relaxed():
    error, strict, whole = found(1.0)
    assert 0 < whole.sum() < BUNDLES
    np.testing.assert_array_equal(error[:, ~whole], strict[:, ~whole])
    levels = slice(1, SUPER_PIXEL)
    assert (error[levels] <= strict[levels]).all() and (error[levels][:, whole] < strict[levels][:, whole]).any()
    np.testing.assert_array_equal(error[SUPER_PIXEL], strict[SUPER_PIXEL])


def test_without_relaxation_errors_are_strict_and_grow_with_the_level():
    error, strict, _ = found(0.0)
    np.testing.assert_array_equal(error, strict)
    assert not error[0].any() and (np.diff(error[:SUPER_PIXEL], axis=0) >= 0).all()


def exponentials(step):
    """Largest error of the exponential that marches use, in eps, over all float32 from 2^-25 to 2^7 by steps of so many."""
    exponential, worst = jax.jit(lambda thickness: jnp.exp(-thickness)), 0.0
    first, last = (int(np.float32(end).view(np.int32)) for end in (2.0**-25, 2.0**7))
    for begin in range(first, last, step << 22):
        bits = np.arange(begin, min(begin + (step << 22), last), step, dtype=np.int32)
        thickness = bits.view(np.float32)
        exact = np.exp(-thickness.astype(np.float64))
        worst = max(worst, float(np.abs(np.asarray(exponential(thickness)) - exact).max()))
    return worst / np.finfo(np.float32).eps


def test_the_exponential_is_as_exact_as_certificates_take_it_to_be():
    """Every 61st argument: certificates rest on XLA's polynomial, which may change with its version."""
    assert exponentials(61) <= EXPONENTIAL - 0.6  # the rest is for three half ulp of its argument


@pytest.mark.slow
def test_the_exponential_is_as_exact_for_every_argument_there_is():
    assert exponentials(1) <= EXPONENTIAL - 0.6
