"""What particles are at places is the sums of their definition, in periods and out of every support, too."""

import formulas
import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.particles import field
from jaxsph.model.particles.field import ParticleField


def sums(places, position, particles):
    """By definition: coverage, quantity and how many, of all pairs; positions as given."""
    support, volume, quantity = (particles.to_numpy()[name].astype(np.float64) for name in ("support", "volume", "quantity"))
    distance = np.linalg.norm(places[:, None] - position[None], axis=-1)
    weight = volume / support**3 * formulas.KERNELS[particles.kernel](distance / support)
    return weight.sum(1), (weight * quantity).sum(1), (distance < support).sum(1)


@pytest.mark.parametrize("kernel", ["poly6", "quintic_spline"])
def test_sums_and_slopes_are_those_of_the_definition(kernel, monkeypatch):
    monkeypatch.setattr(field, "BLOCK", 7)
    rng = np.random.default_rng(1)
    position = rng.uniform(0, 1, (60, 3))
    particles = js.Particles.from_arrays(position, rng.uniform(0.1, 0.4, 60), position[:, 0], 0.02, kernel)
    position = particles.exact_position()[:60]
    places = np.concatenate([position[:20] + rng.uniform(-0.05, 0.05, (20, 3)), [[9.0, 9, 9]]])
    found = ParticleField(particles).at(places)
    coverage, weighted, number = sums(places, position, particles)
    np.testing.assert_allclose(found.coverage, coverage, rtol=1e-5)
    np.testing.assert_array_equal(found.number, number)
    np.testing.assert_allclose(found.quantity[:-1], weighted[:-1] / coverage[:-1], rtol=1e-5)
    assert np.isnan(found.quantity[-1]) and not found.normal[-1].any()
    step = 1e-5
    for axis in range(3):
        ahead, behind = (ParticleField(particles).at(places + sign * step * np.eye(3)[axis]).coverage for sign in (1, -1))
        np.testing.assert_allclose(found.gradient[:, axis], (ahead - behind) / (2 * step), atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found.normal[:-1], axis=1), 1)
    _, which, offset = ParticleField(particles).pairs(places[:1])
    reaching = np.linalg.norm(places[0] - position, axis=1) < particles.to_numpy()["support"]
    np.testing.assert_array_equal(np.sort(which), np.flatnonzero(reaching))
    np.testing.assert_allclose(places[0] - offset, position[which], atol=1e-12)


def test_supports_reach_across_the_faces_of_a_period():
    particles = js.Particles.from_arrays(np.array([[0.05, 0.5, 0.5]]), 0.3, np.array([2.0]), 0.1, "poly6", box=(1, 1, 1))
    found = ParticleField(particles).at(np.array([[0.95, 0.5, 0.5], [0.15, 0.5, 0.5], [0.5, 0.5, 0.5]]))
    np.testing.assert_allclose(found.coverage[0], found.coverage[1], rtol=1e-6)
    np.testing.assert_allclose(found.normal[:2], [[-1, 0, 0], [1, 0, 0]], atol=1e-9)
    assert found.coverage[2] == 0 and found.number.tolist() == [1, 1, 0] and found.quantity[0] == 2


def test_of_no_particles_or_no_places_there_is_nothing():
    nobody = js.Particles.from_arrays(np.zeros((0, 3)), 0.3, np.zeros(0))
    found = ParticleField(nobody).at(np.zeros((2, 3)))
    assert not found.coverage.any() and np.isnan(found.quantity).all()
    somebody = js.Particles.from_arrays(np.zeros((1, 3)), 0.3, np.zeros(1))
    assert [len(column) for column in ParticleField(somebody).at(np.zeros((0, 3)))] == [0, 0, 0, 0]


def test_of_all_centres_some_are_taken_evenly():
    position = np.random.default_rng(1).uniform(0, 1, (60, 3))
    made = ParticleField(js.Particles.from_arrays(position, 0.2, 1.0))
    np.testing.assert_array_equal(made.at_centers(10).coverage, made.at(made.position[::6]).coverage)


def test_of_supports_that_hold_many_places_few_are_looked_at_at_once(monkeypatch):
    rng = np.random.default_rng(4)
    columns = rng.uniform(0, 1, (24, 3)), rng.uniform(0.15, 0.6, 24), rng.normal(size=24), rng.uniform(0.1, 1, 24)
    particles, points = js.Particles.from_arrays(*columns, box=(1.0, 1.2, 0.9)), rng.uniform(-0.5, 1.5, (19, 3))
    whole = (made := ParticleField(particles)).at(points)
    monkeypatch.setattr(field, "MOST_PAIRS", 40)
    blocks = made.blocks(points)
    assert 1 < len(blocks) <= len(points)
    np.testing.assert_array_equal(np.concatenate([points[block] for block in blocks]), points)
    np.testing.assert_array_equal(made.at(points).coverage, whole.coverage)
