"""Column integrals of kernels, and their means over pixels, against quadrature of the kernels themselves."""

import dataclasses
import functools
import itertools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.model.particles import columns, kernels
from jaxsph.model.particles.columns import held_by, pixel_shares, side_shares

NAMES = sorted(kernels.KERNELS)
NODES, WEIGHTS = np.polynomial.legendre.leggauss(48)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def found_at(square):
    """Of all kernels, whole columns and those between ends beyond them."""
    return {name: (columns.whole_column(name, square), columns.column_between(name, square, -2.0, 2.0)) for name in NAMES}


@functools.partial(jax.jit, compiler_options=QUICKLY)
def curvatures_at(square):
    """Of all kernels."""
    return {name: columns.curvature(name, square) for name in NAMES}


@functools.partial(jax.jit, compiler_options=QUICKLY)
def slopes_at(b, start, end):
    """Of whole columns by the distance, and of those between ends by both ends."""
    whole = {name: jax.grad(lambda b, name=name: columns.whole_column(name, b * b))(b) for name in NAMES}
    between = {name: functools.partial(columns.column_between, name) for name in NAMES}
    return whole, {name: jax.grad(function, (1, 2))(b * b, start, end) for name, function in between.items()}


def quadrature(name, b, start, end):
    """Integral of the kernel along a ray, split at the foot and where the kernel has kinks."""
    kernel, total = kernels.by_name(name), 0.0
    rings = [np.sqrt(max(c * c - b * b, 0)) for c in kernel.ends]
    breaks = sorted({start, end, *(t for t in (0, *rings, *(-r for r in rings)) if start < t < end)})
    for low, high in itertools.pairwise(breaks):
        t = (low + high) / 2 + (high - low) / 2 * NODES
        total += (high - low) / 2 * (WEIGHTS * kernel.norm * kernel.of_square(b * b + t * t, np)).sum()
    return total


@pytest.mark.core
@pytest.mark.parametrize("name", NAMES)
@given(b=st.one_of(st.floats(0, 1.1), st.sampled_from([0.0, 1e-9, 0.5, 1.0])), ends=st.tuples(*[st.floats(-1.5, 1.5)] * 2))
@examples(60)
def test_integrals_are_those_of_the_kernel_to_1e_10(name, b, ends):
    start, end = sorted(ends)
    truth, peak = quadrature(name, b, start, end), columns.whole_column(name, np.float64(0), np)
    assert abs(columns.column_between(name, np.float64(b * b), start, end, np) - truth) <= 1e-10 * peak
    assert abs(columns.whole_column(name, np.float64(b * b), np) - quadrature(name, b, -2.0, 2.0)) <= 1e-10 * peak


@pytest.mark.parametrize("name", NAMES)
def test_single_precision_is_good_to_1e_5_of_the_peak_and_never_negative(name):
    square = np.linspace(0, 1.05, 4001, dtype=np.float32) ** 2
    truth = columns.whole_column(name, square.astype(np.float64), np)
    for found in map(np.asarray, found_at(square)[name]):
        assert np.abs(found - truth).max() <= 1e-5 * truth.max()
        assert found.min() >= 0 and (found[square >= 1] == 0).all()


@pytest.mark.parametrize("name", NAMES)
def test_a_mean_over_a_sixteenth_of_a_support_is_that_of_the_middle_and_the_curvature_to_1e_4_of_the_peak(name):
    at = (np.stack(np.meshgrid(NODES, NODES), -1) / 2).reshape(-1, 2) / 16
    weight = np.outer(WEIGHTS, WEIGHTS).ravel() / 4
    middle = np.stack([np.linspace(0, 1.05, 200), np.linspace(0, 0.2, 200)], -1)
    truth = columns.whole_column(name, ((middle[:, None] + at) ** 2).sum(-1), np) @ weight
    square = (middle**2).sum(-1)
    found = columns.whole_column(name, square, np) + np.asarray(curvatures_at(square)[name]) / 16**2 / 24
    assert np.abs(found - truth).max() < 1e-4 * columns.whole_column(name, np.float64(0), np)


@pytest.mark.parametrize("name", NAMES)
def test_the_column_has_unit_integral_over_the_plane_and_so_have_all_depths(name):
    b = (NODES + 1) / 2
    b, weight = np.concatenate([b / 2, (1 + b) / 2]), np.tile(WEIGHTS / 4, 2)
    assert abs((2 * np.pi * b * columns.whole_column(name, b**2, np) * weight).sum() - 1) < 1e-6
    assert abs(columns.depth_share(name, -2.0, 2.0, np) - 1) < 1e-12
    near, far = columns.depth_share(name, -1.0, 0.3, np), columns.depth_share(name, 0.3, 1.0, np)
    assert abs(near + far - 1) < 1e-12
    between = (2 * np.pi * b * columns.column_between(name, b**2, -1.0, 0.3, np) * weight).sum()
    assert abs(between - near) < 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_float32_shares_of_depths_are_good_to_rounding(name):
    """To that of a polynomial whose terms are tens of times its sum."""
    ends = np.sort(np.random.default_rng(4).uniform(-1.2, 1.2, (2, 1000)).astype(np.float32), 0)
    found, truth = (columns.depth_share(name, *given, np) for given in (ends, ends.astype(np.float64)))
    assert found.dtype == np.float32 and np.abs(found - truth).max() <= 64 * np.finfo(np.float32).eps


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_finite_and_those_of_differences(name, x64):
    for b in (0.0, 0.2, 0.5, 0.9, 1.0, 1.1):
        slope = float(slopes_at(b, -0.2, 0.4)[0][name])
        step = 1e-6
        ends = (columns.whole_column(name, np.float64(b + side) ** 2, np) for side in (step, -step))
        assert abs(slope - (next(ends) - next(ends)) / (2 * step)) < 1e-5
    for b in (0.0, 0.3, 0.7):
        for found, at, sign in zip(map(float, slopes_at(b, -0.2, 0.4)[1][name]), (-0.2, 0.4), (-1, 1), strict=True):
            assert abs(found - sign * kernels.by_name(name).norm * kernels.by_name(name).of_square(b * b + at * at, np)) < 1e-9


PLACES, SHARES = np.polynomial.legendre.leggauss(10)


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
        return (fine[:-1, None] + half * (1 + PLACES)).ravel(), (half * SHARES).ravel()

    (px, wx), (py, wy) = points(x), points(y)
    values = columns.whole_column(name, py[:, None] ** 2 + px**2, np) * wy[:, None] * wx
    return values.reshape(len(y) - 1, -1, len(x) - 1, values.shape[1] // (len(x) - 1)).sum((1, 3))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("pixel", "number"), [(5.0, 3), (1.0, 11), (0.3, 11), (0.06, 43)])  # a program for each number
def test_shares_are_good_to_1e_4_of_the_peak_and_add_up(name, pixel, number):
    rng = np.random.default_rng(3)
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


def test_a_number_a_particle_goes_to_those_that_are_there_wherever_others_are_left_out():
    given = js.Particles.from_arrays(np.eye(3), 1.0, [1.0, 2, 3])
    particles = dataclasses.replace(given, valid=given.valid.at[1].set(False))
    wide = np.pad([1.0, np.nan, 3.0], (0, particles.capacity - 3), constant_values=np.nan)
    for of in (np.array([1.0, 3.0]), wide):
        held = held_by(particles, of, None)
        np.testing.assert_array_equal(np.ldexp(held.amounts[:3, 0], held.exponents[0]), [1, 0, 3])
    with pytest.raises(ValueError, match=r"`of` must be finite, but 1 of .* of\[2\] = inf"):
        held_by(particles, np.where(np.arange(particles.capacity) == 2, np.inf, wide), None)
