"""The pilot estimator: it saves evaluations, says how wrong that is, keeps its budget, and leaves what it cannot resolve."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from hypothesis import given, strategies as st
from images import error_of, same_bits

import jaxsph as js
from jaxsph.engine.control.interpolation_error import interpolation_error
from jaxsph.engine.control.pilot import choose_spacing, pilot, select_under_budget, sum_shard
from jaxsph.engine.field.tasks import DENSE, FINEST, INTERPOLATED, SUBSAMPLED, Spacing

pytestmark = pytest.mark.usefixtures("quick_programs")

PILOT = js.Settings(tolerance=0.004, estimator="pilot", samples=128)
FULL = js.Settings(samples=128)


@functools.cache
def both(name, size=224, particles=8_000):
    """A scene at full rate, and with pilots."""
    scene, camera = js.scenes.load(name, particles, width=size, height=size - 7)
    return js.render(scene, camera, FULL), js.render(scene, camera, PILOT)


def require_kept(image, truth, tolerance):
    """Six standard deviations are no bound; but in the frames of these tests no pixel is beyond its own."""
    error, estimate = error_of(image, truth), np.asarray(image.error_bound, np.float64)
    assert (error <= estimate).all(), f"{(error > estimate).sum()} pixels, {error.max()}"
    assert (estimate <= tolerance).all()  # in float64: a tolerance is rounded down
    assert not error[estimate == 0].any(), "where nothing is estimated, nothing is left out"


@pytest.mark.parametrize(("name", "times_fewer"), [
    ("radial", 1.5), *(pytest.param(*slow, marks=pytest.mark.slow) for slow in (("mixer", 1.5), ("checker_board", 4.5))),
])  # fmt: skip
def test_work_is_saved_and_no_pixel_is_over_its_estimate_nor_that_over_the_tolerance(name, times_fewer):
    truth, image = both(name)
    require_kept(image, truth, PILOT.tolerance)
    assert 0.9 * PILOT.tolerance < np.asarray(image.error_bound).max(), "the tolerance is spent"
    assert not image.certified
    assert image.stats["evaluations_full"] == truth.stats["evaluations"]
    assert times_fewer * image.stats["evaluations"] < truth.stats["evaluations"]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "times_fewer"), [("mixer", 5.5), ("checker_board", 9.0), ("radial", 3.8)])
def test_at_512_as_much_is_saved_as_the_readme_says(name, times_fewer):
    """To a twentieth."""
    scene, camera = js.scenes.load(name, width=512, height=512)
    truth, image = (js.render(scene, camera, dataclasses.replace(asked, samples=256)) for asked in (FULL, PILOT))
    error = error_of(image, truth)
    assert (error > PILOT.tolerance).sum() <= 1 and error.max() <= 1.13 * PILOT.tolerance
    assert truth.stats["evaluations"] / image.stats["evaluations"] == pytest.approx(times_fewer, rel=0.05)


def by_x(position):
    return position[:, 0]


def cloud(quantity, support, count=4000, extent=1.0):
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
    particles, camera = cloud(by_x, 0.5)
    return js.plan(js.Scene(particles=with_a_tiny_one(particles), transfer=SMOOTH), camera, settings)


def with_a_tiny_one(particles):
    """Another particle between the nodes, of another quantity."""
    tiny = {"position": [0.013, 0.021, 0.017], "support": 0.03, "quantity": 1.0, "volume": 1.0}
    columns = {name: np.array(getattr(particles, name)) for name in tiny}
    for name, value in tiny.items():
        columns[name][-1] = value
    return js.Particles.from_arrays(**columns, capacity=CAPACITY)


JUMP = js.TransferFunction.from_points(
    np.float32([-1, 0, 0, 1]), np.float32([[0, 0, 1]] * 2 + [[1, 0, 0]] * 2), np.float32([0.1, 0.1, 4, 4])
)
CLOUDS = {  # the cloud, what more is changed of scene, tolerance and plan, and the share of the work that is less than all
    "supports that no lattice resolves": ((by_x, 0.02), {}, None),
    "a small particle between nodes": ((lambda x: np.full(len(x), -1.0), 0.5), {"tiny": True}, 1),
    "no tolerance to spend": ((by_x, 0.5), {"tolerance": 0.0}, None),
    "a jump of the transfer function": ((by_x, 0.4), {"transfer": JUMP}, 1),
    "no particle": ((by_x, 0.5, 0, 0.1), {}, None),
    "one particle": ((by_x, 0.5, 1, 0.1), {"bound": 1e-5}, None),
    "a constant": ((lambda x: np.full(len(x), 0.3), 0.5), {"most": 1e-5}, 1),
    "a plan with little room for nodes": ((by_x, 0.5), {"room": (5, 6)}, 1),  # beyond which slabs are marched
    "nodes eight pixels apart": ((by_x, 0.7, 1500), {"nodes": Spacing(8, 4)}, 0.7),
}
SLOW = "a constant", "a plan with little room for nodes", "nodes eight pixels apart"


@pytest.mark.parametrize("name", [pytest.param(one, marks=[pytest.mark.slow] * (one in SLOW)) for one in CLOUDS])
def test_clouds_are_within_the_tolerance_and_what_cannot_be_interpolated_is_marched(name):
    made, more, share = CLOUDS[name]
    particles, camera = cloud(*made)
    scene = js.Scene(particles=with_a_tiny_one(particles) if "tiny" in more else particles, transfer=more.get("transfer", SMOOTH))
    asked, plan = dataclasses.replace(PILOT, tolerance=more.get("tolerance", PILOT.tolerance)), plan_of(PILOT)
    control = dataclasses.replace(plan.control, **{part: more[part] for part in ("room", "nodes") if part in more})
    truth = js.render(scene, camera, FULL, plan=plan_of(FULL))
    image = js.render(scene, camera, asked, plan=dataclasses.replace(plan, control=control))
    if share is None:
        same_bits(image, truth)
        assert np.asarray(image.error_bound).max() <= more.get("bound", 0)
    else:
        assert image.stats["evaluations"] < share * truth.stats["evaluations"]
        assert error_of(image, truth).max() <= more.get("most", PILOT.tolerance)


@pytest.mark.slow
def test_slabs_are_interpolated_marched_at_some_rays_or_at_all_as_the_budget_allows(stages):
    scene, camera = js.scenes.load("radial", 8_000, width=224, height=217)
    plan = js.plan(scene, camera, PILOT)
    slab_samples, (grid, reference) = plan.cast.slab_samples, stages(scene.particles, camera, plan=plan)
    sizes = {"lists": plan.lists, "slab_samples": plan.cast.slab_samples, "control": plan.control, "tuning": plan.cast.tuning}
    lattice = sum_shard(grid, camera, scene.transfer, jnp.int32(0), shards=1, kernel=scene.particles.kernel, **sizes)
    found = interpolation_error(grid, lattice, camera, scene.transfer, slab_samples)
    choose = functools.partial(pilot, grid, lattice, found, camera, reference, slab_samples=slab_samples)
    variance, before = np.asarray(found.variance), 0
    samples = np.minimum(slab_samples, PILOT.samples - slab_samples * np.arange(len(variance)))[:, None]
    rows, columns = (np.asarray(side) for side in (grid.row, grid.column))
    shown = (rows < camera.height) & (columns < camera.width)
    for tolerance in (0.001, 0.01, 0.1):
        schedule, estimate = choose(tolerance=jnp.float32(tolerance))
        method = np.asarray(schedule.method)
        taken, some = method >= INTERPOLATED, method == SUBSAMPLED
        assert taken.any() and some.any() and (method[~taken & ~some] == DENSE).all()
        np.testing.assert_array_equal(method[taken], INTERPOLATED + np.asarray(schedule.level)[taken])
        np.testing.assert_array_equal(schedule.count, np.where(taken, 0, grid.windows.count))
        spent = np.where(taken, variance, np.where(some, np.asarray(found.subsampled_share) * variance, 0)).sum(0)
        assert (6 * np.sqrt(spent) <= np.asarray(estimate) * (1 + 1e-5)).all()
        assert (np.asarray(estimate) <= np.float32(tolerance)).all()
        assert taken.sum() > before
        before = taken.sum()
        # what is counted: particles at all rays, or at sixteen of sixty-four, and those at nodes
        count = np.asarray(grid.windows.count) * np.where(taken, 0, np.where(some, 0.25, 1)) * samples
        evaluations = (count.sum(0) + np.asarray(lattice.evaluations))[shown]
        image = js.render(scene, camera, dataclasses.replace(PILOT, tolerance=tolerance), plan=plan)
        np.testing.assert_allclose(np.asarray(image.evaluations)[rows[shown], columns[shown]], evaluations, rtol=1e-6)
    assert np.asarray(lattice.evaluations).sum() > 0


def test_jit_agrees_with_eager():
    scene, camera = js.scenes.load("radial", 8_000, width=224, height=217)
    truth, image = both("radial")
    plan = js.plan(scene, camera, PILOT)
    traced = jax.jit(lambda s: js.render(s, camera, PILOT, plan=plan), compiler_options=QUICKLY)(scene)
    away = np.abs(np.asarray(traced.color) - np.asarray(image.color))
    assert (away <= 1e-5).mean() >= 0.999 and away.max() <= PILOT.tolerance  # rounding may tip a slab from one method to another
    assert error_of(traced, truth).max() <= PILOT.tolerance
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
        assert (error > PILOT.tolerance).sum() <= 1 and error.max() <= 1.13 * PILOT.tolerance


@pytest.mark.slow
def test_bands_keep_the_tolerance_too():
    scene, camera = js.scenes.load("radial", 8_000, width=224, height=217)
    plan = js.plan(scene, camera, PILOT)
    low = dataclasses.replace(PILOT, memory_limit=plan.bytes // 2)
    banded = js.plan(scene, camera, low)
    assert banded.bands > 1
    require_kept(js.render(scene, camera, low, plan=banded), both("radial")[0], PILOT.tolerance)


def test_nodes_are_as_far_apart_as_supports_allow():
    for size, samples, nodes in ((128, 128, FINEST), (1024, 128, Spacing(8, 2)), (128, 1024, Spacing(4, 8))):
        scene, camera = js.scenes.load("mixer", 8_000, width=size, height=size)
        plan = js.plan(scene, camera, dataclasses.replace(PILOT, samples=samples))
        assert plan.control.nodes == nodes
        rows, columns = plan.control.room
        assert 0 < rows < size / 8 and 0 < columns <= size / 8, "around the fluid only"


@pytest.mark.slow
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


CHOICES, BUNDLES = 12, 5
take = jax.jit(select_under_budget)


@given(seed=st.integers(0, 2**32 - 1), octaves=st.floats(0.1, 20), budget=st.floats(1e-6, 1e3))
def test_the_budget_is_kept_and_dearer_choices_are_the_ones_left(seed, octaves, budget):
    rng = np.random.default_rng(seed)
    variance = np.float32(2.0 ** rng.uniform(-octaves, octaves, (CHOICES, BUNDLES)))
    gain, allowed = np.float32(rng.integers(1, 100, variance.shape)), rng.random(variance.shape) < 0.8
    budgets = np.full(BUNDLES, budget, np.float32)
    taken, total = map(np.asarray, take(variance, gain, allowed, budgets))
    assert not taken[~allowed].any()
    assert (total <= budgets).all()
    np.testing.assert_allclose(np.where(taken, variance, 0).sum(0), total, rtol=1e-5)
    affordable = allowed & (variance <= budgets)
    price = np.log2(variance) - np.log2(gain)
    dearest = np.where(taken, price, -np.inf).max(0)
    assert (price[affordable & ~taken] >= np.broadcast_to(dearest, price.shape)[affordable & ~taken] - 1e-5).all()
    all_fit = np.where(affordable, variance, 0).sum(0) <= 0.999 * budgets
    np.testing.assert_array_equal(taken[:, all_fit], affordable[:, all_fit])


def test_nothing_fits_into_no_budget():
    ones = np.ones((CHOICES, BUNDLES), np.float32)
    taken, total = map(np.asarray, take(ones, ones, ones > 0, np.zeros(BUNDLES, np.float32)))
    assert not taken.any() and not total.any()


NODE_SAMPLES = 2
PLENTY = np.full(1, 1e6, np.float32)

chosen = jax.jit(choose_spacing, static_argnums=3, compiler_options=QUICKLY)


def test_straight_light_is_spaced_as_widely_as_groups_allow():
    taken = np.ones((14, 1), bool)
    taken[5] = False
    level, spent = chosen(taken, np.zeros((14, 1), np.float32), PLENTY, NODE_SAMPLES)
    assert np.asarray(level)[:, 0].tolist() == [2, 2, 2, 2, 0, 0, 1, 1, 2, 2, 2, 2, 1, 1]
    assert 0 < float(spent[0]) < 1e-8


def test_what_bends_is_spaced_only_as_far_as_the_budget_goes():
    bend = np.float32([[1e-3]] * 4 + [[1.0]] * 4)
    level, spent = chosen(np.ones((8, 1), bool), bend, np.full(1, 0.01, np.float32), NODE_SAMPLES)
    assert np.asarray(level)[:, 0].tolist() == [2] * 4 + [0] * 4
    assert float(spent[0]) <= 0.01
    level, spent = chosen(np.ones((8, 1), bool), bend, np.zeros(1, np.float32), NODE_SAMPLES)
    assert not np.asarray(level).any() and not np.asarray(spent).any()


def test_bands_of_fewer_slabs_than_a_group():
    level, _ = chosen(np.ones((1, 1), bool), np.zeros((1, 1), np.float32), PLENTY, NODE_SAMPLES)
    assert not np.asarray(level).any()
