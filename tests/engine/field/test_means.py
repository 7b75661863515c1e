"""Means over ranges of the quantity are those of the integral, to rounding, and so are their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.engine.field.means import MeanTables, integral_between, mean_light

COUNTS = (1, 2, 5, 16, 17, 150)  # fixed shapes: few compilations; on either side of `FEW`, `SELECT_ALL` and `ALL_PAIRS`
RANGES = 50  # of a program
WIDTHS = (0, 1e-7, 1e-5, 1e-3, 0.03, 0.3, 1, 3)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def means_of_many(transfer, near, far):
    tables = MeanTables.of(transfer.segments())
    return jnp.stack(mean_light(tables, near, far, slice(0, 4)), -1)


def means(transfer, near, far):
    """Of up to `RANGES` ranges, by one program for all transfer functions of as many points."""
    padded = (np.pad(end, (0, RANGES - len(end)), mode="edge") for end in (near, far))
    return np.asarray(means_of_many(transfer, *padded))[: len(near)]


def control_points(count, how, rng):
    values = np.linspace(-1, 2, count) if how == "even" else np.sort(rng.uniform(-1, 2, count))
    if how == "jumps":
        repeated = rng.integers(1, max(count, 2), 1 + count // 4)
        for k in np.sort(repeated[repeated < count]):
            values[k] = values[k - 1]
    return values.astype(np.float32).astype(np.float64)


def made(count, how, rng):
    values = control_points(count, how, rng)
    return js.TransferFunction.from_points(values, rng.uniform(0, 1, (count, 3)), rng.uniform(0, 5, count))


def ranges(values, rng, number=16):
    near = np.where(rng.uniform(size=number) < 0.3, rng.choice(values, number), rng.uniform(-1.5, 2.5, number))
    far = near + rng.choice(WIDTHS, number) * rng.uniform(-1, 1, number)
    return near.astype(values.dtype), far.astype(values.dtype)


def lines(transfer):
    """Control points between infinities, and per piece (start, width) and rows at both ends."""
    values = np.asarray(transfer.values, np.float64)
    rows = np.concatenate([transfer.colors, np.asarray(transfer.extinction)[:, None]], 1).astype(np.float64)
    return np.concatenate([[-np.inf], values, [np.inf]]), np.concatenate([rows[:1], rows, rows[-1:]])


def optics_in(edges, rows, k, q):
    """Emission and extinction of piece k at q."""
    inside = np.isfinite(edges[k]) and np.isfinite(edges[k + 1])
    part = (q - edges[k]) / (edges[k + 1] - edges[k]) if inside else 0.0
    value = rows[k] * (1 - part) + rows[k + 1] * part
    return np.append(value[:3] * value[3], value[3])


def exact(transfer, near, far):
    """Simpson's rule is exact for the quadratics of each piece."""
    edges, rows = lines(transfer)
    result = np.zeros((*near.shape, 4))
    for n, (lo, hi) in enumerate(zip(np.minimum(near, far).astype(float), np.maximum(near, far).astype(float), strict=True)):
        if lo == hi:
            result[n] = optics_in(edges, rows, np.searchsorted(edges, lo, "right") - 1, lo)
            continue
        for k in range(np.searchsorted(edges, lo, "right") - 1, np.searchsorted(edges, hi)):
            a, b = max(lo, edges[k]), min(hi, edges[k + 1])
            if a < b:
                values = [optics_in(edges, rows, k, q) for q in (a, (a + b) / 2, b)]
                result[n] += (values[0] + 4 * values[1] + values[2]) / 6 * ((b - a) / (hi - lo))
    return result


def close_by(transfer, near, far, moved):
    """Least and largest mean with ends off by some roundings of the control points: what the accuracy is stated by."""
    values = np.asarray(transfer.values, np.float64)

    def around(end):
        closest = values[np.abs(values - end[:, None]).argmin(1)]  # an extremum, maybe
        return [end - moved, end, end + moved, np.clip(closest, end - moved, end + moved)]

    ends = [(a, b) for a in around(near) for b in around(far)]
    every = np.stack([exact(transfer, *pair) for pair in ends])
    return every.min(0), every.max(0)


draws = given(count=st.sampled_from(COUNTS), how=st.sampled_from(["even", "uneven", "jumps"]), seed=st.integers(0, 10**6))


@examples(20)
@draws
def test_means_are_those_of_the_exact_integral_in_float64(count, how, seed):
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        transfer = made(count, how, rng)
        near, far = ranges(np.asarray(transfer.values), rng)
        low, high = close_by(transfer, near, far, 1e-13)
        got = means(transfer, near, far)
        assert (got >= low * (1 - 1e-13) - 1e-14).all()
        assert (got <= high * (1 + 1e-13) + 1e-14).all()


@pytest.mark.slow
@examples(20)
@draws
def test_float32_is_right_for_ends_moved_by_a_few_roundings(count, how, seed):
    rng, eps = np.random.default_rng(seed), np.finfo(np.float32).eps
    transfer = made(count, how, rng)
    near, far = ranges(np.asarray(transfer.values), rng)
    rows = lines(transfer)[1]
    largest = np.append(rows[:, :3].max(0) * rows[:, 3].max(), rows[:, 3].max())
    low, high = close_by(transfer, near.astype(float), far.astype(float), 16 * eps)
    got = means(transfer, near, far)
    assert (got >= low - 8 * eps * largest).all()
    assert (got <= high + 8 * eps * largest).all()


@examples(20)
@draws
def test_a_constant_stays_itself(count, how, seed):
    rng = np.random.default_rng(seed)
    values = np.float32(control_points(count, how, rng))
    colors, extinction = np.float32(rng.uniform(0, 1, 3)), np.float32(rng.uniform(0, 5))
    transfer = js.TransferFunction.from_points(values, np.tile(colors, (count, 1)), np.full(count, extinction))
    got = means(transfer, *ranges(values, rng)).astype(float)
    want = np.append(colors.astype(float) * extinction, extinction)
    rounded = 2 if count > 16 or count < 3 else 3  # a rounding for each piece that is met
    assert np.abs(got / want - 1).max() <= rounded * np.finfo(np.float32).eps


@pytest.mark.parametrize("count", [1, 5, 17])
@pytest.mark.parametrize("how", ["even", "uneven"])
def test_what_lies_beyond_the_control_points_counts_with_its_true_length(count, how):
    transfer = made(count, how, np.random.default_rng(1))
    near, far = np.float32([-1e30, -7, 1e30, np.inf, 3e38]), np.float32([3e30, 11, 2e30, np.inf, 3e38])
    got = means(transfer, near, far)
    near, far = np.minimum(near, np.float32(3e38)), np.minimum(far, np.float32(3e38))
    np.testing.assert_allclose(got, exact(transfer, near.astype(float), far.astype(float)), rtol=2e-6)


@pytest.mark.parametrize("count", [5, 17])
@pytest.mark.parametrize("unit", [1e-30, 1e-12, 1e12, 1e30])
def test_units_of_the_quantity_do_not_matter(count, unit):
    rng = np.random.default_rng(2)
    values, colors, extinction = control_points(count, "uneven", rng), rng.uniform(0, 1, (count, 3)), rng.uniform(0, 5, count)
    near, far = rng.uniform(-1, 2, (2, 50))
    one = means(js.TransferFunction.from_points(values, colors, extinction), np.float32(near), np.float32(far))
    other = js.TransferFunction.from_points(values * unit, colors, extinction)
    np.testing.assert_allclose(means(other, np.float32(near * unit), np.float32(far * unit)), one, rtol=1e-4)


@pytest.mark.parametrize("count", [5, 17])
def test_nan_in_gives_nan_out_and_no_crash(count):
    assert np.isnan(means(made(count, "uneven", np.random.default_rng(4)), np.float32([np.nan]), np.float32([0]))).all()


CASES = {  # of three shapes, for few programs
    "one": np.array([0.5]),
    "six": np.array([-1, -0.4, 0.1, 0.9, 1.3, 2]),
    "jumps": np.array([0, 0.3, 0.3, 0.7, 1, 1]),
    "even": np.linspace(-1, 2, 46),
    "uneven": np.sort(np.random.default_rng(1).uniform(-1, 2, 46)),
    "uneven with jumps": np.sort(np.append(np.random.default_rng(2).uniform(-1, 2, 40), [-1, -1, 0.5, 0.5, 2, 2])),
}
ARGUMENTS = ("values", "colors", "extinction", "near", "far")


def means_of(values, colors, extinction, near, far):
    tables = MeanTables.of(js.TransferFunction(values, colors, extinction).segments())
    return jnp.stack(mean_light(tables, near, far, slice(0, 4)), -1)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def pushed(given, change):
    return jax.jvp(means_of, given, change)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def pulled(given, cotangent):
    out, pull = jax.vjp(means_of, *given)
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
