"""Gradients of images: those of differences, the same in both modes, finite everywhere, zero for what is not there.

In batches, in bands, with error control, and by segments, where borders of supports move between samples and over them.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adversary import cameras, scenes
from derivatives import (
    AGREE,
    CLOSE,
    QUICKLY,
    STEP,
    along,
    anyhow,
    differ,
    filled,
    looked,
    pulled,
    stepped,
    still,
    total,
    towards,
    turns,
    valued,
    weights,
)
from examples import examples
from hypothesis import assume, given, strategies as st

import jaxsph as js
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.control.adapt import ControlPlan
from jaxsph.engine.control.pilot import PilotPlan
from jaxsph.engine.planning.plan import Plan

STEEPEST = 2.0  # relative change of a gradient a unit of tolerance, of an even scene


def leaves_the_image(inputs, rng):
    """The particle that is farthest to the right moves out of the image."""
    scene, camera = inputs
    right, move = np.asarray(camera.axes)[0], np.zeros_like(scene.particles.position)
    move[np.argmax(np.asarray(scene.particles.position) @ right)] = right
    return {"position": move}


ALL = "position", "support", "quantity", "volume", "values", "colors", "extinction", "eye", "half_height"
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
@pytest.mark.parametrize(("kernel", "projection", "integrator"), [
    ("poly6", "perspective", "samples"), ("wendland_c2", "orthographic", "samples"), ("cubic_spline", "perspective", "samples"),
    ("poly6", "perspective", "segments"),
])  # fmt: skip
@examples(15)
@given(data=st.data(), seed=st.integers(0, 2**32 - 1))
def test_both_modes_agree_on_hard_scenes(frames, kernel, projection, integrator, data, seed):
    """Walls, jumps, clumps, supports over four decades, cameras among them; gradients are finite."""
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        scene = data.draw(scenes(kernel))
        # off all control points: at a jump or a kink itself there is no slope, and rounding takes either side
        scene = with_particles(scene, quantity=scene.particles.quantity + 1e-4 * np.sqrt(2))
        inputs = scene, data.draw(cameras(frames, projection))
        move = towards(inputs, anyhow(*ALL, "axes")(inputs, rng))
        asked = dataclasses.replace(frames.settings, integrator=integrator)
        _, pushed, gradient = looked(
            inputs, move, weights(rng, frames), asked, dataclasses.replace(frames.plan(), integrator=integrator)
        )
        slope, size = along(gradient, move)
        assert np.isfinite(size)
        assert float(pushed) == pytest.approx(slope, abs=AGREE * (1 + size))


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


@pytest.mark.slow
def test_gradients_are_batched_over_cameras(frames, x64):
    rng = np.random.default_rng(3)
    scene, cotangent, plan = frames.scene(rng, dtype=np.float64), weights(rng, frames), frames.plan()
    cameras = [frames.camera(rng, dtype=np.float64) for _ in range(2)]

    def of(quantity, camera):
        return total((with_particles(scene, quantity=quantity), camera), cotangent, frames.settings, plan)

    batched = jax.jit(jax.vmap(jax.grad(of, (0, 1)), (None, 0)), compiler_options=QUICKLY)
    quantity, batch = batched(scene.particles.quantity, jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras))
    for i, camera in enumerate(cameras):
        of_scene, of_camera = pulled((scene, camera), cotangent, frames.settings, plan)
        np.testing.assert_allclose(quantity[i], of_scene.particles.quantity, rtol=1e-9, atol=1e-12)
        for name in ("eye", "axes"):
            np.testing.assert_allclose(getattr(batch, name)[i], getattr(of_camera, name), rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_gradients_of_bands_and_of_many_control_points_are_those_of_differences(frames, x64):
    """A memory limit makes the bands; beyond 16 points a transfer function is searched rather than compared."""
    rng = np.random.default_rng(6)
    scene, camera = filled(frames, rng)
    values = np.sort(rng.uniform(0, 1, 20))
    transfer = js.TransferFunction.from_points(values, rng.uniform(0, 1, (20, 3)), rng.uniform(0, 4, 20))
    inputs, cotangent = (dataclasses.replace(scene, transfer=transfer), camera), weights(rng, frames)
    whole = js.plan(*inputs, frames.settings)
    low = dataclasses.replace(frames.settings, memory_limit=whole.bytes - 1)
    plan = js.plan(*inputs, low)
    assert whole.bands == 1 and plan.bands == 2
    moves = [anyhow("position", "support", "quantity", "volume", "eye"), anyhow("values"), anyhow("colors"), anyhow("extinction")]
    gradient = valued(inputs, cotangent, low, plan)[1]
    for direction in moves:
        move = towards(inputs, direction(inputs, rng))
        ahead, behind = (valued(stepped(inputs, move, by), cotangent, low, plan)[0] for by in (STEP, -STEP))
        slope, size = along(gradient, move)
        assert abs(slope) > 100 * CLOSE
        assert slope == pytest.approx(float(ahead - behind) / (2 * STEP), abs=CLOSE * (1 + size))


def test_depth_has_gradients_of_zero(frames, x64):
    rng = np.random.default_rng(7)
    scene, camera = filled(frames, rng)

    def of(inputs):
        depth = js.render(*inputs, frames.settings, plan=frames.plan()).depth
        return jnp.where(jnp.isfinite(depth), depth, 0).sum()

    found, gradient = jax.jit(jax.value_and_grad(of, allow_int=True), compiler_options=QUICKLY)((scene, camera))
    assert found > 0
    assert not any(np.asarray(part).any() for part in jax.tree.leaves(gradient) if part.dtype != jax.dtypes.float0)


def adaptive(frames, tolerance):
    """Settings and plan of error control by levels alone."""
    plan = dataclasses.replace(frames.plan(), control=ControlPlan(False, True, "budget"))
    return dataclasses.replace(frames.settings, tolerance=tolerance, super_pixels=False), plan


def even(frames, rng):
    """A frame that is filled, and varies so little that samples can be saved."""
    scene, camera = filled(frames, rng)
    particles, transfer = scene.particles, scene.transfer
    particles = dataclasses.replace(particles, support=4 * particles.support, quantity=0.3 + 0.02 * particles.quantity)
    values, extinction = jnp.linspace(0.0, 1.0, 5), jnp.linspace(0.1, 2.0, 5)
    return js.Scene(particles, dataclasses.replace(transfer, values=values, extinction=extinction)), camera


def test_the_gradient_of_an_adaptive_image_is_that_of_this_image(frames, x64):
    rng = np.random.default_rng(4)
    inputs, cotangent = even(frames, rng), weights(rng, frames)
    asked, plan = adaptive(frames, 0.03)
    names = ("position", "support", "quantity", "values", "extinction", "eye")
    move = towards(inputs, anyhow(*names)(inputs, rng))
    ahead, behind = (valued(stepped(inputs, move, by), cotangent, asked, plan)[0] for by in (STEP, -STEP))
    coarse, gradient = valued(inputs, cotangent, asked, plan)
    fine, of_fine = valued(inputs, cotangent, dataclasses.replace(asked, tolerance=0.0), plan)
    assert coarse != fine  # samples were saved
    slope, size = along(gradient, move)
    assert abs(slope - along(of_fine, move)[0]) > 100 * CLOSE * (1 + size)
    assert slope == pytest.approx(float(ahead - behind) / (2 * STEP), abs=CLOSE * (1 + size))


def test_tightening_the_tolerance_moves_gradients_no_more_than_so_much(frames, x64):
    rng = np.random.default_rng(4)
    inputs, cotangent = even(frames, rng), weights(rng, frames)
    found = {}
    for tolerance in (0.1, 0.03, 0.01, 0.003, 0.0):
        asked, plan = adaptive(frames, tolerance)
        found[tolerance] = valued(inputs, cotangent, asked, plan)[1][0].particles.quantity
    exact = found[0.0]
    off = {tolerance: float(np.linalg.norm(slope - exact) / np.linalg.norm(exact)) for tolerance, slope in found.items()}
    assert all(off[tolerance] <= STEEPEST * tolerance for tolerance in found)


@pytest.mark.parametrize(("how", "changed", "asked"), [
    ("super-pixels.*tolerance=None", {"control": ControlPlan(True, True, "budget", 1)}, {"integrator": "samples"}),
    ("pilot.*tolerance=None", {"control": PilotPlan()}, {"integrator": "samples", "estimator": "pilot"}),
    ("refined for a tolerance", None, {"integrator": "segments"}),
])  # fmt: skip
def test_what_has_no_gradient_says_so(frames, how, changed, asked):
    rng = np.random.default_rng(0)
    inputs, cotangent = (frames.scene(rng), frames.camera(rng)), jnp.ones((frames.height, frames.width, 4))
    asked = dataclasses.replace(frames.settings, tolerance=0.01, **asked)
    plan = js.plan(*inputs, asked) if changed is None else dataclasses.replace(frames.plan(), **changed)
    with pytest.raises(NotImplementedError, match=how):
        jax.eval_shape(
            lambda inputs, move: jax.jvp(lambda i: total(i, cotangent, asked, plan), (inputs,), (move,)), inputs, still(inputs)
        )


def test_second_derivatives_say_that_there_are_none(frames):
    rng = np.random.default_rng(0)
    scene, camera, cotangent = frames.scene(rng), frames.camera(rng), jnp.ones((frames.height, frames.width, 4))

    def of(extinction):
        transfer = dataclasses.replace(scene.transfer, extinction=extinction)
        return total((dataclasses.replace(scene, transfer=transfer), camera), cotangent, frames.settings, frames.plan())

    with pytest.raises(NotImplementedError, match="second derivatives"):
        jax.eval_shape(jax.hessian(of), scene.transfer.extinction)


CAPACITY = 6
OF_SEGMENTS = js.Settings(samples=12, integrator="segments")
PLAN = Plan(8, 6, 12, CAPACITY, 3, 1, ListPlan(1, 1, 64, 256), CastPlan(8, 4, 16), 0, integrator="segments")


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


def ending_on_samples(rng, camera, gap):
    """Particles whose supports end within a share `gap` of them from a sample: where a power of that is what a sample weighs."""
    u = np.asarray(camera.column(rng.integers(0, camera.width, CAPACITY) + 0.5))
    v = np.asarray(camera.row(rng.integers(0, camera.height, CAPACITY) + 0.5))
    depth = np.asarray(camera.depth(rng.integers(0, OF_SEGMENTS.samples + 1, CAPACITY).astype(np.float32), OF_SEGMENTS.samples))
    way, support = rng.normal(size=(CAPACITY, 3)), rng.uniform(0.1, 0.6, CAPACITY)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    view = np.stack([u, v, depth], 1) + (support * (1 - gap))[:, None] * way
    position = view @ np.asarray(camera.axes) + np.asarray(camera.eye)
    columns = position, support, rng.uniform(0, 1, CAPACITY), rng.uniform(0.1, 1, CAPACITY)
    return js.Particles.from_arrays(*(column.astype(np.float32) for column in columns), "wendland_c6")


@examples(8)
@given(seed=st.integers(0, 2**32 - 1), exponents=st.lists(st.floats(-7, -2), min_size=CAPACITY, max_size=CAPACITY))
def test_gradients_of_segments_are_finite_where_a_sample_weighs_next_to_nothing(seed, exponents):
    """Of the kernel that falls off steepest, in float32: the eighth power of 1e-4 is a number, its square is none."""
    rng = np.random.default_rng(seed)
    camera = js.Camera.orthographic((0, 0, 3), (0, 0, 0), view_height=2.0, width=8, height=6, near=2, far=4)
    colors, extinction = rng.uniform(0, 1, (5, 3)).astype(np.float32), rng.uniform(0, 8, 5).astype(np.float32)
    look = js.TransferFunction.from_points(np.linspace(0, 1, 5, dtype=np.float32), colors, extinction)
    scene = js.Scene(particles=ending_on_samples(rng, camera, 10.0 ** np.array(exponents)), transfer=look)
    value, gradient = valued((scene, camera), jnp.asarray(rng.normal(size=(6, 8, 4)), jnp.float32), OF_SEGMENTS, PLAN)
    assert np.isfinite(value)
    for leaf in jax.tree.leaves(gradient):
        assert leaf.dtype == jax.dtypes.float0 or np.isfinite(np.asarray(leaf)).all()


@pytest.mark.slow
@examples(6)
@given(seed=st.integers(0, 2**32 - 1))
def test_gradients_of_segments_are_those_of_differences_wherever_borders_are(frames, seed):
    """In directions in which all moves, and what a camera is made of."""
    with jax.enable_x64(True):
        rng = np.random.default_rng(seed)
        few = dataclasses.replace(frames, width=8, height=6, samples=12, capacity=CAPACITY)
        inputs = few.scene(rng, decades=0.6, dtype=np.float64), few.camera(rng, dtype=np.float64)
        assume(apart(inputs))
        cotangent = weights(rng, few)
        for named in (anyhow(*ALL[:7])(inputs, rng), anyhow(*ALL[7:])(inputs, rng) | turns(inputs, rng)):
            move = towards(inputs, named)
            difference, pushed, gradient = differ(inputs, move, cotangent, OF_SEGMENTS, PLAN)
            slope, size = along(gradient, move)
            assert slope == pytest.approx(difference, rel=1e-4, abs=CLOSE * (1 + size))
            assert pushed == pytest.approx(slope, abs=AGREE * (1 + size))
