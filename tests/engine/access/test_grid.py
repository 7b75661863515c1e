"""Every sample with a positive weight finds its particle in its cell, lies in its slab's box, and is cast in any shard alike."""

from __future__ import annotations

import dataclasses
import functools
import os
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from grids import margins, windows_of
from hypothesis import example, given, strategies as st
from images import same_bits

import jaxsph as js
from jaxsph.engine.access.grid import CELL_SAMPLES, MAX_LEVEL, coarser_windows, over_bundles, slab_extents
from jaxsph.engine.cast.batches import batches_of
from jaxsph.engine.control.adapt import ControlPlan
from jaxsph.engine.field.tasks import full_rate
from jaxsph.engine.screen.packets import every_bundle

to_view = jax.jit(js.Camera.to_view)


def numbered(scene, dtype):
    particles = scene.particles
    return dataclasses.replace(particles, quantity=np.arange(particles.capacity, dtype=dtype))


def check_every_sample_finds_its_particles(stages, scene, camera, plan, dtype):
    particles = numbered(scene, dtype)
    grid, _ = stages(particles, camera, plan=plan)
    assert int(grid.lists.faults) == 0
    number = np.asarray(grid.ordered.quantity).astype(int)[np.asarray(grid.lists.rank)]
    begin, length = np.asarray(grid.windows.begin), np.asarray(grid.windows.length)
    members = np.zeros((begin.shape[2], begin.shape[1], particles.capacity), bool)
    for c, slab, bundle in np.argwhere(length > 0):
        start = begin[c, slab, bundle]
        members[bundle, slab, number[start : start + length[c, slab, bundle]]] = True
    x, y, z = np.asarray(to_view(camera, particles.position)).T
    scale = 1 / np.asarray(particles.support)
    there = types.SimpleNamespace(x=x, y=y, z=z, scale=scale, size=np.ones_like(scale))  # of all, whichever are called live
    positive = margins(there, camera, np.arange(camera.height), np.arange(camera.width), plan.samples) > 0
    positive &= np.asarray(particles.valid)
    corner = {(int(r), int(c)): i for i, (r, c) in enumerate(zip(np.asarray(grid.row), np.asarray(grid.column), strict=True))}
    for r, c, k, particle in np.argwhere(positive):
        bundle = corner[r // 8 * 8, c // 8 * 8]
        assert members[bundle, k // plan.cast.slab_samples, particle], f"{particle} is missed by pixel ({r}, {c}), sample {k}"


scenes = {
    "seed": st.integers(0, 2**32 - 1),
    "decades": st.sampled_from([0.0, 1.0, 4.0]),
    "distance": st.sampled_from([3.0, 0.8, 0.0001]),
    "projection": st.sampled_from(["perspective", "orthographic"]),
    "slab_samples": st.sampled_from([4, 16]),
}


@given(**scenes)
@example(seed=0, decades=4.0, distance=0.0001, projection="perspective", slab_samples=4)
@pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
def test_every_sample_with_positive_weight_finds_its_particle_in_its_cell(
    stages, frames, dtype, seed, decades, distance, projection, slab_samples
):
    with jax.enable_x64(dtype == np.float64):
        rng = np.random.default_rng(seed)
        scene = frames.scene(rng, decades=decades, dtype=dtype)
        camera = frames.camera(rng, projection, distance, dtype)
        check_every_sample_finds_its_particles(stages, scene, camera, frames.plan(slab_samples), dtype)


@given(seed=st.integers(0, 2**32 - 1), where=st.sampled_from(["near plane", "eye", "ray", "cell border", "sample", "behind"]))
def test_particles_in_awkward_places_are_found(stages, frames, seed, where):
    """Tangent to rays and samples, across the near plane, around the eye, behind it."""
    rng = np.random.default_rng(seed)
    camera = js.Camera.look_at((0, 0, 0), (0, 0, 1), fov_degrees=50, width=frames.width, height=frames.height, near=0.4, far=3.0)
    s, told = js.reference.sample_depths(camera, frames.samples), jax.tree.map(np.asarray, camera)
    u = told.column(np.arange(frames.width + 1.0))
    count = frames.capacity
    k, c = rng.integers(0, frames.samples, count), rng.integers(0, frames.width, count)
    support = 10 ** -rng.uniform(0, 3, count)
    position = np.stack([u[c] * s[k], rng.uniform(-1, 1, count) * 0.3 * s[k], s[k]], 1)
    angle = rng.uniform(0, 2 * np.pi, count)
    if where == "near plane":
        position[:, 2] = 0.4 + support * rng.choice([-1, -0.999999, 0, 1], count)
    if where == "eye":
        position *= 1e-3
    if where == "ray":
        position[:, 0] = told.column(c + 0.5) * s[k] + support * np.cos(angle)
        position[:, 1] += support * np.sin(angle)
    if where == "cell border":
        position[:, 0] = u[(c // 8) * 8] * s[k] + support * rng.choice([-1, 1], count)
    if where == "sample":
        position[:, 2] = s[k // 4 * 4] + support * rng.choice([-1, 1], count)
    if where == "behind":
        position[:, 2] = -support * rng.uniform(0, 1, count)
    position[:, 0] *= -1  # x points left when looking along +z with y up
    particles = js.Particles.from_arrays(position, support, 0.0, capacity=count)
    transfer = js.TransferFunction.from_points([0, 1], np.ones((2, 3)), [1, 1])
    scene = js.Scene(particles=particles, transfer=transfer)
    check_every_sample_finds_its_particles(stages, scene, camera, frames.plan(), np.float32)


def test_lists_are_tight_for_particles_smaller_than_a_bundle(stages, frames):
    """A particle well inside a bundle is listed once, and between the rays of a bundle not at all."""
    camera = js.Camera.look_at((0, 0, 0), (0, 0, 1), fov_degrees=50, width=frames.width, height=frames.height, near=0.9, far=1.1)
    told = jax.tree.map(np.asarray, camera)
    pixel = told.column(1.0) - told.column(0.0)
    inside, between = ((-told.column(at), told.row(at), 1.0) for at in (4.5, 5.0))
    for place, expected in ((inside, 1), (between, 0)):
        particles = js.Particles.from_arrays([place], 0.2 * pixel, 0.0, capacity=frames.capacity)
        grid, _ = stages(particles, camera, plan=frames.plan())
        assert np.asarray(grid.lists.end)[-1] == expected


@pytest.mark.parametrize("capacity", ["tile_capacity", "list_capacity"])
def test_a_full_capacity_is_a_fault_and_stays_in_bounds(stages, frames, capacity):
    rng = np.random.default_rng(0)
    scene, camera, plan = frames.scene(rng, decades=0), frames.camera(rng), frames.plan()
    small = dataclasses.replace(plan, lists=dataclasses.replace(plan.lists, **{capacity: 5}))
    grid, _ = stages(scene.particles, camera, plan=small)
    assert int(grid.lists.faults) != 0
    assert np.all(np.asarray(grid.windows.begin) + np.asarray(grid.windows.length) <= small.lists.list_capacity)


def test_dead_and_padded_particles_are_listed_nowhere(stages, frames):
    rng = np.random.default_rng(0)
    camera = frames.camera(rng)
    particles = js.Particles.from_arrays([[0, 0, 0], [0, 1e3, 0], [50, 0, 0]], 0.5, 0.0, capacity=frames.capacity)
    grid, _ = stages(particles, camera, plan=frames.plan())
    ranks = set(np.asarray(grid.lists.rank)[: np.asarray(grid.lists.end)[-1]].tolist())
    assert len(ranks) == 1 and float(np.asarray(grid.ordered.quantity)[ranks.pop()]) == 0


unions = jax.jit(coarser_windows, compiler_options=QUICKLY)


@pytest.mark.parametrize("slab_samples", [4, 8, 16])
def test_coarser_windows_are_unions_up_to_the_coarsest(slab_samples):
    windows = windows_of(slab_samples)
    begin, length = np.asarray(windows.begin), np.asarray(windows.length)
    found = jax.tree.map(np.asarray, unions(windows))
    assert len(found) == MAX_LEVEL + 1
    for level, window in enumerate(found):
        share = 1 << level
        assert window.begin.shape[1] == -(-begin.shape[1] // CELL_SAMPLES) * CELL_SAMPLES >> level
        for group in range(window.begin.shape[1]):
            part = np.s_[:, group * share : (group + 1) * share]
            filled = length[part] > 0
            first = np.where(filled, begin[part], 10**6).min(1, initial=10**6)
            past = np.where(filled, begin[part] + length[part], 0).max(1, initial=0)
            wanted = np.maximum(past - first, 0)
            np.testing.assert_array_equal(window.length[:, group], wanted)
            np.testing.assert_array_equal(window.begin[:, group][wanted > 0], first[wanted > 0])


@functools.partial(jax.jit, static_argnames="plan", compiler_options=QUICKLY)
def looked(grid, reference, camera, point, *, plan):
    """Boxes of slabs, their distance to a point, and where samples are, on borders or between."""
    schedule, packets = full_rate(grid.windows, reference), every_bundle(grid, camera)
    found, samples = slab_extents(grid, camera, plan.cast.slab_samples), []
    for on_borders in (False, True):
        batches = batches_of(grid, schedule, packets, plan.cast, camera.is_perspective, on_borders)
        positions = batches.task(jnp.arange(schedule.count.size)).positions()
        samples.append([value.reshape(*schedule.count.shape, *value.shape[1:]) for value in positions])
    return found, found.distance_to(*point), samples


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@given(seed=st.integers(0, 2**32 - 1), distance=st.sampled_from([3.0, 0.8, 0.0001]))
def test_every_sample_lies_in_the_box_of_its_slab(frames, stages, projection, seed, distance):
    rng, plan = np.random.default_rng(seed), frames.plan()
    camera = frames.camera(rng, projection, distance)
    grid, reference = stages(frames.scene(rng).particles, camera, plan=plan)
    point = rng.uniform(-3, 3, 3).astype(np.float32)
    found, distance, samples = jax.tree.map(np.asarray, looked(grid, reference, camera, point, plan=plan))
    for places in samples:
        for name, place in zip("xyz", places, strict=True):
            lower, upper = (getattr(found, f"{name}_{side}")[..., None, None] for side in ("lower", "upper"))
            assert (lower <= place).all() and (place <= upper).all(), name
        # nor is any sample nearer to a point than its box is
        nearest = np.sqrt(sum((place.astype(np.float64) - at) ** 2 for place, at in zip(places, point, strict=True))).min((2, 3))
        assert (distance.astype(np.float64) <= nearest * (1 + 1e-6) + 1e-6).all()


MANY = 8
ALL_LAYERS = "color", "transmittance", "depth", "error_bound", "evaluations"


@pytest.fixture
def on_cores(monkeypatch):
    """Have this process believe that it may use so many cores: an eager image is cast in as many shards."""
    return lambda cores: monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)


@pytest.mark.core
@pytest.mark.parametrize("tolerance", [None, 0.012])
def test_two_shards_make_the_image_of_one(frames, on_cores, tolerance, quick_programs):
    rng, images, frames = np.random.default_rng(2), [], frames.deep(4)
    scene, camera = frames.scene(rng, decades=0.3), frames.camera(rng)
    settings = dataclasses.replace(frames.settings, tolerance=tolerance)
    control = None if tolerance is None else ControlPlan(True, True, "budget")
    for cores in (1, 2):
        on_cores(cores)
        images.append(js.render(scene, camera, settings, plan=dataclasses.replace(frames.plan(), control=control)))
    assert np.asarray(images[0].alpha).max() > 0.3
    same_bits(*images, *ALL_LAYERS)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["interval", "pilot", None])
def test_any_number_of_shards_makes_the_same_image(on_cores, estimator):
    scene, camera = js.scenes.load("checker_board", 3000, width=150, height=130)
    settings = js.Settings(samples=96) if estimator is None else js.Settings(samples=96, tolerance=0.05, estimator=estimator)
    plan, images = js.plan(scene, camera, settings), []
    for cores in (1, MANY):
        on_cores(cores)
        images.append(js.render(scene, camera, settings, plan=plan))
    if estimator == "pilot":  # slabs are interpolated
        assert images[0].stats["evaluations"] < 0.5 * images[0].stats["evaluations_full"]
    same_bits(*images, *ALL_LAYERS)


@pytest.mark.core
def test_groups_of_bundles_are_as_all_at_once():
    rng = np.random.default_rng(0)
    given = [(rng.normal(size=(3, bundles)).astype(np.float32), rng.integers(0, 9, bundles)) for bundles in (1, 4, 7, 8, 13)]

    def double(of_some):
        value, number = of_some
        return {"sum": value.sum(0), "each": value * number, "odd": number % 2 == 1}

    found = jax.jit(lambda given: [over_bundles(double, one, 4) for one in given])(given)
    for one, own in zip(given, found, strict=True):
        for name, wanted in double(one).items():
            np.testing.assert_allclose(own[name], wanted, rtol=1e-6)
