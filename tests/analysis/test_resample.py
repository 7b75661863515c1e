"""Particles on a grid: the CSPH field at its points, and `fill` where there is none."""

from __future__ import annotations

import dataclasses
import importlib

import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.particles import kernels


def drawn(kernel, decades=1.5, count=60):
    rng = np.random.default_rng(3)
    support = 0.6 * 10 ** -rng.uniform(0, decades, count)
    volume = np.where(rng.uniform(size=count) < 0.2, 0, rng.uniform(0.1, 1, count))
    position, quantity = rng.uniform(-1, 1, (count, 3)).astype(np.float32), rng.normal(size=count)
    return js.Particles.from_arrays(position, support, quantity, volume, kernel)


def brute_force(particles, lower, spacing, shape, fill):
    points = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1) * spacing + lower
    columns = {name: value.astype(float) for name, value in particles.to_numpy().items()}
    away = np.linalg.norm(points[..., None, :] - columns["position"], axis=-1) / columns["support"]
    weight = kernels.by_name(particles.kernel).of_square(away**2, np) * columns["volume"] / columns["support"] ** 3
    total = weight.sum(-1)
    return np.where(total > 0, (weight * columns["quantity"]).sum(-1) / np.where(total > 0, total, 1), fill)


@pytest.mark.parametrize("kernel", kernels.KERNELS)
def test_values_are_those_of_all_pairs(kernel, monkeypatch):
    monkeypatch.setattr(importlib.import_module("jaxsph.model.preview.glimpse"), "PAIRS", 300)  # many chunks and runs
    particles, lower, spacing, shape = drawn(kernel), np.array([-0.9, -1.1, -0.5]), np.array([0.1, 0.15, 0.2]), (17, 12, 9)
    volume = js.resample(particles, lower, spacing, shape, fill=-9.0)
    truth = brute_force(particles, lower, spacing, shape, -9.0)
    assert volume.values.shape == shape and 0.05 < (truth == -9).mean() < 0.95
    np.testing.assert_allclose(volume.values, truth, atol=2e-6)
    np.testing.assert_allclose(volume.bounds()[0], lower)


@pytest.mark.parametrize("box", [None, (2.0, 2.0, 2.0)], ids=["free", "periodic"])
def test_a_plain_sum_of_masses_is_the_density_at_points_and_its_integral_the_mass(box):
    given = drawn("cubic_spline", decades=0.3)
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


def test_values_of_their_own_are_resampled_as_a_quantity_is():
    particles = drawn("poly6")
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
        js.resample(drawn("poly6"), **{"lower": (0, 0, 0), "spacing": 1.0, "shape": (2, 2, 2)} | changed)
