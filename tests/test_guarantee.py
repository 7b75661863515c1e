"""The guarantee: error <= error_bound <= tolerance on every pixel, whatever the scene; where nothing is saved, the same bits."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.control.adapt import ControlPlan

ADAPTIVE = {
    "budget": ControlPlan(True, True, "budget"),
    "greedy": ControlPlan(False, True, "greedy", 4),
}


@functools.partial(jax.jit, static_argnames="plan")
def jitted(scene, camera, settings, *, plan):
    return js.render(scene, camera, settings, plan=plan)


def error_of(image, truth):
    """Largest difference of a colour channel or of alpha, each pixel."""
    color = np.abs(np.asarray(image.color, np.float64) - np.asarray(truth.color, np.float64)).max(-1)
    return np.maximum(color, np.abs(np.asarray(image.transmittance, np.float64) - np.asarray(truth.transmittance, np.float64)))


def wide(scene, rng):
    """Particles that fill the view: cells that are covered, and vary little, so that something can be saved."""
    particles = scene.particles
    support = particles.support * float(rng.choice([2, 6]))
    quantity = 0.3 + float(rng.choice([0, 1e-3, 0.03])) * particles.quantity
    return dataclasses.replace(scene, particles=dataclasses.replace(particles, support=support, quantity=quantity))


@pytest.mark.parametrize(("dtype", "kernel", "how", "projection", "render"), [
    (np.float64, "poly6", "budget", "perspective", js.render), (np.float32, "poly6", "budget", "perspective", jitted),
    (np.float64, "wendland_c2", "greedy", "orthographic", js.render),
    pytest.param(np.float64, "poly6", "budget", "orthographic", jitted, marks=pytest.mark.slow),
    pytest.param(np.float32, "poly6", "budget", "orthographic", jitted, marks=pytest.mark.slow),
    pytest.param(np.float64, "wendland_c2", "greedy", "perspective", jitted, marks=pytest.mark.slow),
])  # fmt: skip
@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), digits=st.floats(1, 5), smooth=st.booleans())
def test_errors_keep_to_their_bound_and_the_bound_to_the_tolerance(
    frames, adversary, dtype, kernel, how, projection, render, seed, digits, smooth
):
    rng = np.random.default_rng(seed)
    with jax.enable_x64(dtype is np.float64):
        scene, camera = adversary.scene(rng, kernel, dtype), adversary.camera(rng, projection, dtype)
        scene = wide(scene, rng) if smooth else scene
        plan, tolerance = frames.plan(), float(dtype(10**-digits))
        control = ADAPTIVE[how]
        asked = dataclasses.replace(
            frames.settings, tolerance=tolerance, super_pixels=control.super_pixels, allocation=control.allocation
        )
        truth = render(scene, camera, frames.settings, plan=plan)
        image = render(scene, camera, asked, plan=dataclasses.replace(plan, control=control))
        bound, error = np.asarray(image.error_bound), error_of(image, truth)
    assert image.certified
    assert (error <= bound).all(), f"{error.max()} > {bound[error > bound].max()}"
    assert (bound <= tolerance).all()
    assert float(image.stats["evaluations"]) <= float(image.stats["evaluations_full"])
    assert int(image.faults) == 0


@pytest.mark.parametrize("relax", [0.0, 1.0])
@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_smaller_tolerance_never_spends_less_and_more_relaxation_never_more(frames, adversary, relax, seed):
    rng = np.random.default_rng(seed)
    scene, camera = wide(adversary.scene(rng, "poly6", np.float32), rng), adversary.camera(rng, "perspective", np.float32)
    plan = dataclasses.replace(frames.plan(), control=ADAPTIVE["budget"])

    def spent(tolerance, relax):
        asked = dataclasses.replace(frames.settings, tolerance=tolerance, relax=relax)
        return np.asarray(js.render(scene, camera, asked, plan=plan).evaluations)

    work = [spent(tolerance, relax) for tolerance in (1e-5, 1e-3, 1e-2, 0.1, 1.0)]
    assert all((more >= less).all() for more, less in itertools.pairwise(work))
    relaxed = [spent(1e-2, share).sum() for share in (0.0, 0.5, 1.0)]
    assert relaxed[0] >= relaxed[1] >= relaxed[2]


def test_something_is_saved_where_the_fluid_is_smooth(frames):
    rng = np.random.default_rng(3)
    scene, camera = frames.scene(rng), frames.camera(rng)
    particles = dataclasses.replace(scene.particles, support=scene.particles.support * 0 + 2.5)
    scene = dataclasses.replace(scene, particles=dataclasses.replace(particles, quantity=0.3 + 1e-3 * particles.quantity))
    for control, least in ((ADAPTIVE["budget"], 0.3), (ADAPTIVE["greedy"], 0.2)):
        asked = dataclasses.replace(
            frames.settings, tolerance=0.02, super_pixels=control.super_pixels, allocation=control.allocation
        )
        image = js.render(scene, camera, asked, plan=dataclasses.replace(frames.plan(), control=control))
        assert 1 - float(image.stats["evaluations"]) / float(image.stats["evaluations_full"]) > least


@pytest.mark.parametrize("tolerance", [0.0, 1e-12])
def test_full_rate_asked_for_is_the_reference_image_bit_for_bit(frames, tolerance):
    rng = np.random.default_rng(1)
    scene, camera = frames.scene(rng), frames.camera(rng)
    asked = dataclasses.replace(frames.settings, tolerance=tolerance)
    plan = frames.plan()
    truth = js.render(scene, camera, frames.settings, plan=plan)
    image = js.render(scene, camera, asked, plan=dataclasses.replace(plan, control=ADAPTIVE["budget"]))
    assert np.array_equal(image.color, truth.color) and np.array_equal(image.transmittance, truth.transmittance)
    assert not np.asarray(image.error_bound).any() and image.certified
    assert image.stats["evaluations"] == image.stats["evaluations_full"] == truth.stats["evaluations"]


@pytest.mark.parametrize("projection", ["perspective", pytest.param("orthographic", marks=pytest.mark.slow)])
def test_a_constant_quantity_costs_nothing_inside_and_errs_by_rounding_only(frames, projection):
    rng = np.random.default_rng(5)
    scene, camera = frames.scene(rng), frames.camera(rng, projection)
    particles = scene.particles
    constant, support = jnp.full_like(particles.quantity, 0.61), jnp.full_like(particles.support, 2)
    particles = dataclasses.replace(particles, quantity=constant, support=support)
    scene = dataclasses.replace(scene, particles=particles)
    plan, asked = frames.plan(), dataclasses.replace(frames.settings, tolerance=1e-3)
    truth = js.render(scene, camera, frames.settings, plan=plan)
    image = js.render(scene, camera, asked, plan=dataclasses.replace(plan, control=ADAPTIVE["budget"]))
    assert image.stats["evaluations"] < 0.6 * image.stats["evaluations_full"]
    error = error_of(image, truth)
    assert (error <= np.asarray(image.error_bound)).all() and error.max() < 1e-4


def test_relaxing_gives_up_the_certificate(frames):
    rng = np.random.default_rng(1)
    scene, camera = frames.scene(rng), frames.camera(rng)
    asked = dataclasses.replace(frames.settings, tolerance=0.01, relax=0.5)
    image = js.render(scene, camera, asked, plan=dataclasses.replace(frames.plan(), control=ADAPTIVE["budget"]))
    assert image.certified is False


def test_changing_tolerance_and_relaxation_compiles_nothing(frames):
    rng = np.random.default_rng(1)
    scene, camera, traces = frames.scene(rng), frames.camera(rng), []
    plan = dataclasses.replace(frames.plan(), control=ADAPTIVE["budget"])

    @jax.jit
    def render(settings):
        traces.append(1)
        return js.render(scene, camera, settings, plan=plan).color

    for tolerance, relax in ((0.1, 0.0), (0.01, 0.5), (1e-3, 1.0)):
        render(dataclasses.replace(frames.settings, tolerance=tolerance, relax=relax))
    assert len(traces) == 1


@pytest.mark.parametrize("merge", [True, False])
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
    assert float(truth.alpha.max()) > 0
    assert (error_of(image, truth) <= np.asarray(image.error_bound)).all()
    assert float(image.error_bound.max()) <= 0.01
