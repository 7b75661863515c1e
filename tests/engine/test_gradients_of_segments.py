"""Gradients of images by segments: borders of supports move between samples and over them, and what is seen moves with them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adversary import cameras, scenes
from derivatives import AGREE, CLOSE, QUICKLY, along, anyhow, differ, looked, pulled, total, towards, valued, weights
from examples import examples
from hypothesis import assume, given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.planning.plan import Plan
from jaxsph.model.particles import kernels

CAPACITY = 6
RTOL = 1e-4
SETTINGS = js.Settings(samples=12, integrator="segments")
PLAN = Plan(8, 6, 12, CAPACITY, 3, 1, ListPlan(1, 1, 64, 256), CastPlan(8, 4, 16), 0, integrator="segments")


def of_segments(frames):
    """Settings and plan of the frames that other gradients are tested with."""
    plan = dataclasses.replace(frames.plan(), integrator="segments")
    return dataclasses.replace(frames.settings, integrator="segments"), plan


def turns(inputs, rng):
    """About all three axes: a tangent of rotations."""
    x, y, z = rng.normal(size=3)
    return {"axes": jnp.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ inputs[1].axes}


def moves(inputs, rng):
    """By name, what a scene and its camera are differentiated by."""
    names = "position", "support", "quantity", "volume", "values", "colors", "extinction", "eye"
    found = {name: anyhow(name)(inputs, rng) for name in names}
    return found | {"axes": turns(inputs, rng), "half_height": {"half_height": jnp.ones(())}}


def apart(inputs):
    """Whether no ray of the image only grazes a support: where its chord comes and goes there is no slope worth the name."""
    scene, camera = inputs
    view = np.asarray(camera.to_view(scene.particles.position))
    columns, rows = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    u, v = np.meshgrid(np.asarray(camera.column(columns)), np.asarray(camera.row(rows)))
    ray = np.stack([u, v, np.ones_like(u)], -1).reshape(-1, 1, 3)
    foot = (ray * view).sum(-1, keepdims=True) / (ray**2).sum(-1, keepdims=True)
    away = np.linalg.norm(view - foot * ray, axis=-1)
    return (np.abs(away / np.asarray(scene.particles.support) - 1) > 1e-4).all()


def small(frames, rng):
    """Six particles with borders all over the image."""
    few = dataclasses.replace(frames, width=8, height=6, samples=12, capacity=CAPACITY)
    return few.scene(rng, decades=0.6, dtype=np.float64), few.camera(rng, dtype=np.float64)


def check(inputs, named, cotangent, asked, plan):
    """That both modes give the slope of differences in a direction."""
    move = towards(inputs, named)
    difference, pushed, gradient = differ(inputs, move, cotangent, asked, plan)
    slope, size = along(gradient, move)
    assert slope == pytest.approx(difference, rel=RTOL, abs=CLOSE * (1 + size))
    assert pushed == pytest.approx(slope, abs=AGREE * (1 + size))


def ending_on_samples(rng, camera, gap):
    """Particles whose supports end within a share `gap` of them from a sample: where a power of that is what a sample weighs."""
    u = np.asarray(camera.column(rng.integers(0, camera.width, CAPACITY) + 0.5))
    v = np.asarray(camera.row(rng.integers(0, camera.height, CAPACITY) + 0.5))
    depth = np.asarray(camera.depth(rng.integers(0, SETTINGS.samples + 1, CAPACITY).astype(np.float32), SETTINGS.samples))
    way, support = rng.normal(size=(CAPACITY, 3)), rng.uniform(0.1, 0.6, CAPACITY)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    view = np.stack([u, v, depth], 1) + (support * (1 - gap))[:, None] * way
    position = view @ np.asarray(camera.axes) + np.asarray(camera.eye)
    columns = position, support, rng.uniform(0, 1, CAPACITY), rng.uniform(0.1, 1, CAPACITY)
    return js.Particles.from_arrays(*(column.astype(np.float32) for column in columns), "wendland_c6")


@examples(8)
@given(seed=st.integers(0, 2**32 - 1), exponents=st.lists(st.floats(-7, -2), min_size=CAPACITY, max_size=CAPACITY))
def test_gradients_are_finite_where_a_sample_weighs_next_to_nothing(seed, exponents):
    """Of the kernel that falls off steepest, in float32: the eighth power of 1e-4 is a number, its square is none."""
    rng = np.random.default_rng(seed)
    camera = js.Camera.orthographic((0, 0, 3), (0, 0, 0), view_height=2.0, width=8, height=6, near=2, far=4)
    colors, extinction = rng.uniform(0, 1, (5, 3)).astype(np.float32), rng.uniform(0, 8, 5).astype(np.float32)
    look = js.TransferFunction.from_points(np.linspace(0, 1, 5, dtype=np.float32), colors, extinction)
    scene = js.Scene(particles=ending_on_samples(rng, camera, 10.0 ** np.array(exponents)), transfer=look)
    value, gradient = valued((scene, camera), jnp.asarray(rng.normal(size=(6, 8, 4)), jnp.float32), SETTINGS, PLAN)
    assert np.isfinite(value)
    for leaf in jax.tree.leaves(gradient):
        assert leaf.dtype == jax.dtypes.float0 or np.isfinite(np.asarray(leaf)).all()


@pytest.mark.slow
@examples(6)
@given(seed=st.integers(0, 2**32 - 1))
def test_gradients_are_those_of_differences_wherever_borders_are(frames, seed):
    """In directions in which all moves, and what a camera is made of."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        inputs, cotangent = small(frames, rng), jnp.asarray(rng.normal(size=(6, 8, 4)))
        assume(apart(inputs))
        parts = moves(inputs, rng)
        for names in (
            ("position", "support", "quantity", "volume", "values", "colors", "extinction"),
            ("eye", "axes", "half_height"),
        ):
            check(inputs, {name: way for part in names for name, way in parts[part].items()}, cotangent, SETTINGS, PLAN)


@pytest.mark.slow
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("kernel", kernels.KERNELS)
def test_gradients_are_those_of_differences_for(frames, kernel, projection, x64):
    """By one after the other of all that there is."""
    rng = np.random.default_rng(len(kernel))
    inputs = frames.scene(rng, kernel, dtype=np.float64), frames.camera(rng, projection, dtype=np.float64)
    cotangent, asked = weights(rng, frames), of_segments(frames)
    for named in moves(inputs, rng).values():
        check(inputs, named, cotangent, *asked)


def posed(camera, step, distance):
    """The eye moved by a part of the distance, and the axes turned about themselves (Cayley's rotation)."""
    x, y, z = step[3:] / 2
    skew = jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = jnp.linalg.solve(jnp.eye(3) - skew, jnp.eye(3) + skew)
    return dataclasses.replace(camera, eye=camera.eye + distance * step[:3] @ camera.axes, axes=turn @ camera.axes)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_where_a_camera_stands_is_found_from_one_image_of_what_has_edges(seed):
    """From 5 % of the distance and three degrees away, to 1 % of that, by damped least squares."""
    scene, camera = js.scenes.load("mixer", particles=1500, width=64, height=64)
    camera = dataclasses.replace(camera, near=0.9 * camera.near, far=1.1 * camera.far)
    distance = jnp.linalg.norm(camera.eye - scene.particles.position.mean(0))
    away = np.random.default_rng(seed).normal(size=(2, 3))
    start = posed(camera, (0.05 * away / np.linalg.norm(away, axis=1, keepdims=True)).astype(np.float32).ravel(), distance)
    asked = dataclasses.replace(SETTINGS, samples=48)
    plan, wanted = js.plan(scene, start, asked, like=js.plan(scene, camera, asked)), js.render(scene, camera, asked)

    def residuals(step, camera):
        image = js.render(scene, posed(camera, step, distance), asked, plan=plan)
        return jnp.concatenate([(getattr(image, name) - getattr(wanted, name)).ravel() for name in ("color", "transmittance")])

    @jax.jit
    def column(camera, way):
        return jax.jvp(lambda step: residuals(step, camera), (jnp.zeros(6),), (way,))

    @jax.jit
    def loss(camera, step):
        return (residuals(step, camera) ** 2).sum()

    found, damping, least = start, 1e-2, float(loss(start, jnp.zeros(6)))
    for _ in range(40):
        off, slopes = zip(*(column(found, way) for way in jnp.eye(6)), strict=True)
        jacobian = jnp.stack(slopes, 1)
        squares = jacobian.T @ jacobian
        step = -jnp.linalg.solve(squares + damping * jnp.diag(jnp.diag(squares)), jacobian.T @ off[0])
        now = float(loss(found, step))
        damping = damping / 5 if now < least else 5 * damping
        found, least = (posed(found, step, distance), now) if now < least else (found, least)
    for part in ("eye", "axes"):
        left, begun = (np.linalg.norm(getattr(pose, part) - getattr(camera, part)) for pose in (found, start))
        assert left < 0.01 * begun


@pytest.mark.slow
@examples(15)
@given(data=st.data(), seed=st.integers(0, 2**32 - 1))
def test_both_modes_agree_on_hard_scenes(frames, data, seed):
    """Walls, jumps, clumps, supports over four decades, cameras among them; gradients are finite."""
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        scene = data.draw(scenes())
        quantity = scene.particles.quantity + 1e-4 * np.sqrt(2)  # off all control points, where there is no slope
        scene = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, quantity=quantity))
        inputs = scene, data.draw(cameras(frames))
        parts = moves(inputs, rng)
        move = towards(inputs, {name: way for part in parts.values() for name, way in part.items()})
        _, pushed, gradient = looked(inputs, move, weights(rng, frames), *of_segments(frames))
        slope, size = along(gradient, move)
        assert np.isfinite(size)
        assert float(pushed) == pytest.approx(slope, abs=AGREE * (1 + size))


@pytest.mark.slow
def test_gradients_are_batched_over_cameras(frames, x64):
    rng = np.random.default_rng(3)
    scene, _ = small(frames, rng)
    views, cotangent = [small(frames, rng)[1] for _ in range(2)], jnp.asarray(rng.normal(size=(6, 8, 4)))

    def of(position, camera):
        moved = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, position=position))
        return total((moved, camera), cotangent, SETTINGS, PLAN)

    many = jax.tree.map(lambda *leaves: jnp.stack(leaves), *views)
    batched = jax.jit(jax.vmap(jax.grad(of, (0, 1)), (None, 0)), compiler_options=QUICKLY)
    position, of_cameras = batched(scene.particles.position, many)
    for k, camera in enumerate(views):
        of_scene, of_camera = pulled((scene, camera), cotangent, SETTINGS, PLAN)
        np.testing.assert_allclose(position[k], of_scene.particles.position, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(of_cameras.eye[k], of_camera.eye, rtol=1e-9, atol=1e-12)
