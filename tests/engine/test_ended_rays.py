"""Rays may end early, and what they leave out is in the error that is told."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from images import error_of

import jaxsph as js

pytestmark = pytest.mark.usefixtures("quick_programs")

ROUNDING = 1e-6
LEAST = 0.02


@pytest.fixture(scope="module")
def opaque():
    """A thick cloud, whose rays end soon."""
    rng = np.random.default_rng(5)
    particles = js.Particles.from_arrays(rng.uniform(-1, 1, (400, 3)).astype(np.float32), 0.5, rng.uniform(0, 1, 400))
    transfer = js.TransferFunction.from_points([0, 0.5, 1], [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [20.0, 40.0, 30.0])
    view = js.Camera.look_at((0, 0.2, -5), (0, 0, 0), width=40, height=36, near=3.2, far=6.8)
    return js.Scene(particles=particles, transfer=transfer), view


def settings(least=0.0, **more):
    return js.Settings(samples=96, min_transmittance=least, **more)


def small_batches(scene, view, given):
    """A plan whose batches are of few layers, as those of large images are."""
    plan = js.plan(scene, view, given)
    return dataclasses.replace(plan, cast=dataclasses.replace(plan.cast, chunk=8, batch_slabs=32))


def test_what_rays_leave_out_is_bounded_and_spares_evaluations(opaque):
    scene, view = opaque
    plan = small_batches(scene, view, settings())
    truth = js.render(scene, view, settings(), plan=plan)
    ended = js.render(scene, view, settings(LEAST), plan=plan)
    bound = np.asarray(ended.error_bound)
    assert (error_of(ended, truth) <= bound + ROUNDING).all() and bound.max() < LEAST
    assert ended.stats["evaluations"] < 0.8 * truth.stats["evaluations"] == 0.8 * ended.stats["evaluations_full"]
    followed = np.asarray(ended.transmittance) >= LEAST
    assert followed.any() and (bound[followed] == 0).all()
    assert ended.certified and np.asarray(truth.error_bound).max() == 0


@pytest.mark.slow
def test_a_tolerance_is_kept_together_with_what_is_left_out(opaque):
    scene, view = opaque
    given = settings(0.005, tolerance=0.02, estimator="interval")
    truth = js.render(scene, view, settings())
    image = js.render(scene, view, given, plan=small_batches(scene, view, given))
    assert (error_of(image, truth) <= np.asarray(image.error_bound) + ROUNDING).all()
    assert np.asarray(image.error_bound).max() <= 0.02


@pytest.mark.slow
def test_under_jit_and_by_a_quadtree_rays_end_too(opaque):
    scene, view = opaque
    given = settings(LEAST)
    plan = small_batches(scene, view, given)
    image = js.render(scene, view, given, plan=plan)
    traced = jax.jit(lambda shown, given: js.render(shown, view, given, plan=plan))(scene, given)
    assert (error_of(traced, image) <= LEAST).all()  # which of them end when depends on what is marched side by side
    assert float(traced.stats["evaluations"]) < 0.8 * image.stats["evaluations_full"]
    refined = js.render(scene, view, settings(LEAST, screen="quadtree"))
    assert (error_of(refined, image) <= 2 * LEAST).all()


@pytest.mark.slow
def test_derivatives_are_those_of_the_rays_as_they_end(opaque, x64):
    """What is left out has none; what is met has those of differences."""
    scene, view = opaque
    plan, given = small_batches(scene, view, settings(LEAST)), settings(LEAST)
    wide = jax.tree.map(lambda leaf: leaf.astype(float) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf, scene)

    def total(step):
        thicker = dataclasses.replace(wide.transfer, extinction=wide.transfer.extinction * (1 + step))
        image = js.render(dataclasses.replace(wide, transfer=thicker), view, given, plan=plan)
        return image.color[..., 0].sum() + 2 * image.transmittance.sum()  # not all of it, which stays the same

    gradient = jax.jit(jax.grad(total))(0.0)
    forward = jax.jit(lambda step: jax.jvp(total, (step,), (jnp.ones_like(step),))[1])(0.0)
    difference = (total(1e-7) - total(-1e-7)) / 2e-7
    assert float(gradient) == pytest.approx(float(forward), rel=1e-6)
    assert float(gradient) == pytest.approx(float(difference), rel=1e-3)
