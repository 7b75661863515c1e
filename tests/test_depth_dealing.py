"""Promises of who holds which particle: every sample finds all that reach it, and work is shared as evenly as can be."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsph.access.slab_windows import CELL_SAMPLES
from jaxsph.depth_dealing import cells_reached, dealt_particles, shared_out
from jaxsph.numerics.devices import mesh_of


@settings(max_examples=100)
@given(weight=st.lists(st.integers(0, 9), min_size=1, max_size=8), parts=st.integers(1, 8))
def test_cells_are_cut_into_ranges_of_which_the_heaviest_is_as_light_as_can_be(weight, parts):
    parts = min(parts, len(weight))
    cuts = shared_out(np.array(weight), parts)
    assert cuts[0] == 0 and cuts[-1] == len(weight) and len(cuts) == parts + 1 and (np.diff(cuts) > 0).all()

    def heaviest(cuts):
        return max(sum(weight[first:end]) for first, end in itertools.pairwise(cuts))

    every = ((0, *inner, len(weight)) for inner in itertools.combinations(range(1, len(weight)), parts - 1))
    assert heaviest(cuts) == min(map(heaviest, every))


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1), samples=st.integers(1, 70))
def test_a_particle_reaches_every_cell_with_a_sample_in_its_support(frames, projection, seed, samples):
    rng = np.random.default_rng(seed)
    particles, camera = frames.scene(rng, decades=2).particles, frames.camera(rng, projection)
    first, last = cells_reached(particles, camera, samples, 0.0)
    near, far, number = float(camera.near), float(camera.far), (np.arange(samples) + 0.5) / samples
    depths = near * (far / near) ** number if projection == "perspective" else near + (far - near) * number
    z = (particles.exact_position() - camera.exact_eye()) @ np.asarray(camera.axes, np.float64)[2]
    held = np.abs(depths - z[:, None]) < np.asarray(particles.support, np.float64)[:, None]
    cell = np.arange(samples) // CELL_SAMPLES
    assert ((first[:, None] <= cell) & (cell <= last[:, None]))[held].all()


def test_a_margin_lets_particles_move(frames):
    rng = np.random.default_rng(0)
    particles, camera = frames.scene(rng).particles, frames.camera(rng)
    near, wide = (cells_reached(particles, camera, 64, margin) for margin in (0.0, 0.3))
    moved = SimpleNamespace(
        exact_position=lambda: particles.exact_position() + 0.3 * np.asarray(camera.axes, np.float64)[2],
        support=particles.support,
        dtype=particles.dtype,
    )
    first, last = cells_reached(moved, camera, 64, 0.0)
    assert (wide[0] <= first).all() and (last <= wide[1]).all() and (wide[1] - wide[0] > near[1] - near[0]).any()


def test_a_device_holds_its_particles_and_no_others(frames):
    rng = np.random.default_rng(1)
    scene, camera = frames.scene(rng), frames.camera(rng)
    particles, parts, plan = dealt_particles(scene, camera, frames.settings, mesh_of(1), 0.0)
    first, last = cells_reached(scene.particles, camera, frames.samples, 0.0)
    seen = np.flatnonzero((first <= last) & (last >= 0) & (first < -(-frames.samples // CELL_SAMPLES)))
    valid = np.asarray(parts.valid)[0]
    np.testing.assert_array_equal(np.asarray(parts.index)[0][valid], seen)
    np.testing.assert_array_equal(np.asarray(particles.position)[0][valid], np.asarray(scene.particles.position)[seen])
    assert plan.num_particles >= particles.position.shape[1] >= len(seen)
