"""Lists hold what every ray of a bundle can meet, of rays through every so many pixels and of many tiles, too.

What the host sorts and picks is what XLA does: the same particles, in the same order, in every list.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from grids import margins
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.engine.access.host_lists import entries_at, sorted_order
from jaxsph.engine.access.lists import BUNDLE, ListPlan, build_lists, nodes_between
from jaxsph.engine.access.view import rank_particles, view_particles
from jaxsph.engine.frame.stages import grid_of, ordered_of
from jaxsph.engine.planning.viewing import view_scene
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.tuning import CPU
from jaxsph.engine.screen.canvas import places
from jaxsph.model.camera.camera import num_nodes

pytestmark = pytest.mark.usefixtures("quick_programs")

SIZE, STRIDE, SAMPLES = {"width": 45, "height": 38}, 4, 24
LISTS = ListPlan(1, 3, 2 * 24, 8 * 24)


@given(st.lists(st.integers(0, 2**32 - 1) | st.sampled_from([7, 1 << 16, (1 << 16) + 7]), max_size=40), st.integers(1, 3))
def test_keys_are_sorted_stably(keys, threads):
    key = np.array(keys, np.uint32)
    np.testing.assert_array_equal(sorted_order(key, threads), np.argsort(key, kind="stable"))


def test_threads_share_keys_by_their_size():
    """Enough of them for three threads, many of them equal, and parts of any size."""
    rng = np.random.default_rng(0)
    for key in (rng.integers(0, 2**32, 200_000), rng.integers(0, 3, 200_000), np.full(200_000, 5)):
        key = key.astype(np.uint32)
        np.testing.assert_array_equal(sorted_order(key, 3), np.argsort(key, kind="stable"))


@given(st.lists(st.tuples(st.integers(0, 80), st.integers(0, 80)), max_size=30), st.integers(1, 75))
def test_each_place_has_the_entries_whose_interval_holds_it(ends, places):
    first, last = np.array(ends, np.uint8).reshape(-1, 2).T
    values = np.arange(len(ends)) + 100
    found = list(entries_at(values, first, last, 0, places))
    assert [some.tolist() for some in found] == [values[(first <= p) & (p <= last)].tolist() for p in range(places)]


def lists_of(grid):
    """Lists by bundle, of particles."""
    rank, start, end = (np.asarray(value) for value in (grid.lists.rank, grid.lists.start, grid.lists.end))
    return [rank[a:b].tolist() for a, b in zip(start, end, strict=True)]


def both(scene, camera, lists, first_row=0, samples=SAMPLES, stride=1):
    """The grid as XLA and as the host makes it, of rays through every so many pixels."""
    order = {"samples": samples, "slab_samples": 4, "between_samples": False}
    grid = {"samples": samples, "beside": False}
    seen = view_scene(scene, camera, samples=samples, capacity=scene.particles.capacity, num_classes=3)
    found, rays = [], camera if stride == 1 else camera.strided(stride)
    for tuning in (dataclasses.replace(CPU, sorts_on_host=False), CPU):
        clock = Clock()
        ordered = ordered_of(clock, seen.viewed, camera, tuning, **order)
        found.append((ordered, grid_of(clock, ordered, rays, np.int32(first_row), lists, tuning, **grid)))
    return found


@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@given(seed=st.integers(0, 2**32 - 1), distance=st.sampled_from([3.0, 0.8, 0.0001]), first_row=st.sampled_from([0, 16, 32]))
def test_the_host_makes_the_lists_and_windows_that_xla_makes(frames, dtype, projection, seed, distance, first_row):
    with jax.enable_x64(dtype == np.float64):
        rng, shape = np.random.default_rng(seed), dataclasses.replace(frames, **SIZE)
        scene, camera = shape.scene(rng, decades=4, dtype=dtype), shape.camera(rng, projection, distance, dtype)
        (ordered, (expected, known)), (same, (found, counts)) = both(scene, camera, LISTS, first_row)
        jax.tree.map(np.testing.assert_array_equal, same, ordered)
        assert int(counts[0]) == 0 and int(counts[2]) == int(known[2]) == sum(map(len, lists_of(found)))
        assert lists_of(found) == lists_of(expected)
        np.testing.assert_array_equal(found.windows.length, expected.windows.length)
        np.testing.assert_array_equal(found.windows.count, expected.windows.count)


def test_places_that_a_byte_cannot_count_are_told_apart():
    """An image of more than 256 bundles across."""
    rng = np.random.default_rng(0)
    particles = js.Particles.from_arrays(rng.uniform(-1, 1, (50, 3)), rng.uniform(0.002, 0.3, 50), 0.0)
    transfer = js.TransferFunction.from_points([0, 1], np.ones((2, 3)), [1, 1])
    camera = js.Camera.orthographic((0, 0, -3), (0, 0, 0), view_height=0.02, width=2200, height=20, near=1, far=5)
    expected, found = (
        grid for _, (grid, _) in both(js.Scene(particles=particles, transfer=transfer), camera, ListPlan(2, 138, 10_000, 40_000))
    )
    assert lists_of(found) == lists_of(expected) and any(lists_of(found))


@pytest.mark.parametrize("capacity", ["tile_capacity", "list_capacity"])
def test_a_full_capacity_is_the_same_fault_on_the_host(frames, capacity):
    rng, shape = np.random.default_rng(0), dataclasses.replace(frames, **SIZE)
    scene, camera = shape.scene(rng, decades=0), shape.camera(rng)
    expected, found = (grid for _, (grid, _) in both(scene, camera, dataclasses.replace(LISTS, **{capacity: 5})))
    assert int(found.lists.faults) & int(expected.lists.faults) != 0
    assert not np.asarray(found.lists.end).any()


@given(st.integers(1, 80), st.sampled_from([1, 2, 4, 8, 16]), st.integers(0, 80), st.integers(-1, 79))
def test_nodes_of_a_range_of_pixels_are_those_that_lie_in_it(size, stride, first, last):
    first, last = min(first, size), min(last, size - 1)
    begin, end = nodes_between(first, last, size, stride)
    inside = [node for node, pixel in enumerate(places(size, stride)) if first <= pixel <= last]
    assert list(range(begin, end + 1)) == inside
    assert not inside or inside[-1] < num_nodes(size, stride)


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@given(seed=st.integers(0, 2**32 - 1), decades=st.sampled_from([1.0, 4.0]), distance=st.sampled_from([3.0, 0.8, 0.0001]))
def test_no_ray_through_a_node_misses_a_particle(frames, projection, seed, decades, distance):
    rng, shape = np.random.default_rng(seed), dataclasses.replace(frames, **SIZE)
    scene, camera = shape.scene(rng, decades=decades), shape.camera(rng, projection, distance)
    lists = ListPlan(1, 1, 2 * frames.capacity, 4 * frames.capacity)
    (ordered, (expected, _)), (_, (found, _)) = both(scene, camera, lists, stride=STRIDE)
    assert int(found.lists.faults) == 0 and lists_of(found) == lists_of(expected)
    listed = [set(one) for one in lists_of(found)]
    margin = margins(ordered, camera, places(camera.height, STRIDE), places(camera.width, STRIDE), SAMPLES)
    touched = ((margin > 0) & np.asarray(ordered.live)).any(2)
    corners = {(int(row), int(column)): nth for nth, (row, column) in enumerate(zip(found.row, found.column, strict=True))}
    for row, column, particle in np.argwhere(touched):
        assert particle in listed[corners[row // BUNDLE * BUNDLE, column // BUNDLE * BUNDLE]]


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
