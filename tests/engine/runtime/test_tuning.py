"""Sizes suit the machine, change no bit of an image, and are refused where they make no sense."""

from __future__ import annotations

import dataclasses
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from images import same_bits

import jaxsph as js
from jaxsph.engine.runtime.tuning import ACCELERATOR, CPU, MAX_SHARDS, MEMORY, memory_for, shards_at_hand, tuning_for

SIZES = [field.name for field in dataclasses.fields(CPU) if field.name != "fusion_barriers"]


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("value", [0, -4])
def test_sizes_below_one_are_refused_by_name(size, value):
    with pytest.raises(ValueError, match=f"`{size}` must be at least 1, got {value}"):
        dataclasses.replace(CPU, **{size: value})


@pytest.mark.parametrize(("cores", "bundles", "shards"), [
    (1, 4096, 1), (2, 4096, 2), (3, 4096, 2), (7, 4096, 4), (16, 4096, 16), (16, 4 * 31 * 31, 4), (24, 4 * 30 * 31, 8),
    (200, 4096, MAX_SHARDS), (16, 4, 4),
])  # fmt: skip
def test_shards_are_as_many_as_cores_but_divide_the_band(monkeypatch, cores, bundles, shards):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)
    assert shards_at_hand(CPU, bundles) == shards
    assert bundles % shards == 0
    assert shards_at_hand(CPU) == min(shards, 4), "a tile has four bundles"
    assert shards_at_hand(ACCELERATOR) == 1


@dataclasses.dataclass(frozen=True)
class Held:
    """An array, as far as its devices are asked for."""

    platform: str
    memory: int | None = None

    def devices(self):
        return {self}

    def memory_stats(self):
        return None if self.memory is None else {"bytes_limit": self.memory}


def test_what_is_on_an_accelerator_is_tuned_for_one_and_may_take_half_of_it():
    assert tuning_for(jnp.zeros(1)) is (CPU if jnp.zeros(1).devices().pop().platform == "cpu" else ACCELERATOR)
    for platform in ("gpu", "tpu"):
        assert tuning_for(Held(platform)) is ACCELERATOR
        assert memory_for(Held(platform, 80 << 30)) == 40 << 30
    assert tuning_for(Held("cpu", 1 << 30)) is CPU
    assert memory_for(Held("cpu", 1 << 30)) == memory_for(Held("gpu")) == MEMORY


SMALL = {"samples_at_once": 64, "samples_held": 256, "bundles_composited": 8, "half_depths_found": 4, "cells_of_nodes": 16}


def test_how_much_is_done_at_once_changes_no_bit_of_few_particles(frames, quick_programs):
    rng, images = np.random.default_rng(0), []
    scene, camera, usual = frames.scene(rng), frames.camera(rng), frames.plan()
    small = dataclasses.replace(usual.cast.tuning, **SMALL)
    for change in ({}, {"tuning": small}, {"batch_slabs": 16}, {"batch_slabs": 1024}):
        plan = dataclasses.replace(usual, cast=dataclasses.replace(usual.cast, **change))
        images.append(js.render(scene, camera, frames.settings, plan=plan))
    assert np.asarray(images[0].alpha).max() > 0.1
    for image in images[1:]:
        same_bits(image, images[0], "color", "transmittance", "depth", "evaluations")


@pytest.mark.slow
@pytest.mark.parametrize("asked", [{}, {"tolerance": 0.02, "estimator": "pilot"}])
def test_how_much_is_done_at_once_changes_no_bit(asked):
    scene, camera = js.scenes.load("radial", 2000, width=72, height=60)
    settings, images = js.Settings(samples=64, **asked), []
    for tuning in (CPU, dataclasses.replace(CPU, **SMALL)):
        plan = js.plan(scene, camera, settings, tuning=tuning)
        assert plan.cast.tuning == tuning
        images.append(js.render(scene, camera, settings, plan=plan))
    assert np.asarray(images[0].alpha).max() > 0.1
    same_bits(*images, "color", "transmittance", "depth", "error_bound", "evaluations")


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
