"""Tiles and ranks that 32 bits cannot hold together are sorted by 64: the lists are the same."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.access.lists import ListPlan, build_lists
from jaxsph.engine.access.view import rank_particles, view_particles

SIDE = 4096  # pixels: 65536 tiles


@pytest.mark.slow
def test_lists_are_those_of_few_particles_however_many_more_there_is_room_for():
    rng, count, capacity = np.random.default_rng(0), 300, 1 << 17
    columns = rng.uniform(-1, 1, (count, 3)), rng.uniform(0.002, 0.02, count), rng.uniform(0, 1, count)
    camera = js.Camera.orthographic((0, 0, -3), (0, 0, 0), view_height=2.0, width=SIDE, height=SIDE, near=1.0, far=5.0)
    depths = camera.depth(jnp.arange(16, dtype=jnp.float32) + 0.5, 16)
    found = []
    for room in (count, capacity):
        particles = js.Particles.from_arrays(*columns, capacity=room)
        lists = build(particles, camera, depths)
        assert int(lists.faults) == 0
        start, end, rank = (np.asarray(value) for value in (lists.start, lists.end, lists.rank))
        found.append([rank[a:b].tolist() for a, b in zip(start, end, strict=True) if b > a])
        found.append(np.flatnonzero(end > start).tolist())
    assert found[0] == found[2] and found[1] == found[3]
    assert max(found[1]) > 4 * (1 << 15), "tiles beyond those that 32 bits hold beside a rank"


@jax.jit
def build(particles, camera, depths):
    viewed = view_particles(particles, camera, depths, 1)
    ordered = rank_particles(viewed, camera, depths, 4)
    return build_lists(ordered, camera, ListPlan(SIDE // 16, SIDE // 16, 1 << 15, 1 << 16), 0)
