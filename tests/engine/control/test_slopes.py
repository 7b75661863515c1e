"""Ranges are as steep as the buckets they meet, and a jump is infinitely steep where it is, and nowhere else."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.control.interpolation_error import BUCKETS, mean_square_slope, squared_slopes

RANGES = 8  # of a program


@functools.partial(jax.jit, compiler_options=QUICKLY)
def steepness_of(transfer, low, high):
    return jnp.stack(mean_square_slope(squared_slopes(transfer), low, high))


def steepness(transfer, low, high):
    """Of up to `RANGES` ranges."""
    padded = (np.pad(end, (0, RANGES - len(end)), mode="edge") for end in (low, high))
    return np.asarray(steepness_of(transfer, *padded))[:, : len(low)]


def test_mean_square_slopes_lie_between_those_of_the_range_and_of_its_buckets():
    transfer = js.TransferFunction.from_points(
        np.float32([0, 0.2, 0.5, 1]), np.float32([[0, 0, 0], [1, 0, 0], [0, 0.5, 0], [0, 1, 1]]), np.float32([0, 3, 3, 1])
    )
    low, high = np.float32([-0.5, 0.05, 0.1, 0.3, 0.9, 1.2, 0.3, -2]), np.float32([-0.1, 0.1, 0.4, 2.0, 0.9, 1.4, 0.45, 3])
    found = steepness(transfer, low, high)
    table = np.concatenate([np.asarray(transfer.colors), np.asarray(transfer.extinction)[:, None]], 1)
    steep = np.zeros((5, 4))
    steep[1:4] = np.diff(table, axis=0) / np.diff(np.asarray(transfer.values))[:, None]
    for i, (a, b) in enumerate(zip(low, high, strict=True)):
        width = 1 / BUCKETS
        least, most = (
            (steep[np.searchsorted(np.asarray(transfer.values), q, side="right")] ** 2).mean(0) * (q[-1] - q[0])
            for q in (np.linspace(a - out, max(b, a + 1e-6) + out, 40000) for out in (0, width))
        )
        extent = max(b - a, width)
        assert (found[:, i] >= least / extent * 0.995 - 1e-3).all(), i
        assert (found[:, i] <= most / extent * 1.005 + 1e-2).all(), i  # with what a difference of integrals may have lost


@pytest.mark.parametrize("values", [[0, 0.5, 0.5, 1], [0.5, 0.5], [0, 0, 0.5, 1], [0, 0.5, 1, 1]])
def test_what_holds_a_jump_is_infinitely_steep_and_what_does_not_is_not(values):
    values = np.float32(values)
    colors = np.linspace(0, 1, len(values), dtype=np.float32)[:, None] * np.ones(3, np.float32)
    transfer = js.TransferFunction.from_points(values, colors, np.float32(colors[:, 0]))
    at = values[np.flatnonzero(np.diff(values) == 0)[0]]
    low, high = np.float32([at - 0.1, at - 0.4, at + 0.1]), np.float32([at + 0.1, at - 0.1, at + 0.4])
    for channel in steepness(transfer, low, high):
        assert np.isinf(channel).tolist() == [True, False, False]
