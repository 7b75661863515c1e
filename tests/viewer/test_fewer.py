"""A draft of many particles is made of fewer, which sum up to what all do; it says so, and the full picture has all."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from views import SETTINGS, camera, scene

import jaxsph as js
from jaxsph.model.particles.kernels import by_name
from jaxsph.viewer import stages as module
from jaxsph.viewer.picture import described
from jaxsph.viewer.stages import stages_of


@pytest.fixture(autouse=True)
def most(monkeypatch):
    monkeypatch.setattr(module, "MOST", 1000)


def uniform(count, box=None):
    rng = np.random.default_rng(1)
    position = rng.uniform(0, 1, (count, 3)).astype(np.float32)
    return js.Particles.from_arrays(position, np.float32(0.3), position[:, 0], np.float32(1 / count), box=box)


def test_few_particles_are_left_as_they_are():
    particles = uniform(1000)
    assert module.fewer(particles) is particles


def test_sums_of_fewer_particles_are_those_of_all_on_average():
    particles = uniform(8000)
    few = module.fewer(particles)
    assert few.num_particles == 1000 and np.asarray(few.volume).sum() == pytest.approx(1, rel=1e-5)
    np.testing.assert_allclose(few.support, 0.6, rtol=1e-5)
    inside = np.abs(np.asarray(few.position) - 0.5).max(1) < 0.1
    assert np.asarray(few.position)[inside].mean() == pytest.approx(0.5, abs=0.05)
    for one in (particles, few):
        kernel, support = by_name("poly6"), np.asarray(one.support)
        distance = np.linalg.norm(np.asarray(one.position) - 0.5, axis=1)
        weight = np.asarray(one.volume) * kernel.norm * kernel.of_square((distance / support) ** 2, np) / support**3
        assert weight.sum() == pytest.approx(1, abs=0.1)


def test_in_a_periodic_set_no_support_is_longer_than_it_was():
    particles = uniform(2000, box=(1.0, 1.0, 1.0))
    assert np.asarray(module.fewer(particles).support).max() == np.asarray(particles.support).max()


def test_a_draft_says_how_many_particles_it_leaves_out_and_the_full_picture_has_all(monkeypatch):
    monkeypatch.setattr(module, "MOST", 20)
    shown, seen = scene(), camera()
    draft, full = stages_of(SETTINGS, seen)
    assert full.shown(shown) is shown and draft.shown(shown).particles.num_particles == 20
    assert draft.shown(dataclasses.replace(shown)).particles is draft.shown(shown).particles
    image = js.reference.render(shown, draft.camera(seen), SETTINGS)
    assert described(draft, image, shown, seen, 0.0)[0].endswith(f"rays left, and {shown.particles.num_particles - 20} particles")
