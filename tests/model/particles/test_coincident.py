"""Particles that share places are counted, and one a place makes the same sums."""

import dataclasses

import jax
import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.particles.coincident import one_a_place
from jaxsph.numerics.rows import distinct, share_places


def piled(scale=1.0, offset=0.0, several=True, box=None):
    rng = np.random.default_rng(0)
    which = rng.integers(0, 9, 300)
    place, support = offset + scale * rng.uniform(0, 1, (9, 3)), scale * rng.uniform(0.3, 0.6, 9)
    values = tuple(rng.normal(size=(2, 300))) if several else rng.normal(size=300)
    more = {} if box is None else {"box": box}
    return js.Particles.from_arrays(
        place[which], support[which], values, scale**3 * rng.uniform(0, 2, 300), "wendland_c2", **more
    )


@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1e-11, 0.0), (1e12, 0.0), (1.0, 1e7)])
@pytest.mark.parametrize(("several", "box"), [(True, None), (False, (2.0, 2.0, 2.0))])
def test_one_particle_a_place_has_the_same_field(scale, offset, several, box):
    whole = piled(scale, offset, several, box and tuple(scale * np.array(box)))
    one, number = one_a_place(whole)
    assert (number, one.num_particles) == (300, 9)
    points = offset + scale * np.random.default_rng(1).uniform(0, 1, (50, 3))
    for normalised in (True, False):
        wanted, found = (np.asarray(js.sample(each, points, normalised=normalised)) for each in (whole, one))
        np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5 * np.nanmax(np.abs(wanted)))


def test_particles_that_are_few_a_place_stay_as_they_are():
    rng = np.random.default_rng(2)
    particles = js.Particles.from_arrays(rng.uniform(0, 1, (60, 3)), 0.2, 0.0)
    assert one_a_place(particles) == (particles, 60)
    other = dataclasses.replace(piled(), support=jax.numpy.asarray(rng.uniform(0.1, 1, piled().capacity), np.float32))
    assert one_a_place(other)[0] is other  # of other supports


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_a_lattice_shares_no_places(scale):
    lattice = scale * np.stack(np.meshgrid(*[np.arange(12.0)] * 3), -1).reshape(-1, 3)
    assert not share_places(lattice) and share_places(np.repeat(lattice, 2, 0)) and not share_places(np.zeros((0, 3)))
    assert share_places(np.array([[0.0, 1, 2], [-0.0, 1, 2]])) and len(distinct(np.repeat(lattice, 3, 0))[0]) == 12**3


def test_the_densest_of_a_pile_is_found_at_once():
    rng = np.random.default_rng(3)
    place = np.concatenate([np.repeat(rng.uniform(0, 1, (3, 3)), 30_000, 0), rng.uniform(0, 1, (64, 3))])
    support = np.append(np.repeat([0.3, 0.01, 0.3], 30_000), np.full(64, 0.5))
    assert np.allclose(js.Particles.from_arrays(place, support, 0.0).densest(), place[30_000])
