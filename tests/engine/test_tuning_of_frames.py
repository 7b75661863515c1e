"""Tuned for another kind of machine, a frame is the same picture, and is differentiable."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.runtime.tuning import ACCELERATOR, CPU, memory_for, tuning_for

LAYERS = "color", "transmittance", "error_bound"


def test_a_plan_is_tuned_for_the_device_that_holds_the_particles():
    scene, camera = js.scenes.load("mixer", 200, width=20, height=20)
    here = scene.particles.position
    assert js.plan(scene, camera).cast.tuning == tuning_for(here)
    assert here.devices().pop().platform != "cpu" or (tuning_for(here) == CPU and memory_for(here) == 4 << 30)


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {},
        pytest.param({"tolerance": 0.05}, marks=pytest.mark.slow),
        pytest.param({"tolerance": 0.02, "estimator": "pilot"}, marks=pytest.mark.slow),
        pytest.param({"tolerance": 0.3, "relax": 0.5}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_images_under_both_tunings_agree(settings):
    scene, camera = js.scenes.load("mixer", width=120, height=97)
    wanted = js.Settings(samples=96, **settings)
    plans = [js.plan(scene, camera, wanted, tuning=tuning) for tuning in (CPU, ACCELERATOR)]
    assert plans[0].bands == plans[1].bands and plans[0] != plans[1]
    usual, other = (js.render(scene, camera, wanted, plan=plan) for plan in plans)
    for layer in LAYERS:
        np.testing.assert_allclose(getattr(other, layer), getattr(usual, layer), atol=1e-6)
    depths = np.asarray(usual.depth), np.asarray(other.depth)
    assert (np.isfinite(depths[0]) != np.isfinite(depths[1])).mean() < 1e-3
    both = np.isfinite(depths[0]) & np.isfinite(depths[1])
    np.testing.assert_allclose(depths[1][both], depths[0][both], rtol=1e-5)
    assert np.asarray(usual.alpha).max() > 0.5


@pytest.mark.slow
def test_gradients_under_both_tunings_agree(x64):
    """In float64, and with no quantity on a control point, of which rounding would decide the side."""
    scene, camera = jax.tree.map(
        lambda leaf: leaf.astype(np.float64) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf,
        js.scenes.load("mixer", 500, width=24, height=21),
    )
    quantity = np.random.default_rng(0).uniform(0.02, 0.98, scene.particles.capacity)
    settings, found = js.Settings(samples=32), []
    for tuning in (CPU, ACCELERATOR):
        plan = js.plan(scene, camera, settings, tuning=tuning)

        def light(quantity, plan=plan):
            particles = dataclasses.replace(scene.particles, quantity=quantity)
            image = js.render(dataclasses.replace(scene, particles=particles), camera, settings, plan=plan)
            return image.color.sum() + image.transmittance.sum()

        found.append(np.asarray(jax.jit(jax.grad(light))(quantity)))
    np.testing.assert_allclose(*found, rtol=1e-9, atol=1e-12 * np.abs(found[0]).max())
    assert np.abs(found[0]).max() > 0
