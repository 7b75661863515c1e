"""The pilot estimator: it saves evaluations, says how wrong that is, and leaves alone what its lattice cannot resolve."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.access.lattice import FINEST, Spacing
from jaxsph.control.pilot import DEVIATIONS, pilot
from jaxsph.control.residuals import residuals
from jaxsph.stages import sum_part

PILOT = js.Settings(tolerance=0.004, estimator="pilot", samples=128)
FULL = js.Settings(samples=128)


@functools.cache
def both(name, size=224, particles=8_000):
    """A scene at full rate, and with pilots."""
    scene, camera = js.scenes.load(name, particles, width=size, height=size - 7)
    return js.render(scene, camera, FULL), js.render(scene, camera, PILOT)


def error_of(image, truth):
    color = np.abs(np.asarray(image.color, np.float64) - np.asarray(truth.color, np.float64)).max(-1)
    return np.maximum(color, np.abs(np.asarray(image.transmittance, np.float64) - np.asarray(truth.transmittance, np.float64)))


@pytest.mark.parametrize("name", ["mixer", *(pytest.param(name, marks=pytest.mark.slow) for name in ("radial", "checker_board"))])
def test_work_is_saved_few_pixels_are_over_the_tolerance_and_none_over_twice(name):
    truth, image = both(name)
    error = error_of(image, truth)
    assert (error > PILOT.tolerance).mean() <= 1e-3
    assert error.max() <= 2 * PILOT.tolerance
    assert 0 < float(image.error_bound.max()) <= PILOT.tolerance
    assert not image.certified
    assert image.stats["evaluations_full"] == truth.stats["evaluations"]
    if name != "radial":
        assert image.stats["evaluations"] < 0.9 * truth.stats["evaluations"]


def cloud(quantity, support, count=4000, *, extent=1.0):
    """Particles at random in a cube, seen whole, and a camera with an image of odd size."""
    rng = np.random.default_rng(1)
    position = rng.uniform(-extent, extent, (count, 3)).astype(np.float32)
    quantity = np.asarray(quantity(position), np.float32)
    particles = js.Particles.from_arrays(position, np.float32(support), quantity, capacity=CAPACITY)
    camera = js.Camera.look_at((0, 0, -4), (0, 0, 0), width=89, height=75, near=1.0, far=7.0)
    return particles, camera


SMOOTH = js.TransferFunction.from_points(
    np.float32([-1, 0, 0, 1]),
    np.float32([[0.2, 0.4, 0.9], *[[0.55, 0.45, 0.5]] * 2, [0.9, 0.5, 0.1]]),
    np.float32([0.5, 1, 1, 2]),
)
CAPACITY = 4001


@functools.cache
def plan_of(settings):
    """One plan for all clouds: that of wide supports and a tiny one."""
    particles, camera = cloud(lambda x: x[:, 0], 0.5)
    return js.plan(js.Scene(particles=with_a_tiny_one(particles), transfer=SMOOTH), camera, settings)


def with_a_tiny_one(particles):
    """Another particle between the nodes, of another quantity."""
    tiny = {"position": [0.013, 0.021, 0.017], "support": 0.03, "quantity": 1.0, "volume": 1.0}
    columns = {name: np.array(getattr(particles, name)) for name in tiny}
    for name, value in tiny.items():
        columns[name][-1] = value
    return js.Particles.from_arrays(**columns, capacity=CAPACITY)


def draw(scene, camera, pilot=PILOT):
    """At full rate, and with pilots."""
    return [js.render(scene, camera, settings, plan=plan_of(like)) for settings, like in ((FULL, FULL), (pilot, PILOT))]


def test_a_constant_quantity_keeps_its_colour():
    particles, camera = cloud(lambda x: np.full(len(x), 0.3), 0.5)
    scene = js.Scene(particles=particles, transfer=SMOOTH)
    truth, image = draw(scene, camera)
    assert image.stats["evaluations"] < truth.stats["evaluations"]
    assert error_of(image, truth).max() < 1e-5
    color, alpha = np.asarray(image.color), np.asarray(image.alpha)
    seen = alpha > 0.5
    np.testing.assert_allclose(color[seen] / alpha[seen][:, None], np.broadcast_to(SMOOTH(0.3)[0], (seen.sum(), 3)), rtol=1e-5)


def test_supports_that_the_lattice_cannot_resolve_are_marched():
    particles, camera = cloud(lambda x: x[:, 0], 0.02)
    scene = js.Scene(particles=particles, transfer=SMOOTH)
    truth, image = draw(scene, camera)
    assert float(truth.alpha.max()) > 0.01
    np.testing.assert_array_equal(image.color, truth.color)
    assert float(image.error_bound.max()) == 0


def test_one_small_particle_between_nodes_is_not_lost():
    particles, camera = cloud(lambda x: np.full(len(x), -1.0), 0.5)
    scene = js.Scene(particles=with_a_tiny_one(particles), transfer=SMOOTH)
    truth, image = draw(scene, camera)
    assert image.stats["evaluations"] < truth.stats["evaluations"]
    assert error_of(image, truth).max() <= PILOT.tolerance


def test_no_tolerance_to_spend_leaves_full_rate():
    particles, camera = cloud(lambda x: x[:, 0], 0.5)
    truth, image = draw(js.Scene(particles=particles, transfer=SMOOTH), camera, dataclasses.replace(PILOT, tolerance=0.0))
    for layer in ("color", "transmittance", "depth"):
        np.testing.assert_array_equal(getattr(image, layer), getattr(truth, layer))
    assert float(image.error_bound.max()) == 0


def test_a_jump_of_the_transfer_function_is_kept_sharp():
    jump = js.TransferFunction.from_points(
        np.float32([-1, 0, 0, 1]), np.float32([[0, 0, 1]] * 2 + [[1, 0, 0]] * 2), np.float32([0.1, 0.1, 4, 4])
    )
    particles, camera = cloud(lambda x: x[:, 0], 0.4)
    scene = js.Scene(particles=particles, transfer=jump)
    truth, image = draw(scene, camera)
    assert image.stats["evaluations"] < truth.stats["evaluations"]
    assert error_of(image, truth).max() <= PILOT.tolerance


def test_slabs_are_interpolated_marched_at_some_rays_or_at_all_as_the_budget_allows(stages):
    scene, camera = js.scenes.load("radial", 8_000, width=224, height=217)
    plan = js.plan(scene, camera, PILOT)
    grid, origin = stages(scene.particles, camera, plan=plan)
    lattice = sum_part(grid, camera, scene.transfer, jnp.int32(0), parts=1, plan=plan, kernel=scene.particles.kernel)
    found = residuals(grid, lattice, camera, scene.transfer, plan.cast.slab_samples)
    choose = functools.partial(pilot, grid, lattice, found, camera, origin, slab_samples=plan.cast.slab_samples)
    variance, before = np.asarray(found.variance), 0
    for tolerance in (0.001, 0.01, 0.1):
        work, estimate = choose(tolerance=jnp.float32(tolerance))
        taken, sparse = np.asarray(work.interpolated), np.asarray(work.sparse)
        assert taken.any() and sparse.any() and not (taken & sparse).any()
        np.testing.assert_array_equal(work.count, np.where(taken, 0, grid.cells.count))
        spent = np.where(taken, variance, np.where(sparse, np.asarray(found.sparse) * variance, 0)).sum(0)
        assert (DEVIATIONS * np.sqrt(spent) <= np.asarray(estimate) * (1 + 1e-5)).all()
        assert (np.asarray(estimate) <= np.float32(tolerance)).all()
        assert taken.sum() > before
        before = taken.sum()


@pytest.mark.parametrize("count", [0, 1])
def test_hardly_any_particles(count):
    particles, camera = cloud(lambda x: x[:, 0], 0.5, count=count, extent=0.1)
    scene = js.Scene(particles=particles, transfer=SMOOTH)
    truth, image = draw(scene, camera)
    np.testing.assert_array_equal(image.color, truth.color)


def test_jit_agrees_with_eager():
    scene, camera = js.scenes.load("mixer", 8_000, width=224, height=217)
    _, image = both("mixer")
    plan = js.plan(scene, camera, PILOT)
    traced = jax.jit(lambda s: js.render(s, camera, PILOT, plan=plan))(scene)
    np.testing.assert_allclose(traced.color, image.color, atol=1e-5)
    assert not bool(traced.certified)


@pytest.mark.slow
@pytest.mark.parametrize("size", [128, 256])
def test_the_estimate_holds_however_dense_samples_are_along_the_ray(size):
    """Where nodes across are far apart, neighbouring samples err alike: their errors do not average out."""
    scene, camera = js.scenes.load("checker_board", width=size, height=size)
    for samples in (128, 512):
        full = js.Settings(samples=samples)
        truth = js.render(scene, camera, full)
        image = js.render(scene, camera, dataclasses.replace(PILOT, samples=samples))
        error = error_of(image, truth)
        off, estimate = error > 1e-6, np.asarray(image.error_bound)
        assert not off.any() or np.percentile(estimate[off] / error[off], 1) >= 1.3
        assert (error > PILOT.tolerance).sum() <= 2 and error.max() <= 2 * PILOT.tolerance


@pytest.mark.slow
def test_bands_keep_the_tolerance_too():
    scene, camera = js.scenes.load("mixer", 8_000, width=224, height=217)
    plan = js.plan(scene, camera, PILOT)
    low = dataclasses.replace(PILOT, memory_limit=plan.bytes // 2)
    banded = js.plan(scene, camera, low)
    assert banded.bands > 1
    error = error_of(js.render(scene, camera, low, plan=banded), both("mixer")[0])
    assert error.max() <= 2 * PILOT.tolerance


def test_a_plan_with_little_room_for_nodes_saves_less_but_keeps_the_tolerance():
    """As that of another frame may have: what lies beyond is marched."""
    particles, camera = cloud(lambda x: x[:, 0], 0.5)
    scene = js.Scene(particles=particles, transfer=SMOOTH)
    truth, roomy = draw(scene, camera)
    plan = plan_of(PILOT)
    little = dataclasses.replace(plan, control=dataclasses.replace(plan.control, room=(5, 6)))
    image = js.render(scene, camera, PILOT, plan=little)
    assert roomy.stats["evaluations"] < image.stats["evaluations"] < truth.stats["evaluations"]
    assert error_of(image, truth).max() <= PILOT.tolerance


def test_nodes_are_as_far_apart_as_supports_allow():
    for size, samples, nodes in ((128, 128, FINEST), (1024, 128, Spacing(8, 2)), (128, 1024, Spacing(4, 8))):
        scene, camera = js.scenes.load("mixer", 8_000, width=size, height=size)
        plan = js.plan(scene, camera, dataclasses.replace(PILOT, samples=samples))
        assert plan.control.nodes == nodes
        rows, columns = plan.control.room
        assert 0 < rows < size / 8 and 0 < columns <= size / 8, "around the fluid only"


def test_float64_orthographic_wendland(x64):
    rng = np.random.default_rng(2)
    position = rng.uniform(-1, 1, (3000, 3))
    particles = js.Particles.from_arrays(position, 0.5, np.sin(3 * position[:, 0]), kernel="wendland_c2")
    camera = js.Camera.orthographic((0, 0, -4), (0, 0, 0), view_height=2.5, width=80, height=72, near=1.0, far=7.0)
    transfer = js.TransferFunction.from_points(
        np.float64([-1, 1]), np.float64([[0.2, 0.4, 0.9], [0.9, 0.5, 0.1]]), np.float64([0.5, 2])
    )
    scene = js.Scene(particles=particles, transfer=transfer)
    truth, image = js.render(scene, camera, FULL), js.render(scene, camera, PILOT)
    assert image.color.dtype == np.float64
    assert image.stats["evaluations"] < truth.stats["evaluations"]
    assert error_of(image, truth).max() <= PILOT.tolerance
