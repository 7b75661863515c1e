"""Arguments of the verbs are what they are called, or refused by name."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from forced import ran

import jaxsph as js

pytestmark = pytest.mark.usefixtures("quick_programs")

RNG = np.random.default_rng(3)
CLIP = js.Plane((0, 0, 0), (0, 1, 0)) & ~js.Sphere((0, 0, 0), 0.5)
STARS = js.Points.from_arrays(
    RNG.uniform(-1, 1, (5, 3)) + 1e6, 0.2, extinction=1.0, profile=[1, 0.5, 0], attributes={"age": np.ones(5)}, splats_beyond=9
)
GAS = js.Particles.from_arrays(RNG.uniform(0, 1, (5, 3)), 0.2, (np.ones(5), np.ones(5)), box=(1, 1, 1))
LOOK = js.TransferFunction.from_points([0, 1], np.ones((2, 3)), [0, 1, 2], [0, 0.5, 1])
GRID = js.Volume.from_array(np.ones((2, 3, 4), np.uint8))
WHOLE = {
    "media": js.Scene(GAS, LOOK, (js.IsoSurface.from_volume(GRID, 0.5),), (GRID, GRID), (LOOK, LOOK), STARS, within=CLIP),
    "surface": js.Scene(GAS, surface=js.Surface(jnp.float32(0.3), color=jnp.ones(3))),
}
OPEN = js.Camera.look_at((0, 0, 1e7 + 0.1), (0, 0, 0), width=8, height=6, near=2, far=6)
LEAVES = [(whole, nth) for whole, scene in WHOLE.items() for nth in range(len(jax.tree.leaves((scene, OPEN))))]


@pytest.mark.parametrize(("whole", "nth"), LEAVES)
def test_a_leaf_of_another_shape_is_refused_by_name_whatever_it_belongs_to(whole, nth):
    paths, structure = jax.tree_util.tree_flatten_with_path((WHOLE[whole], OPEN))
    leaves = [jnp.asarray(leaf) for _, leaf in paths]
    names = [key.name for key in paths[nth][0] if hasattr(key, "name")]
    leaves[nth] = jnp.broadcast_to(leaves[nth], (2, *leaves[nth].shape))
    said = f"`{names[-1]}` of `[a-z_.\\[\\]0-9]+` must have shape .*, got"
    for verb in (js.render, js.plan):
        with pytest.raises(ValueError, match=said):
            verb(*jax.tree.unflatten(structure, leaves))
    with pytest.raises(ValueError, match=said):
        jax.eval_shape(js.render, *jax.tree.unflatten(structure, leaves))


@pytest.mark.parametrize(
    "fields", [{"near": 1.5}, {"eye": [0.1, 0.2, 3.0]}, {"axes": np.eye(3) * [1, 1, -1]}, {"half_height": 1}]
)
def test_a_camera_of_plain_numbers_is_that_of_arrays(frames, fields):
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng), js.Camera.look_at((0, 0, 3), (0, 0, 0), width=21, height=18, near=1, far=5)
    made = [dataclasses.replace(camera, **one) for one in (fields, {name: jnp.float32(value) for name, value in fields.items()})]
    plain, packed = (js.render(scene, one, frames.settings, plan=frames.plan()) for one in made)
    np.testing.assert_array_equal(plain.color, packed.color)


@pytest.mark.parametrize("part", ["particles", "transfer", "volume", "points", "surface", "within"])
def test_a_scene_of_labels_is_a_prefix_of_scenes_and_nothing_to_render(part):
    for label in ("freeze", 0, None):
        assert getattr(js.Scene(**{part: label}), part) == label
    with pytest.raises(ValueError, match=rf"`{part}` of `scene` must be a `jaxsph\.[A-Za-z]+`, got str"):
        js.render(dataclasses.replace(WHOLE["media"], **{part: "freeze"}), OPEN)
    for wrong in (np.ones((3, 3)), jnp.ones((3, 3)), 0.5, ["x"], {"x": 1}):
        with pytest.raises(ValueError, match=f"`{part}` must be a `jaxsph"):
            js.Scene(**{part: wrong})


def test_a_prefix_of_a_scene_says_what_vmap_goes_over(frames):
    scene = frames.scene(np.random.default_rng(0))
    several = dataclasses.replace(scene, transfer=jax.tree.map(lambda leaf: jnp.stack([leaf, leaf, leaf]), scene.transfer))
    over = jax.vmap(lambda one: one.transfer.values + one.particles.support[0], in_axes=(js.Scene(particles=None, transfer=0),))
    assert over(several).shape == (3, 5)


HOST = {
    "plan": lambda scene, camera: js.plan(scene, camera),
    "explain": lambda scene, camera: js.explain(scene, camera, pixel=(0, 0)),
    "progressive": lambda scene, camera: js.progressive(scene, camera),
    "visibility_histogram": lambda scene, camera: js.visibility_histogram(scene, camera),
    "slice": lambda scene, camera: js.slice(scene.particles, js.Plane((0, 0, 0), (0, 0, 1))),
    "resample": lambda scene, camera: js.resample(scene.particles, (0, 0, 0), 0.1, (3, 3, 3)),
    "plan_projection": lambda scene, camera: js.plan_projection(scene.particles, camera),
    "Camera.fitted": lambda scene, camera: js.Camera.fitted(scene),
    "Camera.framing": lambda scene, camera: js.Camera.framing(scene.particles),
    "Camera.along_axis": lambda scene, camera: js.Camera.along_axis(scene.particles),
    "Particles.bounds": lambda scene, camera: scene.particles.bounds(),
    "Particles.to_numpy": lambda scene, camera: scene.particles.to_numpy(),
    "render_tile": lambda scene, camera: js.scale.render_tile(scene, camera, index=0, count=1),
    "TransferFunction.preset": lambda scene, camera: js.TransferFunction.preset("density", scene.particles),
    "view": lambda scene, camera: js.view(scene, camera),
}


@pytest.mark.parametrize("name", HOST)
def test_verbs_of_the_host_refuse_by_name_what_is_traced(frames, name):
    scene, camera = frames.scene(np.random.default_rng(0)), frames.camera(np.random.default_rng(0))
    for transformed in (jax.eval_shape, lambda f, *given: jax.vmap(f)(*jax.tree.map(lambda leaf: leaf[None], given))):
        with pytest.raises(ValueError, match=f"`{name}` needs concrete arrays, and `[a-z]+` is traced: call it outside of jit"):
            transformed(HOST[name], scene, camera)


def test_another_kind_of_argument_is_refused_by_name(frames):
    rng = np.random.default_rng(0)
    scene, camera, settings = frames.scene(rng), frames.camera(rng), frames.settings
    for verb in (js.render, js.plan):
        for name, given in (
            ("scene", (scene.particles, camera, settings)),
            ("camera", (scene, "front", settings)),
            ("settings", (scene, camera, 64)),
            ("scene", (camera, scene, settings)),
        ):
            with pytest.raises(ValueError, match=f"`{name}` must be a `jaxsph.{name.title()}`"):
                verb(*given)
    for verb, name, wrong in ((js.render, "plan", settings), (js.plan, "like", "mine")):
        with pytest.raises(
            ValueError, match=rf"`{name}` must be a plan, got {type(wrong).__name__}; make one with `jaxsph\.plan`"
        ):
            verb(scene, camera, settings, **{name: wrong})


def test_a_plan_is_any_argument_of_jit(frames):
    assert jax.tree.leaves(frames.plan()) == []
    assert jax.jit(lambda plan, number: number * plan.width)(frames.plan(), 2) == 2 * frames.width


def test_settings_of_several_numbers_are_for_vmap_alone(frames):
    rng = np.random.default_rng(0)
    with pytest.raises(ValueError, match="`tolerance` must be a single number"):
        js.render(frames.scene(rng), frames.camera(rng), js.Settings(integrator="samples", tolerance=np.array([0.01])))


SHARDED = """
import dataclasses, json, jax, jax.numpy as jnp, numpy as np, jaxsph as js
from jax.sharding import Mesh, NamedSharding, PartitionSpec
rng = np.random.default_rng(0)
particles = js.Particles.from_arrays(rng.uniform(-1, 1, (64, 3)), 0.3, 0.0)
transfer = js.TransferFunction.from_points([0.0], [[1, 1, 1]], [1.0])
camera = js.Camera.look_at((0, 0, 5), (0, 0, 0), width=8, height=8, near=3, far=7)
plan = js.plan(js.Scene(particles=particles, transfer=transfer), camera, js.Settings(samples=8))
said = []
for mesh in (Mesh(np.array(jax.devices()), ("d",)), jax.make_mesh((2,), ("d",), axis_types=(jax.sharding.AxisType.Explicit,))):
    scene = js.Scene(particles=jax.device_put(particles, NamedSharding(mesh, PartitionSpec("d"))), transfer=transfer)
    draw = lambda scene: js.render(scene, camera, js.Settings(samples=8), plan=plan)
    for verb in (draw, jax.jit(draw)):
        try:
            verb(scene)
        except Exception as error:
            said.append(str(error))
"""
MAPPED = """
particles = js.Particles.from_arrays(rng.uniform(-1, 1, (16, 3)), 0.4, 0.0)
scene = js.Scene(particles=particles, transfer=js.TransferFunction.from_points([0.0], [[1, 0.5, 1]], [1.0]))
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
    checked = str(error)
off = [float(abs(one - picture(eye)).max()) for one, eye in zip(mapped(check_vma=False), eyes)]
print(json.dumps([said, checked, off]))
"""


@functools.cache
def on_two_devices():
    """What is said of particles that are sharded, and of a map that is checked; and how far images of one that is not are off."""
    return ran(SHARDED + MAPPED, devices=2)


def test_particles_that_are_sharded_are_refused_by_name_also_under_jit():
    said, *_ = on_two_devices()
    assert len(said) == 4
    for one in said:
        assert "`scene.particles.position` is sharded over 2 devices" in one and "`devices=`" in one


def test_a_map_over_a_mesh_that_is_checked_is_refused_by_name_and_one_that_is_not_gives_the_images():
    _, checked, off = on_two_devices()
    assert "'d'" in checked and "check_vma=False" in checked
    assert max(off) <= 1e-5
