"""Prepared particles are the same particles, and so are their images and derivatives."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

import jaxsph as js


def mixed_up(particles, seed=0):
    """The same entries in any order, so that padding lies among particles."""
    order = np.random.default_rng(seed).permutation(particles.capacity)
    return particles.at(order)


def rows(particles):
    """What each particle is, in an order of its own."""
    columns = particles.to_numpy()
    table = np.column_stack([columns["position"], columns["support"], columns["quantity"], columns["volume"]])
    return table[np.lexsort(table.T)]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_prepared_particles_are_the_same_and_come_before_the_padding(frames, dtype):
    with jax.enable_x64(dtype == np.float64):
        scene = frames.scene(np.random.default_rng(0), decades=3, count=17, dtype=dtype)
        prepared = js.prepare(mixed_up(scene.particles))
        assert prepared.dtype == dtype and prepared.kernel == scene.particles.kernel
        assert np.asarray(prepared.valid).tolist() == [True] * 17 + [False] * (frames.capacity - 17)
        np.testing.assert_array_equal(rows(prepared), rows(scene.particles))
        again = js.prepare(prepared)
        jax.tree.map(np.testing.assert_array_equal, again, prepared)


def test_what_positions_lost_to_rounding_goes_with_its_particle(frames):
    position = 1e4 + np.random.default_rng(0).uniform(0, 1, (20, 3))
    particles = js.Particles.from_arrays(position, 0.01, np.arange(20.0), capacity=frames.capacity)
    prepared = js.prepare(particles)
    order = np.asarray(prepared.quantity)[:20].astype(int)
    np.testing.assert_array_equal(prepared.exact_position()[:20], particles.exact_position()[order])


def test_neighbours_in_memory_are_neighbours_in_space():
    position = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    particles = js.Particles.from_arrays(position, 0.1, 0.0)
    apart = [
        np.linalg.norm(np.diff(one.to_numpy()["position"], axis=0), axis=1).mean() for one in (js.prepare(particles), particles)
    ]
    assert apart[0] < apart[1] / 5


@pytest.mark.parametrize("position", [np.zeros((0, 3)), np.ones((1, 3)), np.full((5, 3), 3e38), [[-3e38] * 3, [3e38] * 3]])
def test_any_box_has_an_order(frames, position):
    particles = js.Particles.from_arrays(position, 1.0, 0.0, capacity=frames.capacity)
    np.testing.assert_array_equal(rows(js.prepare(particles)), rows(particles))


def test_derivatives_go_back_to_the_particles_given(frames):
    particles = mixed_up(frames.scene(np.random.default_rng(0), count=17).particles)
    prepared, pull = jax.vjp(lambda position, quantity: columns_of(particles, position, quantity), *columns_of_given(particles))
    for given, of_given, found in zip(columns_of_given(particles), pull(prepared), prepared, strict=True):
        np.testing.assert_array_equal(of_given, given)
        assert not np.array_equal(found, given)


def columns_of_given(particles):
    return particles.position, particles.quantity


def columns_of(particles, position, quantity):
    return columns_of_given(js.prepare(dataclasses.replace(particles, position=position, quantity=quantity)))
