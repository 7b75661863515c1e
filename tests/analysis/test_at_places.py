"""What particles are at places is the sums of their definition, in periods and out of every support, too."""

import dataclasses
import functools
import importlib
import itertools

import formulas
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.particles import kernels

SIDES = np.array([1.0, 1.2, 0.9])
WAYS = pytest.mark.parametrize(
    ("of", "normalised"),
    [(None, True), ("masses", True), (None, False), ("masses", False)],
    ids=["field", "mean", "C", "density"],
)


def drawn(box=None, dtype=np.float64, origin=0.0, size=1.0):
    """Particles whose supports are up to most of a period, points of which some are outside, and masses."""
    rng = np.random.default_rng(4)
    position, support = origin + size * rng.uniform(0, 1, (24, 3)) * SIDES, size * rng.uniform(0.15, 0.6, 24)
    columns = [column.astype(dtype) for column in (support, rng.normal(size=24), rng.uniform(0.1, 1, 24))]
    particles = js.Particles.from_arrays(position, *columns, "wendland_c4", box=box)
    return particles, origin + size * rng.uniform(-0.5, 1.5, (19, 3)), rng.uniform(1, 3, 24)


def brute_force(particles, points, of, normalised):
    """Of all pairs and all images in float64."""
    columns = {name: column.astype(np.float64) for name, column in particles.to_numpy().items()}
    sides = 0 if particles.box is None else np.subtract(*particles.box.corners()[::-1])
    turns = [(0, 0, 0)] if particles.box is None else itertools.product(range(-3, 4), repeat=3)
    away = points[:, None] - particles.exact_position()[: len(columns["support"])]
    distance = (np.linalg.norm(away + np.array(turn) * sides, axis=-1) / columns["support"] for turn in turns)
    weight = sum(formulas.KERNELS[particles.kernel](np.minimum(one, 1)) for one in distance) / columns["support"] ** 3
    held = columns["quantity" if normalised else "volume"] if of is None else of
    with np.errstate(invalid="ignore"):
        weighted = weight * columns["volume"]
        return (weighted @ held) / weighted.sum(1) if normalised else weight @ held


@functools.partial(jax.jit, static_argnames="normalised")
def within_jit(particles, points, of, normalised):
    return js.sample(particles, points, of, normalised)


@WAYS
@pytest.mark.parametrize("box", [None, SIDES], ids=["free", "periodic"])
def test_samples_are_the_sums_of_their_definition_eagerly_and_within_jit(x64, of, normalised, box):
    particles, points, masses = drawn(box)
    of = masses if of else None
    truth = brute_force(particles, points, of, normalised)
    assert box is not None or 0 < (np.isnan(truth) | (truth == 0)).sum() < len(points)
    for found in (js.sample(particles, points, of, normalised), within_jit(particles, points, of, normalised)):
        assert found.dtype == np.float64
        np.testing.assert_allclose(found, truth, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("normalised", [True, False])
@pytest.mark.parametrize("box", [None, SIDES], ids=["free", "periodic"])
def test_derivatives_by_all_that_a_sample_is_made_of_are_those_of_differences(x64, normalised, box):
    particles, points, masses = drawn(box)
    rng = np.random.default_rng(5)

    def total(position, support, of, points):
        found = js.sample(dataclasses.replace(particles, position=position, support=support), points, of, normalised)
        return jnp.where(jnp.isnan(found), 0, found) @ shares

    shares = jnp.asarray(rng.normal(size=len(points)))
    given = particles.position, particles.support, jnp.asarray(masses), jnp.asarray(points)
    move = [rng.normal(size=one.shape) for one in given]
    ahead, behind = (float(total(*(a + sign * 1e-6 * b for a, b in zip(given, move, strict=True)))) for sign in (1, -1))
    by_pairs, by_all = (how(jax.grad(total, (0, 1, 2, 3)))(*given) for how in (lambda one: one, jax.jit))
    slope = sum(float((one * other).sum()) for one, other in zip(by_pairs, move, strict=True))
    np.testing.assert_allclose(slope, (ahead - behind) / 2e-6, rtol=1e-6)
    for one, other in zip(by_pairs, by_all, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("given", [{"origin": 3e5, "size": 0.01}, {"size": 1e20}], ids=["far", "large"])
def test_low_digits_of_far_positions_count_and_lengths_need_no_cube_in_float32(given):
    particles, points, masses = drawn(dtype=np.float32, **given)
    assert particles.dtype == np.float32 and (particles.position_rest is None) == ("origin" not in given)
    masses = np.float32(masses * given["size"] ** 1.5)
    truth = brute_force(particles, points, masses, False)
    by_pairs, pull = jax.vjp(lambda masses: js.sample(particles, points, masses, False), jnp.float32(masses))
    by_all = jax.jit(lambda particles, masses: js.sample(particles, points, masses, False))(particles, masses)
    for found in (js.sample(particles, points, masses, False), by_all, by_pairs):
        np.testing.assert_allclose(found, truth, rtol=2e-5, atol=2e-6 * truth.max())
    shares = jnp.full(19, 1 / truth.max(), np.float32)
    np.testing.assert_allclose(masses @ pull(shares)[0], truth.sum() / truth.max(), rtol=1e-5)


def test_a_batch_of_points_is_that_many_samples():
    particles, points, _ = drawn(SIDES, np.float32)
    points = np.float32(points[:18].reshape(2, 9, 3))
    found = jax.vmap(lambda some: js.sample(particles, some))(points)
    np.testing.assert_allclose(found, [js.sample(particles, some) for some in points], atol=1e-5)


@pytest.mark.parametrize("normalised", [True, False])
def test_of_no_particles_samples_are_nothing_and_of_no_points_there_are_none(normalised):
    nobody, somebody = js.Particles.from_arrays(np.zeros((0, 3)), 0.3, np.zeros(0)), drawn(None, np.float32)[0]
    for how in (js.sample, within_jit):
        np.testing.assert_array_equal(how(nobody, np.zeros((2, 3)), None, normalised), [np.nan if normalised else 0] * 2)
        assert how(somebody, np.zeros((0, 3)), None, normalised).shape == (0,)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"points": np.zeros(3)}, r"`points` must have shape \(N, 3\), got \(3,\)"),
        ({"points": [[0, np.nan, 0]]}, r"`points` must be finite, but 1 of 3 are not, first points\[0, 1\]"),
        ({"points": [["a", "b", "c"]]}, "`points` must hold real numbers"),
        ({"of": np.ones(3)}, r"`of` must have shape \(24,\)"),
        ({"of": "mass"}, "`of` must be 'volume' or 'quantity'"),
        ({"of": np.full(24, 1e43)}, "`of` makes 1e[+]43, and float32 ends at 3.4e[+]38"),
        ({"particles": None}, "`particles` must be a `jaxsph.Particles`, got None of type NoneType"),
    ],
)
def test_what_cannot_be_sampled_is_refused_by_name(changed, said):
    particles, _, _ = drawn(None, np.float32)
    with pytest.raises(ValueError, match=said):
        js.sample(**{"particles": particles, "points": np.full((1, 3), 0.5)} | changed)


def test_particles_that_are_no_numbers_are_refused_and_not_left_out():
    particles, points, _ = drawn(None, np.float32)
    broken = dataclasses.replace(particles, position=particles.position.at[3, 1].set(np.nan))
    with pytest.raises(ValueError, match=r"`position` must be finite, but 1 of 72 are not, first position\[3, 1\]"):
        js.sample(broken, points)
    with pytest.raises(ValueError, match=r"`support` must be > 0, but support\[0\]"):
        jax.grad(lambda support: js.sample(dataclasses.replace(particles, support=support), points).sum())(-particles.support)


def test_points_in_another_unit_are_converted_and_those_that_cannot_be_are_refused():
    units = pytest.importorskip("astropy.units")
    particles, points, _ = drawn(None, np.float32)
    in_km = js.Particles.from_arrays(np.asarray(particles.position) * units.km, particles.support, particles.quantity)
    plain = js.Particles.from_arrays(particles.position, particles.support, particles.quantity)
    np.testing.assert_allclose(js.sample(in_km, points * 1000 * units.m), js.sample(plain, points), rtol=1e-6)
    with pytest.raises(ValueError, match="`points` is in s, which cannot be converted to km"):
        js.sample(in_km, points * units.s)


def scattered(kernel, decades=1.5, count=60):
    rng = np.random.default_rng(3)
    support = 0.6 * 10 ** -rng.uniform(0, decades, count)
    volume = np.where(rng.uniform(size=count) < 0.2, 0, rng.uniform(0.1, 1, count))
    position, quantity = rng.uniform(-1, 1, (count, 3)).astype(np.float32), rng.normal(size=count)
    return js.Particles.from_arrays(position, support, quantity, volume, kernel)


def grid_of_all_pairs(particles, lower, spacing, shape, fill):
    points = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1) * spacing + lower
    columns = {name: value.astype(float) for name, value in particles.to_numpy().items()}
    away = np.linalg.norm(points[..., None, :] - columns["position"], axis=-1) / columns["support"]
    weight = kernels.by_name(particles.kernel).of_square(away**2, np) * columns["volume"] / columns["support"] ** 3
    total = weight.sum(-1)
    return np.where(total > 0, (weight * columns["quantity"]).sum(-1) / np.where(total > 0, total, 1), fill)


@pytest.mark.parametrize("kernel", kernels.KERNELS)
def test_values_are_those_of_all_pairs(kernel, monkeypatch):
    monkeypatch.setattr(importlib.import_module("jaxsph.model.particles.field"), "PAIRS", 300)  # many chunks and runs
    particles, lower, spacing, shape = scattered(kernel), np.array([-0.9, -1.1, -0.5]), np.array([0.1, 0.15, 0.2]), (17, 12, 9)
    volume = js.resample(particles, lower, spacing, shape, fill=-9.0)
    truth = grid_of_all_pairs(particles, lower, spacing, shape, -9.0)
    assert volume.values.shape == shape and 0.05 < (truth == -9).mean() < 0.95
    np.testing.assert_allclose(volume.values, truth, atol=2e-6)
    np.testing.assert_allclose(volume.bounds()[0], lower)


@pytest.mark.parametrize("box", [None, (2.0, 2.0, 2.0)], ids=["free", "periodic"])
def test_a_plain_sum_of_masses_is_the_density_at_points_and_its_integral_the_mass(box):
    given = scattered("cubic_spline", decades=0.3)
    columns = {name: column for name, column in given.to_numpy().items() if name != "position"}
    particles = js.Particles.from_arrays(given.to_numpy()["position"] + 1, **columns, kernel=given.kernel, box=box)
    masses = np.random.default_rng(7).uniform(1e25, 3e25, 60)
    lower, spacing, count = (0.025, 0.05, 40) if box else (-0.6, 0.05, 65)
    volume = js.resample(particles, (lower,) * 3, spacing, (count,) * 3, of=masses, normalised=False, fill=-1.0)
    values = np.asarray(volume.values, np.float64)
    np.testing.assert_allclose(values.sum() * spacing**3, masses.sum(), rtol=1e-3)
    chosen = np.random.default_rng(8).integers(0, count, (50, 3))
    truth = js.sample(particles, lower + spacing * chosen, masses, normalised=False)
    np.testing.assert_allclose(values[tuple(chosen.T)], truth, rtol=1e-5, atol=1e-6 * values.max())
    assert (values == 0).any() or box
    less = js.resample(particles, (lower,) * 3, spacing, (count,) * 3, of=-masses, normalised=False, fill=1.0)
    np.testing.assert_array_equal(less.values, -values.astype(np.float32))  # amounts may be of either sign
    np.testing.assert_array_equal(js.sample(particles, lower + spacing * chosen, -masses, normalised=False), -truth)


def test_values_of_their_own_are_resampled_as_a_quantity_is():
    particles = scattered("poly6")
    values = np.random.default_rng(9).normal(size=60)
    carried = dataclasses.replace(particles, quantity=np.pad(np.float32(values), (0, particles.capacity - 60)))
    grid = (-0.9, -0.9, -0.9), 0.2, (9, 9, 9)
    found, expected = js.resample(particles, *grid, of=values), js.resample(carried, *grid)
    np.testing.assert_array_equal(found.values, expected.values)


def test_nothing_is_fill_everywhere():
    nobody = js.Particles.from_arrays(np.zeros((0, 3)), 1.0, 1.0)
    assert (np.asarray(js.resample(nobody, (0, 0, 0), 1.0, (2, 3, 2), fill=5.0).values) == 5).all()


def test_a_constant_stays_that_constant():
    particles = js.Particles.from_arrays(np.random.default_rng(0).uniform(0, 1, (50, 3)), 0.4, 0.7)
    values = np.asarray(js.resample(particles, (0, 0, 0), 0.1, (11, 11, 11), fill=0.7).values)
    np.testing.assert_array_equal(values, np.float32(0.7))


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"shape": (2, 1, 2)}, r"`shape` must be three integers of at least 2, got \(2, 1, 2\)"),
        ({"spacing": 0.0}, "`spacing` must be > 0"),
        ({"spacing": (1, 2)}, r"`spacing` must have shape \(\) or \(3,\), got \(2,\)"),
        ({"lower": (0, 0, np.nan)}, "`lower` must be finite"),
        ({"fill": np.inf}, "`fill` must be finite"),
    ],
)
def test_what_is_no_grid_is_refused_by_name(changed, match):
    with pytest.raises(ValueError, match=match):
        js.resample(scattered("poly6"), **{"lower": (0, 0, 0), "spacing": 1.0, "shape": (2, 2, 2)} | changed)
