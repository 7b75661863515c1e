"""Shards of a band that are cast side by side make the image that one would."""

from __future__ import annotations

import dataclasses
import os

import jax
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.access.grid import shard, shard_of_grid, unshard
from jaxsph.engine.control.adapt import ControlPlan

MANY = 8


@jax.jit
def there_and_back(bundles):
    """Shards by their number, and what they are put together to."""
    dealt = {shards: tuple(shard(bundles, nth, shards) for nth in range(shards)) for shards in (1, 2, 4, MANY)}
    return dealt, {shards: unshard(parts) for shards, parts in dealt.items()}


def test_what_is_dealt_out_is_put_back_in_its_place():
    bundles = {"last": np.arange(24, dtype=np.float32).reshape(3, 8), "only": np.arange(8)}
    dealt, found = there_and_back(bundles)
    for shards, parts in dealt.items():
        for nth, one in enumerate(parts):
            np.testing.assert_array_equal(one["last"], bundles["last"][:, nth::shards])
        for name, value in bundles.items():
            np.testing.assert_array_equal(found[shards][name], value)


def test_shards_are_put_back_along_any_axis():
    color, axes = np.arange(8.0**3, dtype=np.float32).reshape(8, 8, 8), (0, 1, -1)
    dealt = [tuple(np.moveaxis(np.moveaxis(color, axis, 0)[nth::MANY], 0, axis) for nth in range(MANY)) for axis in axes]
    for found in jax.jit(lambda dealt: [unshard(parts, axis) for parts, axis in zip(dealt, axes, strict=True)])(dealt):
        np.testing.assert_array_equal(found, color)


def test_the_grid_of_a_shard_is_that_of_its_bundles(frames, stages):
    rng = np.random.default_rng(0)
    grid, _ = stages(frames.scene(rng).particles, frames.camera(rng), plan=frames.plan())
    for nth, found in enumerate(jax.jit(lambda grid: [shard_of_grid(grid, of, 2) for of in range(2)])(grid)):
        for name in ("row", "column"):
            np.testing.assert_array_equal(getattr(found, name), np.asarray(getattr(grid, name))[nth::2])
        for name in ("start", "end"):
            np.testing.assert_array_equal(getattr(found.lists, name), np.asarray(getattr(grid.lists, name))[nth::2])
        for name in ("begin", "length", "count"):
            np.testing.assert_array_equal(getattr(found.windows, name), np.asarray(getattr(grid.windows, name))[..., nth::2])
        np.testing.assert_array_equal(found.lists.rank, grid.lists.rank)


@pytest.fixture
def on_cores(monkeypatch):
    """Have this process believe that it may use so many cores: an eager image is cast in as many shards."""
    return lambda cores: monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(cores)), raising=False)


def require_alike(images):
    for layer in ("color", "transmittance", "depth", "error_bound", "evaluations"):
        np.testing.assert_array_equal(*(np.asarray(getattr(image, layer)) for image in images))


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
    require_alike(images)


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
    require_alike(images)
