"""Promises of the tables that means are read from."""

import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.lookups.tables import MeanTables, integral_between


@functools.partial(jax.jit, compiler_options=QUICKLY)
def extinction_between(transfer, first, last):
    return integral_between(MeanTables.of(transfer.segments()), 3, first, last)


@pytest.mark.parametrize("count", [40, 200])
def test_a_huge_integral_before_does_not_spoil_those_behind(count):
    extinction = np.full(count, 0.1)
    extinction[3] = 1e9
    values = np.linspace(0.5, 0.99, count) ** 2
    transfer = js.TransferFunction.from_points(values, np.zeros((count, 3)), extinction)
    got = extinction_between(transfer, np.arange(10, 20), np.arange(12, 22))
    values = np.asarray(transfer.values, np.float64)
    before = 1e9 * (values[4] - values[2]) / 2
    lost = count * np.finfo(np.float32).eps ** 2 * before
    np.testing.assert_allclose(got, 0.1 * (values[12:22] - values[11:21]), rtol=1e-6, atol=lost)
