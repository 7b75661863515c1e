"""A draft of many particles is made of fewer, which sum up to what all do; it says so, and the full picture has all."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from views import SETTINGS, camera, scene

import jaxsph as js
from jaxsph.model.particles.kernels import by_name
from jaxsph.viewer import stages as module
from jaxsph.viewer.stages import described, stages_of


def uniform(count, box=None):
    rng = np.random.default_rng(1)
    position = rng.uniform(0, 1, (count, 3)).astype(np.float32)
    return js.Particles.from_arrays(position, np.float32(0.3), position[:, 0], np.float32(1 / count), box=box)


def test_few_particles_are_left_as_they_are():
    particles = uniform(1000)
    assert module.fewer(particles, 1000) is particles


@pytest.mark.parametrize("smoothing", [1.0, 1.5])
def test_sums_of_fewer_particles_are_those_of_all_on_average_and_their_means_those_of_all(smoothing):
    particles = uniform(8000)
    few = module.fewer(particles, 1000, smoothing)
    columns = {name: np.asarray(column, np.float64)[np.asarray(few.valid)] for name, column in few.columns.items()}
    assert 500 < len(few) <= 1000 and columns["volume"].sum() == pytest.approx(1, rel=1e-5)
    mean = columns["volume"] @ columns["position"]
    np.testing.assert_allclose(mean, np.asarray(particles.position)[np.asarray(particles.valid)].mean(0), rtol=1e-4)
    assert columns["volume"] @ columns["quantity"] == pytest.approx(mean[0], rel=1e-4)
    for one in (particles, few):
        kernel, support = by_name("poly6"), np.asarray(one.support)
        distance = np.linalg.norm(np.asarray(one.position) - 0.5, axis=1)
        weight = np.asarray(one.volume) * kernel.norm * kernel.of_square((distance / support) ** 2, np) / support**3
        assert weight.sum() == pytest.approx(1, abs=0.1)


def test_one_that_is_alone_stays_where_it_is_and_as_large():
    inside = np.random.default_rng(1).uniform(0, 1, (4000, 3))
    position = np.concatenate([inside, [(3, 0, 0), (5, 1, 0), (1e4, 0, 0)]]).astype(np.float32)
    few = module.fewer(js.Particles.from_arrays(position, np.float32(0.1), np.arange(4003), np.float32(2)), 1000)
    alone = np.asarray(few.position)[:, 0] > 2
    assert len(few) <= 1000 and alone.sum() == 3
    order = np.argsort(np.asarray(few.position)[alone, 0])
    for name, expected in {"position": position[-3:], "support": 0.1, "quantity": [4000, 4001, 4002], "volume": 2}.items():
        np.testing.assert_allclose(np.asarray(getattr(few, name))[alone][order], expected, rtol=1e-6)


def test_places_of_float64_and_second_quantities_stay_and_volumes_of_nothing_are_no_matter():
    position = 1e6 + np.random.default_rng(0).uniform(0, 1, (3000, 3))
    given = js.Particles.from_arrays(position, 0.1, (position[:, 0], np.arange(3000.0)), np.zeros(3000))
    few = module.fewer(given, 500)
    some = np.asarray(few.valid)
    assert few.position_rest is not None and few.capacity < given.capacity and not np.asarray(few.volume).any()
    assert few.exact_position()[some].mean() == pytest.approx(1e6 + 0.5, abs=0.02)
    assert np.asarray(few.extinction_quantity)[some].mean() == pytest.approx(1500, rel=0.1)


def test_in_a_periodic_set_no_support_is_longer_than_it_was():
    particles = uniform(2000, box=(1.0, 1.0, 1.0))
    assert np.asarray(module.fewer(particles, 1000).support).max() == np.asarray(particles.support).max()


def test_a_draft_says_how_many_particles_it_leaves_out_and_the_full_picture_has_all(monkeypatch):
    monkeypatch.setattr(module, "MOST", 20)
    shown, seen = scene(), camera()
    draft, full = stages_of(SETTINGS, seen)
    few = draft.shown(shown).particles
    assert full.shown(shown) is shown and few.num_particles <= 20
    assert draft.shown(dataclasses.replace(shown)).particles is few
    image, left = js.reference.render(shown, draft.camera(seen), SETTINGS), shown.particles.num_particles - few.num_particles
    assert described(draft, image, shown, seen, 0.0)[0].endswith(f"rays left, and {left} particles")
