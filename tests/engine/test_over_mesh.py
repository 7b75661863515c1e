"""Promises of jitted images over a mesh, in one process and in two: images and gradients of one device."""

import json

import pytest
from forced import begun, ended, free_port, ran

SCENE = """
import dataclasses, json, sys
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import AxisType
import jaxsph as js

def made(**given):
    scene, camera = js.scenes.load("checker_board", 2000, width=72, height=64)
    settings = js.Settings(samples=64, **given)
    return scene, camera, settings, js.plan(scene, camera, settings)

def looked(scene, camera, settings, plan, **given):
    weight = np.random.default_rng(0).uniform(size=(64, 72, 3)).astype(np.float32)
    move = np.random.default_rng(1).normal(size=scene.particles.quantity.shape).astype(np.float32)

    def total(quantity):
        there = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, quantity=quantity))
        image = js.render(there, camera, settings, plan=plan, **given)
        return (image.color * weight).sum(), image

    def both(quantity):
        (_, image), gradient = jax.value_and_grad(total, has_aux=True)(quantity)
        return image, gradient, jax.jvp(lambda q: total(q)[0], (quantity,), (move,))[1]

    return jax.jit(both)(np.asarray(scene.particles.quantity))

def compared(one, other):
    told = {}
    for layer in ("color", "transmittance", "error_bound", "evaluations"):
        ends = (np.nan_to_num(getattr(image, layer), nan=-1) for image in (one[0], other[0]))
        told[layer] = float(np.abs(next(ends) - next(ends)).max())
    told["gradient"] = float(np.abs(np.asarray(one[1]) - np.asarray(other[1])).max() / np.abs(np.asarray(one[1])).max())
    told["forward"] = float(abs(one[2] - other[2]) / abs(one[2]))
    told["shown"] = float(one[0].color.mean())
    return told
"""
MESHES = """
shape, kind, context = json.loads(sys.argv[1])
mesh = jax.make_mesh(tuple(shape), ("a", "b")[: len(shape)], axis_types=(getattr(AxisType, kind),) * len(shape))
given = made(**json.loads(sys.argv[2]))
one = looked(*given)
if context:
    jax.set_mesh(mesh)
print(json.dumps(compared(one, looked(*given, devices=mesh))))
"""
CONTROLLED = """
given = made(**json.loads(sys.argv[1]))
mesh = jax.make_mesh((4,), ("a",), axis_types=(AxisType.Auto,))
scene, camera, settings, plan = given
calm = 0.4 + 0.01 * scene.particles.quantity  # such that bounds save something
scene = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, quantity=calm))
one, other = (jax.jit(lambda s: js.render(s, camera, settings, plan=plan, devices=devices))(scene) for devices in (None, mesh))
told = {n: float(np.abs(np.nan_to_num(getattr(one, n), nan=-1) - np.nan_to_num(getattr(other, n), nan=-1)).max())
        for n in ("color", "transmittance", "error_bound", "evaluations")}
told["share"] = float(other.stats["evaluations"] / other.stats["evaluations_full"])
print(json.dumps(told))
"""
PROCESSES = """
port, process = sys.argv[1:3]
jax.distributed.initialize(f"localhost:{port}", 2, int(process))
mesh = jax.make_mesh((4,), ("a",), axis_types=(AxisType.Auto,))
scene, camera, settings, plan = made()
several = looked(scene, camera, settings, plan, devices=mesh)
one = looked(scene, camera, settings, plan)
told = compared(one, several)
told["processes"], told["devices"] = jax.process_count(), [len(jax.local_devices()), len(jax.devices())]
print(json.dumps(told))
"""
CLOSE = 1e-6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mesh", "given"),
    [
        (((4,), "Auto", False), {}),
        (((2, 2), "Auto", True), {"integrator": "segments"}),
        (((4,), "Explicit", False), {"integrator": "segments"}),
        (((2, 2), "Explicit", True), {}),
        (((3,), "Auto", False), {}),
    ],
    ids=str,
)
def test_over_any_mesh_images_and_gradients_are_those_of_one_device(mesh, given):
    told = ran(SCENE + MESHES, json.dumps(mesh), json.dumps(given))
    assert told.pop("shown") > 0.05
    assert all(off <= CLOSE for off in told.values()), told


@pytest.mark.slow
@pytest.mark.parametrize(
    "given",
    [
        {"tolerance": 0.1, "estimator": "interval"},
        {"tolerance": 0.1, "estimator": "pilot"},
        {"tolerance": 0.1, "screen": "quadtree"},
    ],
    ids=["bounds", "pilot", "quadtree"],
)
def test_decisions_for_a_whole_band_are_those_of_one_device(given):
    told = ran(SCENE + CONTROLLED, json.dumps(given))
    assert told["evaluations"] == 0 and max(told[layer] for layer in ("color", "transmittance", "error_bound")) <= CLOSE, told
    assert told["share"] < 1


@pytest.mark.slow
def test_two_processes_of_two_devices_make_the_image_and_the_gradients_of_one():
    port = str(free_port())
    processes = [begun(SCENE + PROCESSES, 2, port, str(nth)) for nth in range(2)]
    try:
        for told in [ended(process, 600) for process in processes]:
            assert told.pop("processes") == 2 and told.pop("devices") == [2, 4] and told.pop("shown") > 0.05
            assert all(off <= CLOSE for off in told.values()), told
    finally:
        for process in processes:
            process.kill()
