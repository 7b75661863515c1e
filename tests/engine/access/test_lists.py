"""Lists hold what every ray of a bundle can meet: of cameras whose rays go through every so many pixels, and of many tiles."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.engine.access.lists import BUNDLE, ListPlan, build_lists, nodes_between
from jaxsph.engine.access.view import rank_particles, view_particles
from jaxsph.engine.frame.stages import grid_of, ordered_of
from jaxsph.engine.planning.viewing import view_scene
from jaxsph.engine.runtime.executors import Eager
from jaxsph.engine.runtime.tuning import CPU
from jaxsph.engine.screen.canvas import places
from jaxsph.model.camera.camera import num_nodes

SIZE, STRIDE, SAMPLES = {"width": 45, "height": 38, "samples": 24}, 4, 24


@given(st.integers(1, 80), st.sampled_from([1, 2, 4, 8, 16]), st.integers(0, 80), st.integers(-1, 79))
def test_nodes_of_a_range_of_pixels_are_those_that_lie_in_it(size, stride, first, last):
    first, last = min(first, size), min(last, size - 1)
    begin, end = nodes_between(first, last, size, stride)
    inside = [node for node, pixel in enumerate(places(size, stride)) if first <= pixel <= last]
    assert list(range(begin, end + 1)) == inside
    assert not inside or inside[-1] < num_nodes(size, stride)


def members(grid):
    """Ranks of the particles of each bundle."""
    lists = (np.asarray(value) for value in (grid.lists.rank, grid.lists.start, grid.lists.end))
    rank, start, end = lists
    return [set(rank[a:b].tolist()) for a, b in zip(start, end, strict=True)]


@pytest.mark.usefixtures("quick_programs")
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@given(seed=st.integers(0, 2**32 - 1), decades=st.sampled_from([1.0, 4.0]), distance=st.sampled_from([3.0, 0.8, 0.0001]))
def test_no_ray_through_a_node_misses_a_particle(frames, projection, seed, decades, distance):
    rng = np.random.default_rng(seed)
    shape = dataclasses.replace(frames, **SIZE)
    scene, camera = shape.scene(rng, decades=decades), shape.camera(rng, projection, distance)
    seen, strided = (
        view_scene(scene, camera, samples=SAMPLES, capacity=scene.particles.capacity, num_classes=3),
        camera.strided(STRIDE),
    )
    lists, run, found = ListPlan(1, 1, 2 * frames.capacity, 4 * frames.capacity), Eager(), []
    for tuning in (CPU, dataclasses.replace(CPU, sorts_on_host=False)):
        ordered = ordered_of(run, seen.viewed, camera, tuning, samples=SAMPLES, slab_samples=4, between_samples=False)
        grid, _ = grid_of(run, ordered, strided, np.int32(0), lists, tuning, samples=SAMPLES, beside=False)
        assert int(grid.lists.faults) == 0
        found.append(members(grid))
    assert found[0] == found[1]
    touched = met(ordered, camera, places(camera.height, STRIDE), places(camera.width, STRIDE))
    corners = {(int(row), int(column)): nth for nth, (row, column) in enumerate(zip(grid.row, grid.column, strict=True))}
    for row, column, particle in np.argwhere(touched):
        assert particle in found[0][corners[row // BUNDLE * BUNDLE, column // BUNDLE * BUNDLE]]


@jax.jit
def rays(camera, rows, columns):
    """Depths of samples, and lateral coordinates of rays."""
    depth = camera.depth(jnp.arange(SAMPLES, dtype=jnp.float32) + 0.5, SAMPLES)
    return depth, camera.column(columns + 0.5), camera.row(rows + 0.5)


def met(ordered, camera, rows, columns):
    """Whether the ray of a pixel has a sample in a support, in the arithmetic of the march: (rows, columns, particles)."""
    s, u, v = map(np.asarray, rays(camera, np.float32(rows), np.float32(columns)))
    s = s[:, None]
    spread = s if camera.is_perspective else np.ones_like(s)
    x, y, z, scale, size, live = (np.asarray(getattr(ordered, name)) for name in ("x", "y", "z", "scale", "size", "live"))
    across, down = ((spread * u[:, None, None] - x) * scale) ** 2, ((spread * v[:, None, None] - y) * scale) ** 2
    margin = size**2 - ((s - z) * scale) ** 2 - down[:, None] - across[None]
    return ((margin > 0) & live).any(2)


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
