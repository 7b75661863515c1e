"""Arguments of the verbs are what they are called, or refused by name."""

import jax
import numpy as np
import pytest
from forced import ran

import jaxsph as js


@pytest.mark.parametrize("verb", [js.render, js.plan])
@pytest.mark.parametrize("wrong", ["scene", "camera", "settings", "swapped"])
def test_another_kind_of_argument_is_refused_by_name(frames, verb, wrong):
    rng = np.random.default_rng(0)
    scene, camera, settings = frames.scene(rng), frames.camera(rng), frames.settings
    given = {
        "scene": (scene.particles, camera, settings),
        "camera": (scene, "front", settings),
        "settings": (scene, camera, 64),
        "swapped": (camera, scene, settings),
    }
    name = "scene" if wrong == "swapped" else wrong
    with pytest.raises(ValueError, match=f"`{name}` must be a `jaxsph.{name.title()}`"):
        verb(*given[wrong])


def test_a_plan_of_another_kind_is_refused_by_name(frames):
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match=r"`plan` must be a plan, got Settings; make one with `jaxsph\.plan`"):
        js.render(frames.scene(rng), frames.camera(rng), plan=frames.settings)


def test_a_plan_is_any_argument_of_jit(frames):
    assert jax.tree.leaves(frames.plan()) == []
    assert jax.jit(lambda plan, number: number * plan.width)(frames.plan(), 2) == 2 * frames.width


def test_settings_of_several_numbers_are_for_vmap_alone(frames):
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="`tolerance` must be a single number"):
        js.render(frames.scene(rng), frames.camera(rng), js.Settings(tolerance=np.array([0.01])))


SHARDED = """
import dataclasses, json, jax, numpy as np, jaxsph as js
from jax.sharding import Mesh, NamedSharding, PartitionSpec
rng = np.random.default_rng(0)
particles = js.Particles.from_arrays(rng.uniform(-1, 1, (64, 3)), 0.3, 0.0)
place = NamedSharding(Mesh(np.array(jax.devices()), ("d",)), PartitionSpec("d"))
scene = js.Scene(particles=jax.device_put(particles, place), transfer=js.TransferFunction.from_points([0.0], [[1, 1, 1]], [1.0]))
try:
    js.render(scene, js.Camera.look_at((0, 0, 5), (0, 0, 0), width=8, height=8, near=3, far=7), js.Settings(samples=8))
except ValueError as error:
    print(json.dumps(str(error)))
"""


def test_particles_that_are_sharded_are_refused_by_name():
    said = ran(SHARDED, devices=2)
    assert said.startswith("`scene.particles.position` is sharded over 2 devices") and "`devices=`" in said


MAPPED = """
import dataclasses, json, jax, jax.numpy as jnp, numpy as np, jaxsph as js
from jax.sharding import Mesh, PartitionSpec
rng = np.random.default_rng(0)
particles = js.Particles.from_arrays(rng.uniform(-1, 1, (16, 3)), 0.4, 0.0)
scene = js.Scene(particles=particles, transfer=js.TransferFunction.from_points([0.0], [[1, 0.5, 1]], [1.0]))
camera = js.Camera.look_at((0, 0, 5), (0, 0, 0), width=8, height=8, near=3, far=7)
settings = js.Settings(samples=8)
plan = js.plan(scene, camera, settings, headroom=2)
eyes = jnp.asarray([(0.0, 0, 5), (0.3, 0.2, 5)], jnp.float32)

def picture(eye):
    return js.render(scene, dataclasses.replace(camera, eye=eye), settings, plan=plan).color

def mapped(**checked):
    over = {"mesh": Mesh(np.array(jax.devices()), ("d",)), "in_specs": PartitionSpec("d"), "out_specs": PartitionSpec("d")}
    return jax.jit(jax.shard_map(lambda eyes: jax.vmap(picture)(eyes), **over, **checked))(eyes)

try:
    mapped()
except NotImplementedError as error:
    said = str(error)
off = [float(abs(one - picture(eye)).max()) for one, eye in zip(mapped(check_vma=False), eyes)]
print(json.dumps([said, off]))
"""


def test_a_map_over_a_mesh_that_is_checked_is_refused_by_name_and_one_that_is_not_gives_the_images():
    said, off = ran(MAPPED, devices=2)
    assert "'d'" in said and "check_vma=False" in said
    assert max(off) <= 1e-5
