"""The guarantee: error <= error_bound <= tolerance on every pixel, whatever the scene; where nothing is saved, the same bits."""

import dataclasses
import functools
import itertools

import jax
import numpy as np
import pytest
from adversary import cameras, scenes
from examples import examples
from hypothesis import given, strategies as st, target
from images import error_of

import jaxsph as js
from jaxsph.engine.control.adapt import ControlPlan
from jaxsph.numerics.checks import array_of
from jaxsph.reference.where import ray_coordinates, to_view

pytestmark = pytest.mark.usefixtures("quick_programs")

ADAPTIVE = {
    "budget": ControlPlan(True, True, "budget"),
    "levels": ControlPlan(False, True, "budget"),
    "alone": ControlPlan(True, False, "greedy", 4),
    "greedy": ControlPlan(False, True, "greedy"),
}


@functools.partial(jax.jit, static_argnames="plan")
def jitted(scene, camera, settings, *, plan):
    return js.render(scene, camera, settings, plan=plan)


def wide(scene, factor, spread):
    """Particles that fill the view: cells that are covered, and vary little, so that something can be saved."""
    particles = scene.particles
    moved = {"support": np.asarray(particles.support) * factor, "quantity": 0.3 + spread * np.asarray(particles.quantity)}
    particles = dataclasses.replace(particles, **{name: array_of(part) for name, part in moved.items()})
    return dataclasses.replace(scene, particles=particles)


def asking(frames, tolerance, how, **more):
    control = ADAPTIVE[how]
    choices = {"super_pixels": control.super_pixels, "merge": control.merge, "allocation": control.allocation}
    return dataclasses.replace(frames.settings, tolerance=tolerance, **choices, **more)


def with_control(frames, how, slab_samples=4):
    return dataclasses.replace(frames.plan(slab_samples), control=ADAPTIVE[how])


def require_kept(image, truth, tolerance):
    bound, error = np.asarray(image.error_bound, np.float64), error_of(image, truth)
    known = np.isfinite(bound)
    assert known[np.isfinite(truth.error_bound)].all()  # all, but where a sample is beside a jump and no bound covers both sides
    assert bool(image.certified) == known.all() and int(image.faults) == 0
    assert (error <= bound).all(), f"{error.max()} > {bound[error > bound].max()}"
    assert (bound[known] <= tolerance).all(), f"{bound[known].max()} > {tolerance}"
    assert float(image.stats["evaluations"]) <= float(image.stats["evaluations_full"])


@pytest.mark.parametrize(("dtype", "kernel", "how", "slab_samples", "projection", "render"), [
    (np.float64, "poly6", "budget", 4, "perspective", js.render),
    pytest.param(np.float32, "poly6", "budget", 4, "perspective", js.render, marks=pytest.mark.core),
    pytest.param(np.float32, "wendland_c2", "alone", 16, "orthographic", js.render, marks=pytest.mark.slow),
    pytest.param(np.float32, "poly6", "levels", 4, "perspective", jitted, marks=pytest.mark.slow),
    pytest.param(np.float32, "cubic_spline", "greedy", 8, "perspective", js.render, marks=pytest.mark.slow),
    pytest.param(np.float64, "wendland_c2", "levels", 8, "orthographic", jitted, marks=pytest.mark.slow),
    pytest.param(np.float32, "poly6", "budget", 16, "orthographic", jitted, marks=pytest.mark.slow),
    pytest.param(np.float64, "cubic_spline", "alone", 4, "perspective", js.render, marks=pytest.mark.slow),
])  # fmt: skip
def test_errors_keep_to_their_bound_it_to_the_tolerance_and_what_can_be_saved_is(
    frames, dtype, kernel, how, slab_samples, projection, render
):
    frames = frames.deep(slab_samples)
    plan = frames.plan(slab_samples)
    smooth = st.none() | st.tuples(st.sampled_from([2.0, 6.0]), st.sampled_from([0.0, 1e-3, 0.03]))

    @examples(15)
    @given(scenes(kernel, dtype), cameras(frames, projection, dtype), st.floats(1, 5), smooth)
    def holds(scene, camera, digits, smooth):
        scene, tolerance = scene if smooth is None else wide(scene, *smooth), 10**-digits
        truth = render(scene, camera, frames.settings, plan=plan)
        image = render(scene, camera, asking(frames, tolerance, how), plan=with_control(frames, how, slab_samples))
        require_kept(image, truth, tolerance)
        bound = np.asarray(image.error_bound, np.float64)
        target(float((error_of(image, truth) / np.maximum(bound, 1e-12)).max()))

    with jax.enable_x64(dtype is np.float64):
        holds()
        # and in frames in which something can be saved, something is
        for make, least in ((behind_a_wall, 0.5), (half_constant, 0.1)):
            scene, camera = make(frames, kernel, projection, dtype)
            truth = render(scene, camera, frames.settings, plan=plan)
            image = render(scene, camera, asking(frames, 0.012, how), plan=with_control(frames, how, slab_samples))
            require_kept(image, truth, 0.012)
            assert float(image.stats["evaluations"]) < (1 - least) * float(image.stats["evaluations_full"])


STEEP = js.TransferFunction.from_points(np.linspace(0, 1, 5), np.linspace(0, 1, 15).reshape(5, 3), [0.1, 2.0, 0.5, 3.0, 500.0])


def in_view(camera, across, down, depth):
    """World positions of places in view space, lengths across and down as shares of the image's height."""
    high = np.asarray(camera.half_height) * (depth if camera.is_perspective else 1)
    return np.stack([2 * across * high, 2 * down * high, depth], -1) @ np.asarray(camera.axes) + np.asarray(camera.eye)


def behind_a_wall(frames, kernel, projection, dtype):
    """The end of a support as wide as the view is opaque; all else lies behind it."""
    rng = np.random.default_rng(7)
    camera, count = frames.camera(rng, projection, dtype=dtype), frames.capacity
    depth, (across, down) = rng.uniform(3.4, 4.4, count), rng.uniform(-0.5, 0.5, (2, count))
    across[0], down[0], depth[0] = 0, 0, 2.4 - 30
    support = np.append(30.0, rng.uniform(0.5, 0.7, count - 1))
    quantity = np.append(1.0, rng.uniform(0, 0.7, count - 1))
    columns = in_view(camera, across, down, depth), support, quantity, support**3
    particles = js.Particles.from_arrays(*(column.astype(dtype) for column in columns), kernel)
    return js.Scene(particles=particles, transfer=jax.tree.map(lambda leaf: np.asarray(leaf, dtype), STEEP)), camera


def half_constant(frames, kernel, projection, dtype, border=0.0):
    """One support that holds the view left of a border, a share of the image's height, and many of other quantities beyond."""
    rng = np.random.default_rng(8)
    camera, count = frames.camera(rng, projection, dtype=dtype), frames.capacity
    depth, (across, down) = rng.uniform(1.6, 4.4, count), rng.uniform([[0.35], [-0.5]], [[0.5], [0.5]], (2, count))
    across += border
    across[0], down[0], depth[0] = border - 6, 0, 3
    support = np.append(2 * 6 * float(camera.half_height) * (3 if camera.is_perspective else 1), rng.uniform(0.2, 0.3, count - 1))
    quantity = np.append(0.3, rng.uniform(0, 0.7, count - 1))
    columns = in_view(camera, across, down, depth), support, quantity, support**3
    particles = js.Particles.from_arrays(*(column.astype(dtype) for column in columns), kernel)
    return js.Scene(particles=particles, transfer=jax.tree.map(lambda leaf: np.asarray(leaf, dtype), STEEP)), camera


@pytest.mark.slow
@examples(10)
@given(
    data=st.data(),
    relax=st.sampled_from([0.0, 1.0]),
    factor=st.sampled_from([2.0, 6.0]),
    spread=st.sampled_from([0.0, 1e-3, 0.03]),
)
def test_a_smaller_tolerance_never_spends_less(frames, data, relax, factor, spread):
    frames = frames.deep(4)
    scene, camera = wide(data.draw(scenes("poly6", np.float32)), factor, spread), data.draw(cameras(frames, dtype=np.float32))

    def spent(tolerance):
        asked = asking(frames, tolerance, "budget", relax=relax)
        return np.asarray(js.render(scene, camera, asked, plan=with_control(frames, "budget")).evaluations)

    work = [spent(tolerance) for tolerance in (1e-5, 1e-3, 0.1)]
    assert all((more >= less).all() for more, less in itertools.pairwise(work))


@pytest.mark.parametrize("tolerance", [0.0, 1e-46, 1e-12])
def test_full_rate_asked_for_is_the_reference_image_bit_for_bit(frames, tolerance):
    rng, frames = np.random.default_rng(1), frames.deep(4)
    scene, camera = frames.scene(rng), frames.camera(rng)
    truth = js.render(scene, camera, frames.settings, plan=frames.plan())
    image = js.render(scene, camera, asking(frames, tolerance, "budget"), plan=with_control(frames, "budget"))
    assert np.array_equal(image.color, truth.color) and np.array_equal(image.transmittance, truth.transmittance)
    assert not np.asarray(image.error_bound).any() and image.certified
    assert image.stats["evaluations"] == image.stats["evaluations_full"] == truth.stats["evaluations"]
    assert set(np.unique(image.levels)) <= {0, -1}


@pytest.mark.core
def test_a_tolerance_of_all_there_is_is_kept(frames):
    frames = frames.deep(4)
    scene, camera = half_constant(frames, "poly6", "perspective", np.float32)
    truth = js.render(scene, camera, frames.settings, plan=frames.plan())
    image = js.render(scene, camera, asking(frames, 1.0, "budget"), plan=with_control(frames, "budget"))
    require_kept(image, truth, 1.0)
    assert image.stats["evaluations"] < 0.9 * image.stats["evaluations_full"]


@pytest.mark.parametrize("projection", ["perspective", pytest.param("orthographic", marks=pytest.mark.slow)])
def test_a_constant_quantity_costs_nothing_inside_and_errs_by_rounding_only(frames, projection):
    rng, frames = np.random.default_rng(5), frames.deep(4)
    scene, camera = frames.scene(rng), frames.camera(rng, projection)
    particles = scene.particles
    constant, support = np.full_like(particles.quantity, 0.61), np.full_like(particles.support, 2)
    particles = dataclasses.replace(particles, quantity=constant, support=support)
    scene = dataclasses.replace(scene, particles=particles)
    truth = js.render(scene, camera, frames.settings, plan=frames.plan())
    for tolerance in (1e-3, 1e-4):  # borders may cost what is allowed, and the inside is saved if next to nothing is
        image = js.render(scene, camera, asking(frames, tolerance, "budget"), plan=with_control(frames, "budget"))
        assert image.stats["evaluations"] < 0.6 * image.stats["evaluations_full"]
        error, bound = error_of(image, truth), np.asarray(image.error_bound)
        assert (error <= bound).all() and (bound <= tolerance).all()


@pytest.mark.core
def test_levels_say_what_each_slab_was_given(frames):
    """Against the particles themselves: a slab that is not at full rate holds one quantity only, an empty slab none at all."""
    frames = frames.deep(4)
    scene, camera = half_constant(frames, "poly6", "perspective", np.float32, border=0.1)
    plan = with_control(frames, "budget")
    image, slab_samples = js.render(scene, camera, asking(frames, 1e-3, "budget"), plan=plan), plan.cast.slab_samples
    levels = np.asarray(image.levels)
    assert levels.shape == (-(-frames.samples // slab_samples), -(-frames.height // 8), -(-frames.width // 8))
    least, most = quantities_in_slabs(scene, camera, frames.samples, slab_samples)
    empty = most < least
    assert (empty[levels == -1]).all()
    assert ((most - least)[levels > 0] <= 1e-6).all()
    assert (levels > 0).sum() >= 3 and (levels[~empty & (most > least + 0.01)] == 0).sum() >= 3 and (levels == -1).any()
    full = js.render(scene, camera, frames.settings, plan=frames.plan())
    assert full.levels is None
    spent, of_full = (np.asarray(one.evaluations)[::8, ::8] for one in (image, full))
    np.testing.assert_array_equal(spent == of_full, (levels <= 0).all(0))


def quantities_in_slabs(scene, camera, samples, slab_samples):
    """Least and greatest quantity among the particles that weigh at any sample of a slab, (slabs, rows, columns)."""
    s = js.reference.sample_depths(camera, samples)
    u, v = ray_coordinates(camera, np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    spread = s if camera.is_perspective else np.ones_like(s)
    shape = -(-samples // slab_samples), -(-camera.height // 8), -(-camera.width // 8)
    found = np.full((2, *shape), [[[[np.inf]]], [[[-np.inf]]]])
    particles = scene.particles
    for place, support, quantity in zip(
        to_view(particles.exact_position(), camera), np.asarray(particles.support), np.asarray(particles.quantity), strict=True
    ):
        away = (spread * u[:, None] - place[0]) ** 2 + (spread * v[:, None, None] - place[1]) ** 2 + (s - place[2]) ** 2
        for row, column, k in zip(*np.nonzero(away < support**2), strict=True):
            at = k // slab_samples, row // 8, column // 8
            found[0][at], found[1][at] = min(found[0][at], quantity), max(found[1][at], quantity)
    return found


@pytest.mark.core
def test_another_tolerance_pose_particle_or_transfer_function_compiles_nothing(frames, compiled):
    rng, frames = np.random.default_rng(4), frames.deep(4)
    js.render(frames.scene(rng), frames.camera(rng), asking(frames, 0.01, "budget"), plan=with_control(frames, "budget"))
    compiled.clear()
    for tolerance, relax in ((1e-4, 0.0), (0.3, 0.0), (0.01, 0.5)):
        asked = asking(frames, tolerance, "budget", relax=relax)
        js.render(frames.scene(rng), frames.camera(rng), asked, plan=with_control(frames, "budget"))
    assert not compiled


def test_relaxing_gives_up_the_certificate(frames):
    rng, frames = np.random.default_rng(1), frames.deep(4)
    scene, camera = frames.scene(rng), frames.camera(rng)
    image = js.render(scene, camera, asking(frames, 0.01, "budget", relax=0.5), plan=with_control(frames, "budget"))
    assert image.certified is False


@pytest.mark.slow
@pytest.mark.parametrize("merge", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_particle_that_only_a_coarse_sample_would_hit_is_counted(merge):
    """Supports smaller than a step lie between fine samples, in no slab's window, yet a coarse sample may sit on them."""
    camera = js.Camera.orthographic((0, 0, 0), (0, 0, 1), view_height=8.0, width=8, height=8, near=0.0, far=64.0)
    ray = np.array([0.5, 0.5])
    seen = np.array([[*ray, depth + 0.5] for depth in range(0, 16)])
    hidden = np.array([[*ray, depth] for depth in (4.0, 8.0, 12.0, 40.0, 56.0)])
    quantity = np.repeat([0.0, 1.0], [len(seen), len(hidden)])
    particles = js.Particles.from_arrays(np.concatenate([seen, hidden]), 0.1, quantity)
    transfer = js.TransferFunction.from_points([0.0, 1.0], [(0, 0, 0), (1, 1, 1)], [1e-5, 50.0])
    scene = js.Scene(particles=particles, transfer=transfer)
    asked = js.Settings(samples=64, tolerance=0.01, super_pixels=False, merge=merge)
    truth, image = js.render(scene, camera, js.Settings(samples=64)), js.render(scene, camera, asked)
    assert np.asarray(truth.alpha).max() > 0
    assert (error_of(image, truth) <= np.asarray(image.error_bound)).all()
    assert np.asarray(image.error_bound).max() <= 0.01
