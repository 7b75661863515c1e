"""Sizes suit the machine, change no bit of an image, and are refused where they make no sense."""

from __future__ import annotations

import dataclasses
import os

import jax.numpy as jnp
import numpy as np
import pytest

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
    for tuning in (usual.cast.tuning, dataclasses.replace(usual.cast.tuning, **SMALL)):
        plan = dataclasses.replace(usual, cast=dataclasses.replace(usual.cast, tuning=tuning))
        images.append(js.render(scene, camera, frames.settings, plan=plan))
    assert np.asarray(images[0].alpha).max() > 0.1
    for layer in ("color", "transmittance", "depth", "evaluations"):
        np.testing.assert_array_equal(*(np.asarray(getattr(image, layer)) for image in images))


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
    for layer in ("color", "transmittance", "depth", "error_bound", "evaluations"):
        np.testing.assert_array_equal(*(np.asarray(getattr(image, layer)) for image in images))
