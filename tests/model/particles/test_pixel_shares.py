"""Means of columns over pixels against quadrature."""

import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY

from jaxsph.model.particles import columns, kernels
from jaxsph.model.particles.columns import pixel_shares, side_shares

NAMES = sorted(kernels.KERNELS)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(10)


def share(name, x, y):
    """By one kernel, of one particle and bundle."""
    return pixel_shares(name, *(side_shares(name, edges[None, :, None]) for edges in (x, y)))[0, ..., 0]


def of_all(x, y):
    """By all kernels."""
    return {name: share(name, x, y) for name in NAMES}


shares = jax.jit(of_all, compiler_options=QUICKLY)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def gradients(x, y):
    """Of the share of the first pixel, where edges across move."""
    return {name: jax.grad(lambda shift, name=name: share(name, x + shift, y)[0, 0])(0.0) for name in NAMES}


def by_quadrature(name, x, y):
    """Integrals over pixels, each cut into parts that are small against the support."""
    parts = int(np.ceil((x[1] - x[0]) / 0.1))

    def points(edges):
        fine = np.interp(np.arange((len(edges) - 1) * parts + 1) / parts, np.arange(len(edges)), edges)
        half = np.diff(fine)[:, None] / 2
        return (fine[:-1, None] + half * (1 + NODES)).ravel(), (half * WEIGHTS).ravel()

    (px, wx), (py, wy) = points(x), points(y)
    values = columns.whole_column(name, py[:, None] ** 2 + px**2, np) * wy[:, None] * wx
    return values.reshape(len(y) - 1, -1, len(x) - 1, values.shape[1] // (len(x) - 1)).sum((1, 3))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("pixel", [5.0, 1.0, 0.3, 0.06])
def test_shares_are_good_to_1e_4_of_the_peak_and_add_up(name, pixel):
    rng = np.random.default_rng(3)
    number = int(2.4 / pixel) + 3
    x, y = ((np.arange(number + 1) - number / 2 + rng.uniform()) * pixel for _ in range(2))
    found = np.asarray(shares(x.astype(np.float32), y.astype(np.float32))[name], np.float64)
    truth = by_quadrature(name, x, y)
    assert np.abs(found - truth).max() <= 1e-4 * columns.whole_column(name, 0.0, np) * min(pixel**2, 1)
    assert abs(found.sum() - 1) < 3e-5 and found.min() >= 0


@pytest.mark.parametrize("name", NAMES)
def test_what_lies_outside_has_nothing(name):
    edges = np.linspace(0.8, 3.0, 4, dtype=np.float32)
    assert np.asarray(shares(edges, edges)[name]).sum() == 0


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_what_crosses_the_edges(name, x64):
    slope = gradients(np.array([-3.0, 0.3, 3.0]), np.array([-3.0, 3.0]))[name]
    at = np.linspace(-1, 1, 4001)
    crossing = np.trapezoid(columns.whole_column(name, 0.09 + at**2, np), at)
    assert abs(slope - crossing) < 1e-3
