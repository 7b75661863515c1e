"""One process renders any number of shapes: what it holds of memory and of memory maps levels off."""

from __future__ import annotations

import dataclasses
import gc
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.runtime import programs

FRAMES_PER_SHAPE = 10
ESTIMATORS = ({}, {"tolerance": 0.01, "estimator": "interval", "super_pixels": False}, {"tolerance": 0.01, "estimator": "pilot"})


def resident() -> int:
    """Bytes of memory that this process holds; 0 where that cannot be known."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * 4096


def render_shape(nth: int) -> None:
    """Frames of one shape by all estimators in turn, and a gradient, each compiled for it."""
    width, samples = 64 + nth, 32 + nth % 16
    scene, camera = js.scenes.load("radial", particles=400 + 40 * nth, width=width, height=64)
    for frame in range(FRAMES_PER_SHAPE - 1):
        settings = js.Settings(samples=samples, **ESTIMATORS[frame % len(ESTIMATORS)])
        image = js.render(scene, camera, settings)
        assert image.faults == 0 and np.isfinite(np.asarray(image.color)).all() and np.asarray(image.alpha).max() > 0.1
    settings = js.Settings(samples=samples)
    plan = js.plan(scene, camera, settings)

    def light(extinction: jax.Array) -> jax.Array:
        transfer = dataclasses.replace(scene.transfer, extinction=extinction)
        return js.render(js.Scene(particles=scene.particles, transfer=transfer), camera, settings, plan=plan).color.sum()

    slope = jax.jit(jax.grad(light))(scene.transfer.extinction)
    assert np.isfinite(np.asarray(slope)).all() and np.abs(np.asarray(slope)).max() > 0


@pytest.mark.parametrize("shapes", [pytest.param(6, marks=pytest.mark.slow), pytest.param(50, marks=pytest.mark.endurance)])
def test_frames_of_many_shapes_in_one_process(capsys, shapes):
    """Ten of each shape, by three estimators and with gradients; 33 shapes used to end the process."""
    maps, held = [], []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that JAX is made to forget is what is wanted here
        for nth in range(shapes):
            render_shape(nth)
            gc.collect()
            maps.append(programs.in_use() or 0)
            held.append(resident())
            with capsys.disabled():
                print(f"{nth + 1} shapes: {maps[-1]} memory maps, {held[-1] / 2**20:.0f} MiB", flush=True)
    limit = programs.limit() or 1 << 62
    assert max(maps) < 0.7 * limit
    early, late = slice(0, (shapes + 1) // 2), slice((shapes + 1) // 2, None)
    if shapes > 10:  # before that, programs are still gathered
        assert max(maps[late]) <= 1.2 * max(maps[early])
        assert max(held[late]) <= 1.35 * max(held[early])
