"""Promises about JAX: eager and jit are one image; without `jit` a transformation compiles once; x64 is never switched on."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from forced import ran

import jaxsph as js
from jaxsph.engine.runtime import programs
from jaxsph.numerics.checks import is_traced

pytestmark = pytest.mark.usefixtures("quick_programs")

ROUNDING = 64 * np.finfo(np.float32).eps  # programs differ in which products they fuse into a sum


def test_eager_and_jit_give_the_same_image_but_for_rounding(frames, traced):
    rng = np.random.default_rng(0)
    scene, camera, plan = frames.scene(rng), frames.camera(rng), frames.plan()
    eager = js.render(scene, camera, frames.settings, plan=plan)
    jitted = traced(scene, camera, plan)
    for layer in ("color", "transmittance", "depth", "evaluations"):
        np.testing.assert_allclose(getattr(eager, layer), getattr(jitted, layer), rtol=ROUNDING, atol=ROUNDING)
    assert int(jitted.faults) == 0
    assert int(jitted.stats["pairs"]) == eager.stats["pairs"]


@pytest.mark.slow
def test_jit_renders_in_bands_too(frames):
    rng = np.random.default_rng(0)
    scene, camera, whole = frames.scene(rng), frames.camera(rng), frames.plan()
    banded = dataclasses.replace(whole, bands=2, lists=dataclasses.replace(whole.lists, tile_rows=1))
    color = jax.jit(lambda s: js.render(s, camera, frames.settings, plan=banded).color)(scene)
    np.testing.assert_allclose(color, js.render(scene, camera, frames.settings, plan=whole).color, atol=ROUNDING)


def test_plans_of_similar_frames_are_equal(frames):
    rng = np.random.default_rng(0)
    scene = frames.scene(rng, decades=0)
    cameras = [
        js.Camera.look_at((3 * np.sin(a), 0, 3 * np.cos(a)), (0, 0, 0), width=64, height=64, near=1, far=5)
        for a in (0, 0.002, 0.004)
    ]
    assert len({js.plan(scene, camera, frames.settings) for camera in cameras}) == 1


def test_tracing_without_a_plan_says_how_to_make_one(frames):
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng), frames.camera(rng)
    with pytest.raises(ValueError, match=r"make it outside with `jaxsph.plan"):
        jax.jit(lambda s: js.render(s, camera, frames.settings).color)(scene)


def test_what_is_known_is_rendered_at_once_within_any_trace(frames):
    rng = np.random.default_rng(0)
    scene, camera, plan = frames.scene(rng), frames.camera(rng), frames.plan()
    wanted = js.render(scene, camera, frames.settings, plan=plan).color

    def target(given):
        made = dataclasses.replace(camera, eye=np.asarray(camera.eye).tolist())  # of numbers that are known, within the trace
        image = js.render(scene, made, frames.settings, plan=plan)
        assert image.certified is True and image.faults == 0
        return given * image.color

    ways = {
        "jit": jax.jit(target),
        "scan": lambda one: jax.lax.scan(lambda carry, _: (carry, target(carry)), one, None, length=2)[1][1],
        "grad": jax.jit(jax.grad(lambda one: target(one).sum())),
        "vmap": lambda one: jax.jit(jax.vmap(target))(jnp.stack([one, one]))[0],
    }
    for way, draw in ways.items():
        expected = wanted.sum() if way == "grad" else wanted
        np.testing.assert_allclose(draw(jnp.float32(1)), expected, rtol=1e-5, err_msg=way)


def test_a_scene_that_is_made_within_a_trace_of_numbers_is_known_there(frames):
    def framed(given):
        particles = js.Particles.from_arrays(np.eye(3), 0.5, np.ones(3))
        camera = js.Camera.along_axis(particles, width=21, height=18)
        assert not isinstance(camera.eye, jax.core.Tracer) and js.plan_projection(particles, camera).width == 21
        return given * js.project(particles, camera).total()

    assert float(jax.jit(framed)(2.0)) == pytest.approx(6, rel=1e-3)


def test_what_is_made_within_a_trace_of_what_an_accelerator_has_is_known_there():
    camera, box = js.Camera.look_at((3, 0, 0), (0, 0, 0), near=1, far=5), js.Box((0, 0, 0), (1, 1, 1))
    chosen = jax.device_put((js.Particles.from_arrays(np.eye(3), 0.5, np.ones(3)), camera, box), jax.devices()[0])
    particles, camera, box = chosen  # in arrays of a device that was chosen NumPy has no hand, either

    def made(given):
        moved = dataclasses.replace(camera, eye=[3, 1, 0]), dataclasses.replace(box, lower=np.float32([0, -1, 0]))
        few = particles.at([0, 2]), particles.padded(7)
        again = js.Particles.from_arrays(particles.position, particles.support, particles.quantity)
        assert not is_traced(moved, few, again, box.sides)
        return given * moved[1].sides

    np.testing.assert_array_equal(jax.jit(made)(np.float32(1)), (1, 2, 1))


@pytest.mark.parametrize("integrator", ["samples", "segments"])
def test_users_may_forbid_promotion_in_code_of_their_own(frames, integrator):
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng), frames.camera(rng)
    plan = dataclasses.replace(frames.plan(), integrator=integrator)
    settings = dataclasses.replace(frames.settings, integrator=integrator)
    draw = jax.jit(lambda one, seen_from: js.render(one, seen_from, settings, plan=plan).color.sum())
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        slopes = jax.eval_shape(jax.grad(draw, argnums=(0, 1), allow_int=True), scene, camera)  # rules are traced after `draw`
        made = js.TransferFunction.from_points([0, 1], [(1, 0, 0), (0, 0, 1)], [0, 1.5])
        assert js.plan(dataclasses.replace(scene, transfer=made), camera, settings).width == frames.width
        jax.eval_shape(lambda eye: js.Camera.look_at(eye, (0, 0, 0), near=1, far=5), camera.eye)
    assert slopes[0].particles.position.shape == scene.particles.position.shape


@pytest.mark.parametrize("dtype", [jnp.bfloat16, jnp.float16])
def test_scenes_of_half_floats_are_rendered_in_float32_and_their_slopes_are_half_floats(frames, dtype):
    rng = np.random.default_rng(0)
    scene, camera, plan = frames.scene(rng), frames.camera(rng), frames.plan()
    low = jax.tree.map(lambda leaf: leaf.astype(dtype) if leaf.dtype == jnp.float32 else leaf, scene)
    high = jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if leaf.dtype == dtype else leaf, low)
    draw = [js.render(one, camera, frames.settings, plan=plan).color for one in (low, high)]
    assert draw[0].dtype == jnp.float32
    np.testing.assert_array_equal(*draw)
    slope = jax.eval_shape(
        jax.grad(lambda one: js.render(one, camera, frames.settings, plan=plan).color.sum(), allow_int=True), low
    )
    assert slope.particles.position.dtype == slope.transfer.colors.dtype == dtype


@pytest.mark.parametrize("surface", [None, js.Surface(0.3)], ids=["medium", "surface"])
def test_float64_beside_float32_is_rendered_in_float64(frames, surface):
    with jax.enable_x64(True):
        rng = np.random.default_rng(0)
        scene = dataclasses.replace(frames.scene(rng), surface=surface)
        wide = dataclasses.replace(scene.particles, volume=scene.particles.volume.astype(jnp.float64))
        cameras = [frames.camera(np.random.default_rng(1), dtype=dtype) for dtype in (np.float64, np.float32)]
        for one, camera in ((scene, cameras[0]), (dataclasses.replace(scene, particles=wide), cameras[1])):
            plan = js.plan(one, camera, frames.settings)
            draw = functools.partial(js.render, settings=frames.settings, plan=plan)
            assert jax.eval_shape(draw, one, camera).color.dtype == jnp.float64


def test_rendering_leaves_x64_alone_and_float64_input_without_it_is_an_image_of_float32(frames):
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng, dtype=np.float64), frames.camera(rng, dtype=np.float64)
    image = js.render(scene, camera, frames.settings, plan=frames.plan())
    assert not jax.config.jax_enable_x64
    assert {getattr(image, name).dtype for name in ("color", "transmittance", "depth", "error_bound")} == {jnp.dtype("float32")}


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
