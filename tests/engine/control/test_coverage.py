"""What lies in a covered voxel lies in a support, and slabs that are called covered hold no empty sample."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adversary import cameras, scenes
from examples import examples
from grids import margins
from hypothesis import given, strategies as st

from jaxsph.engine.access.compaction import compact
from jaxsph.engine.control import coverage
from jaxsph.engine.control.bounds import spheres
from jaxsph.engine.control.coverage import BITS, COARSE, FINE, MARGIN, SEGMENT, covered_slabs, covered_voxels

COUNT = 40


@functools.partial(jax.jit, static_argnames="number")
def voxels(places, counts, low, rate, fine, number):
    return covered_voxels(places, counts, low, rate, [jnp.int32(one) for one in number], fine, SEGMENT // BITS).covered


@pytest.mark.core
@pytest.mark.parametrize("kind", [FINE, COARSE])
@examples(20)
@given(
    seed=st.integers(0, 2**32 - 1),
    spread=st.sampled_from([0.0, 1.0, 6.0]),
    away=st.sampled_from([0.0, 1e3]),
    halves=st.booleans(),
)
def test_all_of_a_covered_voxel_lies_in_a_support(kind, seed, spread, away, halves):
    """Particles anywhere, and half way between the corners of voxels, as far as that can be from any."""
    rng, edges = np.random.default_rng(seed), kind[0]
    place = away + spread * rng.uniform(size=(COUNT, 3)).astype(np.float32)
    place[0] = away
    if halves:
        place = (away + np.round(place - away) + rng.choice([0.5, -0.5], place.shape) / edges).astype(np.float32)
        place[0] = place.min(0)
    counts = rng.uniform(size=COUNT) < 0.7
    counts[0] = True
    number = (64, 48, 48)
    low, rate = [np.float32(one) for one in place[counts].min(0)], np.float32(edges)
    words = np.asarray(voxels(tuple(place.T), counts, low, rate, kind is FINE, number))
    bits = np.unpackbits(words.view(np.uint8), bitorder="little")[: np.prod(number)].reshape(number[::-1])
    covered = np.argwhere(bits)[:, ::-1]
    first = np.float64(low) - MARGIN / np.float64(rate)
    corners = (covered[:, None] + np.array([*np.ndindex(2, 2, 2)])) / np.float64(rate) + first
    off = np.linalg.norm(corners[:, :, None] - np.float64(place[counts]), axis=-1).max(1).min(1)
    assert off.max() <= 1, off.max()
    # and no voxel is missing
    at_least = 184 if kind is FINE else 32
    assert len(covered) >= at_least
    if spread == 0 and not halves:
        assert len(covered) == at_least


@functools.partial(jax.jit, static_argnames="slab_samples")
def look(grid, camera, slab_samples):
    filled = compact(grid.windows.count > 0)
    return covered_slabs(grid, spheres(grid.ordered), camera, filled.item, filled.start[-1], slab_samples)


@pytest.mark.parametrize("projection", ["perspective", pytest.param("orthographic", marks=pytest.mark.slow)])
def test_covered_slabs_hold_no_empty_sample(stages, frames, projection):
    frames = frames.deep(4)
    plan = frames.plan(4)

    def holds(scene, camera):
        grid, _ = stages(scene.particles, camera, plan=plan)
        covered, rows, columns = np.asarray(look(grid, camera, 4)), np.asarray(grid.row), np.asarray(grid.column)
        inside = margins(grid.ordered, camera, np.arange(camera.height), np.arange(camera.width), plan.samples) > 0
        inside = inside.any(-1)
        for slab, bundle in np.argwhere(covered):
            row, column = rows[bundle], columns[bundle]
            assert inside[row : row + 8, column : column + 8, 4 * slab : 4 * slab + 4].all()

        return covered.sum()

    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        scene, camera = frames.scene(rng, decades=0.3, dtype=np.float64), frames.camera(rng, projection, dtype=np.float64)
        particles = dataclasses.replace(scene.particles, support=3 * np.asarray(scene.particles.support))
        assert holds(dataclasses.replace(scene, particles=particles), camera) > 20

        @examples(30)
        @given(scenes(), cameras(frames, projection))
        def holds_for_any(scene, camera):
            holds(scene, camera)

        holds_for_any()


def test_voxels_reach_no_farther_than_their_room(stages, frames, monkeypatch):
    """With room for hardly more than a frame's own voxels, slabs are covered as with plenty, or not at all."""
    frames = frames.deep(4)
    rng, plan = np.random.default_rng(0), frames.plan(4)
    scene, camera = frames.scene(rng, decades=0.3), frames.camera(rng)
    particles = dataclasses.replace(scene.particles, support=3 * np.asarray(scene.particles.support))
    grid, _ = stages(particles, camera, plan=plan)
    plenty, some = np.asarray(look(grid, camera, 4)), 0
    monkeypatch.setattr(coverage, "WORDS_AT_ONCE", 16)
    for words in range(9, 18):
        monkeypatch.setattr(coverage, "SEGMENT", 1 << words)
        monkeypatch.setattr(coverage, "FEWEST", 1 << words)
        found = np.asarray(jax.jit(lambda grid, camera: look.__wrapped__(grid, camera, 4))(grid, camera))
        assert not (found & ~plenty).any()
        some += found.any()
    assert some and plenty.any()
