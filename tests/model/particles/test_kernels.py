"""Promises of the kernels: unit integral, compact support, accuracy, one definition for NumPy and JAX."""

import functools
import itertools

import formulas
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st

from jaxsph.analysis.projection.columns import nesting
from jaxsph.model.particles import columns, kernels
from jaxsph.numerics.compiled import ratio

NODES, WEIGHTS = np.polynomial.legendre.leggauss(48)
names = pytest.mark.parametrize("name", kernels.KERNELS)


@jax.jit
def evaluated(r, support):
    """All kernels in one program, with their slopes and as functions of the square."""

    def weight(kernel, r, support):
        q = r / support
        return kernel.norm / support**3 * kernel.of_square(q * q, jnp)

    functions = {name: functools.partial(weight, kernel) for name, kernel in kernels.KERNELS.items()}
    values = {name: function(r, support) for name, function in functions.items()}
    slopes = {name: jax.grad(function)(r, support) for name, function in functions.items()}
    return values, slopes, {name: kernel.of_square(r, jnp) for name, kernel in kernels.KERNELS.items()}


def evaluate(name, r, support, dtype=np.float32):
    """The kernel, its slope, and its value at the square `r`."""
    return [np.asarray(found[name]) for found in evaluated(dtype(r), dtype(support))]


@names
def test_is_zero_at_and_beyond_the_support(name):
    assert all(evaluate(name, r, 2)[0] == 0 for r in (2.0, 2.0000002, 3.0, 1e6))


@names
@given(q=st.floats(0, 1, width=32))
def test_float32_is_within_sixteen_eps_of_the_peak(name, q):
    assert abs(evaluate(name, q, 1)[0] - formulas.KERNELS[name](q)) <= 16 * np.finfo(np.float32).eps * formulas.KERNELS[name](0)


@names
@given(square=st.floats(0, 4))
def test_is_the_same_function_in_numpy_and_jax(name, square):
    with jax.enable_x64(True):
        got = evaluate(name, square, 1, np.float64)[2]
    assert abs(got - kernels.by_name(name).of_square(np.float64(square), np)) <= 1e-15


@names
@given(part=st.floats(0, 1), rest=st.floats(0, 1), size=st.floats(1e-3, 1))
def test_a_strength_can_be_folded_into_the_lengths(name, part, rest, size):
    kernel = kernels.by_name(name)
    folded = kernel.weigh(kernel.prepare(part * size**2, size), rest * size**2, size, np)
    assert folded == pytest.approx(
        size**kernel.degree * kernel.of_square(part + rest, np), rel=1e-9, abs=1e-15 * size**kernel.degree
    )


@names
@pytest.mark.parametrize("r", [0.0, 0.5, 1.0, 1.5])
def test_gradient_is_finite_at_the_particle_at_the_edge_and_outside(name, r):
    assert np.isfinite(evaluate(name, r, 1)[1])


@names
def test_means_by_weights_have_finite_derivatives_wherever_a_support_ends(name):
    """In float32, from the outermost distance of which a weight is left inwards: what is divided by is any small number."""
    smooth = kernels.by_name(name)

    def mean(place):
        weights = [smooth.of_square((place - center) ** 2, jnp) for center in np.float32([0, 0.3])]
        return ratio(0.7 * weights[0] - 0.2 * weights[1], weights[0] + weights[1])

    place = jnp.asarray(1 - np.geomspace(1e-7, 1e-2, 400), jnp.float32) * jnp.float32([[-1], [1]])
    found, moved = jax.jvp(mean, (place,), (jnp.ones_like(place),))
    pulled = jax.vjp(mean, place)[1](jnp.ones_like(place))[0]
    assert np.isfinite(moved).all() and np.isfinite(pulled).all() and np.isfinite(found).all()


def test_unknown_kernel_lists_the_known_ones():
    with pytest.raises(ValueError, match="poly6, cubic_spline, wendland_c2"):
        kernels.by_name("gaussian")


@names
@pytest.mark.parametrize("dimensions", [1, 2, 3])
def test_has_unit_integral_in_each_dimension(name, dimensions):
    ends, total = [*kernels.by_name(name).ends, 0], 0.0
    for outer, inner in itertools.pairwise(ends):
        q = inner + (outer - inner) * (NODES + 1) / 2
        shells = kernels.AROUND[dimensions] * q ** (dimensions - 1) * kernels.by_name(name).of_square(q * q, np)
        total += (outer - inner) / 2 * (WEIGHTS @ shells)
    assert abs(kernels.by_name(name).norm_in(dimensions) * total - 1) < 1e-13


@names
def test_float32_slope_is_good_to_the_very_centre(name):
    """Pieces of splines cancel there, over a distance that is next to nothing."""
    kernel, square = kernels.by_name(name), np.geomspace(1e-14, 1, 300)
    truth = kernel.slope(kernel.prepare(square, 1.0), 0.0, 1.0, np)
    square, one = square.astype(np.float32), np.float32(1)
    found = kernel.slope(kernel.prepare(square, one), np.float32(0), one, np)
    assert found.dtype == np.float32
    assert np.abs(found - truth).max() <= 16 * np.finfo(np.float32).eps * np.abs(truth).max()


def test_a_new_kernel_is_one_entry(monkeypatch):
    """Lucy's of 1977, which is in no other file: its norm as printed, columns, what lies below a plane, and lattices."""
    monkeypatch.setitem(kernels.KERNELS, "lucy", kernels.Kernel("lucy", ((1, 3, (1, 3)),)))
    kernel, q = kernels.by_name("lucy"), np.linspace(0, 1.1, 600)
    assert kernel.norm == pytest.approx(105 / (16 * np.pi), rel=1e-15) and (kernel.degree, kernel.edge) == (4, 3)
    np.testing.assert_allclose(kernel.of_square(q * q, np), np.maximum(1 - q, 0) ** 3 * (1 + 3 * q), atol=1e-14)
    np.testing.assert_allclose(kernel.slope(kernel.prepare(q * q, 1.0), 0.0, 1.0, np), -6 * np.maximum(1 - q, 0) ** 2, atol=1e-14)
    b, t = np.array([0.0, 0.3, 0.8, 1.05]), np.sqrt(np.maximum(1 - np.array([0.0, 0.3, 0.8, 1.05]) ** 2, 0))
    along = kernel.norm * t * (kernel.of_square((b**2) + np.outer((NODES + 1) / 2, t) ** 2, np).T @ WEIGHTS)
    np.testing.assert_allclose(columns.whole_column("lucy", b**2, np), along, atol=1e-12)
    np.testing.assert_allclose(columns.whole_column("lucy", np.float32(b**2)), along, atol=1e-5 * along[0])
    assert columns.depth_share("lucy", -1.0, 0.0, np) == pytest.approx(0.5, abs=1e-14)
    assert 2 < nesting("lucy") < 30


@pytest.mark.parametrize("kernel", kernels.KERNELS.values(), ids=kernels.KERNELS)
def test_slope_is_that_of_the_kernel_and_nothing_outside(kernel):
    square, size, step = np.array([0.0, 1e-4, 0.2, 0.6, 0.95, 1.0, 1.3]) * 0.49, 0.7, 1e-7

    def of(offset):
        return kernel.weigh(kernel.prepare(square[1:-2], size), offset, size, np)

    slope = kernel.slope(kernel.prepare(square, size), 0.0, size, np)
    assert np.isfinite(slope).all() and (slope <= 0).all() and not slope[-2:].any()
    np.testing.assert_allclose(slope[1:-2], (of(step) - of(-step)) / (2 * step), rtol=1e-5)
    assert kernel.slope(kernel.prepare(np.zeros(1), 0.0), 0.0, 0.0, np) == 0  # padding
