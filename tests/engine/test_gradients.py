"""Gradients of images: those of differences, the same in both modes, finite everywhere, zero for what is not there."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adversary import cameras, scenes
from derivatives import AGREE, CLOSE, STEP, along, anyhow, differ, filled, looked, pulled, stepped, towards, valued, weights
from examples import examples
from hypothesis import given
from hypothesis import strategies as st


def leaves_the_image(inputs, rng):
    """The particle that is farthest to the right moves out of the image."""
    scene, camera = inputs
    right, move = np.asarray(camera.axes)[0], np.zeros_like(scene.particles.position)
    move[np.argmax(np.asarray(scene.particles.position) @ right)] = right
    return {"position": move}


def turns(inputs, rng):
    """About all three axes: a tangent of rotations."""
    x, y, z = rng.normal(size=3)
    return {"axes": np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ np.asarray(inputs[1].axes)}


PHENOMENA = {
    "a particle leaves the image": leaves_the_image,
    "particles are stirred": anyhow("position"),
    "supports swell and shrink": anyhow("support"),
    "two colours cross": lambda inputs, rng: {"quantity": with_first(np.zeros_like(inputs[0].particles.quantity), [1, -1])},
    "particles gain volume": anyhow("volume"),
    "a band of the transfer function sweeps by": lambda inputs, rng: {"values": np.ones_like(inputs[0].transfer.values)},
    "control points part": anyhow("values"),
    "colours fade": lambda inputs, rng: {"colors": -np.asarray(inputs[0].transfer.colors)},
    "the fluid clears up": lambda inputs, rng: {"extinction": -np.asarray(inputs[0].transfer.extinction)},
    "the eye moves": anyhow("eye"),
    "the camera turns": turns,
    "the camera orbits": lambda inputs, rng: anyhow("eye")(inputs, rng) | turns(inputs, rng),
    "the field of view widens": lambda inputs, rng: {"half_height": np.ones(())},
    "samples move apart": anyhow("near", "far"),
}


@pytest.mark.parametrize("constant", [False, True])
def test_on_control_points_both_modes_have_the_slope_that_begins_there(frames, x64, constant):
    """Where quantities lie on kinks of the transfer function there are two slopes: every rule takes the same one."""
    rng = np.random.default_rng(11)
    (scene, camera), cotangent, plan = filled(frames, rng), weights(rng, frames), frames.plan()
    points = np.asarray(scene.transfer.values)
    quantity = np.full(frames.capacity, points[2]) if constant else rng.choice(points, frames.capacity)
    inputs = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, quantity=jnp.asarray(quantity))), camera
    names = "position", "support", "quantity", "volume", "values", "colors", "extinction", "eye"
    move = towards(inputs, anyhow(*names)(inputs, rng))
    _, pushed, gradient = looked(inputs, move, cotangent, frames.settings, plan)
    slope, size = along(gradient, move)
    assert pushed == pytest.approx(slope, abs=AGREE * size)
    if constant:
        up = towards(inputs, {"quantity": np.ones(frames.capacity)})
        ahead, here = (looked(stepped(inputs, up, by), up, cotangent, frames.settings, plan)[0] for by in (STEP, 0.0))
        slope, size = along(gradient, up)
        assert slope == pytest.approx(float(ahead - here) / STEP, abs=10 * STEP * (1 + size))


@pytest.mark.parametrize("phenomenon", PHENOMENA)
def test_gradients_are_those_of_differences_when(frames, x64, phenomenon):
    rng = np.random.default_rng(list(PHENOMENA).index(phenomenon))
    inputs, cotangent, plan = filled(frames, rng), weights(rng, frames), frames.plan()
    move = towards(inputs, PHENOMENA[phenomenon](inputs, rng))
    difference, pushed, gradient = differ(inputs, move, cotangent, frames.settings, plan)
    slope, size = along(gradient, move)
    assert difference != 0
    assert slope == pytest.approx(difference, abs=CLOSE * (1 + size))
    assert pushed == pytest.approx(slope, abs=AGREE * size)


@pytest.mark.slow
@pytest.mark.parametrize(("kernel", "projection"), [
    ("poly6", "perspective"), ("wendland_c2", "orthographic"),
    pytest.param("cubic_spline", "perspective", marks=pytest.mark.slow),
])  # fmt: skip
@examples(15)
@given(data=st.data(), seed=st.integers(0, 2**32 - 1))
def test_both_modes_agree_on_hard_scenes(frames, kernel, projection, data, seed):
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        scene = data.draw(scenes(kernel))
        # off all control points: at a jump or a kink itself there is no slope, and rounding takes either side
        quantity = scene.particles.quantity + 1e-4 * np.sqrt(2)
        scene = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, quantity=quantity))
        inputs = scene, data.draw(cameras(frames, projection))
        names = ("position", "support", "quantity", "volume", "values", "colors", "extinction", "eye", "axes", "half_height")
        move = towards(inputs, anyhow(*names)(inputs, rng))
        cotangent, plan = weights(rng, frames), frames.plan()
        _, pushed, gradient = looked(inputs, move, cotangent, frames.settings, plan)
        slope, size = along(gradient, move)
        assert np.isfinite(size)
        assert float(pushed) == pytest.approx(slope, abs=AGREE * size)


def with_particles(scene, **columns):
    return dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, **columns))


def alone(scene, count):
    """Only the first `count` particles exist."""
    return with_particles(scene, valid=np.arange(scene.particles.capacity) < count)


def with_first(column, value):
    """A column whose first entries are others."""
    column = np.array(column)
    column[: len(value)] = value
    return column


@functools.partial(jax.jit, static_argnames="samples")
def sample(camera, samples):
    """Where one is, on the ray of pixel (9, 10), which is the middle column's; and how far the next one is."""
    depth = camera.depth(jnp.asarray([18.5, 19.5]), samples)
    across, down = camera.column(jnp.asarray(10.5)), camera.row(jnp.asarray(9.5))
    view = jnp.stack([across * depth[0], down * depth[0], depth[0]])
    return camera.eye + view @ camera.axes, (depth[1] - depth[0]) * jnp.sqrt(1 + across**2 + down**2)


def at_a_sample(scene, camera, frames):
    """The first particle sits where a sample is."""
    place, _ = sample(camera, frames.samples)
    return with_particles(scene, position=with_first(scene.particles.position, place[None]))


def with_edge_at_a_sample(scene, camera, frames):
    """The first particle's support ends where the next sample of that ray is."""
    scene, (_, away) = at_a_sample(scene, camera, frames), sample(camera, frames.samples)
    return with_particles(scene, support=with_first(scene.particles.support, away[None]))


def of_extinction(factor):
    def change(scene, camera, frames):
        extinction = np.full_like(scene.transfer.extinction, factor)
        return dataclasses.replace(scene, transfer=dataclasses.replace(scene.transfer, extinction=extinction))

    return change


SPECIAL = {
    "a particle at a sample": at_a_sample,
    "a support that ends at a sample": with_edge_at_a_sample,
    "one particle": lambda scene, camera, frames: alone(at_a_sample(scene, camera, frames), 1),
    "empty space": lambda scene, camera, frames: alone(scene, 0),
    "no extinction": of_extinction(0.0),
    "what is opaque": of_extinction(1e30),
    "no volume": lambda scene, camera, frames: with_particles(scene, volume=with_first(scene.particles.volume, np.zeros(3))),
}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("special", SPECIAL)
def test_gradients_are_finite_with(frames, special, dtype):
    rng = np.random.default_rng(5)
    with jax.enable_x64(dtype is np.float64):
        scene, camera = frames.scene(rng, dtype=dtype), frames.camera(rng, dtype=dtype)
        inputs = SPECIAL[special](scene, camera, frames), camera
        cotangent = weights(rng, frames).astype(dtype)
        plan = frames.plan()
        gradient = (pulled if dtype is np.float64 else lambda *given: valued(*given)[1])(inputs, cotangent, frames.settings, plan)
        for part in jax.tree.leaves(gradient):
            assert part.dtype == jax.dtypes.float0 or (part.dtype == dtype and np.isfinite(part).all())
        if special == "empty space":
            assert not any(np.asarray(part).any() for part in jax.tree.leaves(gradient) if part.dtype != jax.dtypes.float0)
        if special == "no volume":
            particles = gradient[0].particles
            for part in map(np.asarray, (particles.position, particles.support, particles.quantity, particles.volume)):
                assert not np.any(part[:3]) and np.any(part[3:])


def test_single_precision_gives_the_same_gradients_but_for_rounding(frames):
    gradients = {}
    for dtype in (np.float64, np.float32):
        with jax.enable_x64(dtype is np.float64):
            rng = np.random.default_rng(1)
            scene, camera = filled(frames, rng, dtype)
            cotangent = weights(rng, frames).astype(dtype)
            given = (scene, camera), cotangent, frames.settings, frames.plan()
            gradients[dtype] = jax.tree.map(np.asarray, pulled(*given) if dtype is np.float64 else valued(*given)[1])
    for exact, rounded in zip(*(jax.tree.leaves(found) for found in gradients.values()), strict=True):
        if exact.dtype != jax.dtypes.float0:
            # to a camera's few numbers all samples add, and nearly cancel
            share = 1e-4 if exact.size > 9 else 5e-3
            assert np.linalg.norm(rounded - exact) <= share * max(np.linalg.norm(exact), 1e-3)


def test_padding_and_what_is_out_of_view_have_no_gradient(frames, x64):
    rng = np.random.default_rng(2)
    scene, camera = alone(frames.scene(rng, dtype=np.float64), 9), frames.camera(rng, dtype=np.float64)
    behind = np.array(scene.particles.position)
    behind[3] = np.asarray(camera.eye) - 5 * np.asarray(camera.axes)[2]
    scene = with_particles(scene, position=behind)
    gradient = pulled((scene, camera), weights(rng, frames), frames.settings, frames.plan())[0].particles
    for part in map(np.asarray, (gradient.position, gradient.support, gradient.quantity, gradient.volume)):
        assert not np.any(part[9:]) and not np.any(part[3])
        assert np.any(part[:9])
