"""Transformations outside of any `jit`: they compile once, let go of nothing that is not ours, and keep to the default device."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from forced import ran

import jaxsph as js
from jaxsph.engine.runtime import programs


def test_a_gradient_without_jit_compiles_the_first_time_only_and_is_that_with_it(frames, compiled):
    rng = np.random.default_rng(0)
    scene, camera, plan = frames.scene(rng), frames.camera(rng), frames.plan()

    def total(extinction):
        look = dataclasses.replace(scene.transfer, extinction=extinction)
        return js.render(dataclasses.replace(scene, transfer=look), camera, frames.settings, plan=plan).color.sum()

    slope = jax.grad(total)
    first = slope(scene.transfer.extinction)
    slope(scene.transfer.extinction * 1.5)
    compiled.clear()
    maps = programs.in_use()
    for step in range(4):
        slope(scene.transfer.extinction * (1 + 0.01 * step)).block_until_ready()
    assert not compiled
    assert maps is None or programs.in_use() <= maps + 16
    jitted = jax.jit(slope, compiler_options=QUICKLY)
    np.testing.assert_allclose(first, jitted(scene.transfer.extinction), rtol=1e-4, atol=1e-5)


def test_caches_of_others_are_never_cleared(monkeypatch):
    """However crowded a process is: its own programs go, and it is told what else holds memory maps."""
    traced = []

    @jax.jit
    def of_another(x):
        traced.append(x)
        return x + 1

    of_another(1.0)
    ours, emptied = programs.Programs(), []
    monkeypatch.setattr(programs, "_LET_GO", [lambda: emptied.append(True)])
    monkeypatch.setattr(programs, "crowded", lambda: True)
    with pytest.warns(UserWarning, match=r"not jaxsph's own.*jax\.clear_caches"):
        ours.make_room()
    of_another(2.0)
    assert len(traced) == 1 and emptied


def test_programs_are_compiled_anew_under_another_flag_of_jax():
    ours = programs.Programs()
    double = jax.jit(lambda x: 2 * x)
    given = (jnp.ones(3, jnp.float32),)
    kept = ours.get(double, given, {})
    assert ours.get(double, given, {}) is kept
    for context in (jax.default_matmul_precision("highest"), jax.debug_nans(True), jax.default_device(jax.devices()[0])):
        with context:
            assert ours.get(double, given, {}) is not kept


DEVICES = """
import json, jax, numpy as np, jaxsph as js
def image():
    rng = np.random.default_rng(0)
    particles = js.Particles.from_arrays(rng.uniform(-1, 1, (20, 3)), 0.5, 0.0)
    scene = js.Scene(particles=particles, transfer=js.TransferFunction.from_points([0.0], [[1, 1, 1]], [1.0]))
    camera = js.Camera.look_at((0, 0, 5), (0, 0, 0), width=8, height=8, near=3, far=7)
    return js.render(scene, camera, js.Settings(samples=8))
found = []
for nth in (0, 1, 0):
    with jax.default_device(jax.devices()[nth]):
        found.append([device.id for device in image().color.devices()])
print(json.dumps(found))
"""


def test_frames_are_rendered_on_the_default_device_whatever_was_compiled_before():
    assert ran(DEVICES, devices=2) == [[0], [1], [0]]
