"""Gradients of images: those of differences, the same in both modes, finite everywhere, zero for what is not there."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.control.adapt import ControlPlan
from jaxsph.control.pilot import PilotPlan

STEP = 1e-7  # of a difference: so small that hardly a sample meets a kink of the transfer function on the way
CLOSE = 1e-6  # of the sum of a slope's terms, and of one: the rounding of some thousand pixels over the step, with room
AGREE = 2.0**16 * np.finfo(np.float64).eps  # both modes add up the same numbers, some thousands of them, in another order
QUICKLY = {"xla_backend_optimization_level": 0}  # programs that run some times only: compiling them is what takes time
ADAPTIVE = {"super_pixels": False}
STEEPEST = 2.0  # relative change of a gradient a unit of tolerance, in this file's even scene


def total(inputs, worth, settings, plan):
    """All layers that have derivatives, each pixel as often as it is worth."""
    image = js.render(*inputs, settings, plan=plan)
    return (jnp.concatenate([image.color, image.transmittance[..., None]], -1) * worth).sum()


@functools.partial(jax.jit, static_argnames="plan", compiler_options=QUICKLY)
def looked(inputs, move, worth, settings, plan):
    """The total, its slope in a direction by forward mode, and its gradient by reverse mode: one program."""

    def of(inputs):
        return total(inputs, worth, settings, plan)

    return *jax.jvp(of, (inputs,), (move,)), jax.grad(of, allow_int=True)(inputs)


def pulled(inputs, worth, settings, plan):
    return looked(inputs, still(inputs), worth, settings, plan)[2]


@functools.partial(jax.jit, static_argnames="plan", compiler_options=QUICKLY)
def valued(inputs, worth, settings, plan):
    """The total and its gradient: a smaller program."""
    return jax.value_and_grad(total, allow_int=True)(inputs, worth, settings, plan)


def still(inputs):
    """A direction in which nothing moves."""
    floating = functools.partial(jnp.issubdtype, arg2=jnp.floating)
    return jax.tree.map(lambda x: jnp.zeros_like(x) if floating(x.dtype) else np.zeros(x.shape, jax.dtypes.float0), inputs)


def along(owed, move):
    """Slope in the direction `move`, and the sum of its terms' sizes."""
    pairs = zip(jax.tree.leaves(owed), jax.tree.leaves(move), strict=True)
    terms = [np.asarray(a * b).ravel() for a, b in pairs if a.dtype != jax.dtypes.float0]
    return float(sum(t.sum() for t in terms)), float(sum(np.abs(t).sum() for t in terms))


def stepped(inputs, move, step):
    return jax.tree.map(lambda x, d: x if d.dtype == jax.dtypes.float0 else x + step * d, inputs, move)


def differ(inputs, move, worth, settings, plan):
    """The central difference in the direction `move`, and the slope and gradient there."""
    ahead, behind = (looked(stepped(inputs, move, by), still(inputs), worth, settings, plan)[0] for by in (STEP, -STEP))
    _, pushed, owed = looked(inputs, move, worth, settings, plan)
    return float(ahead - behind) / (2 * STEP), float(pushed), owed


def weights(rng, frames):
    return jnp.asarray(rng.normal(size=(frames.height, frames.width, 4)))


def filled(frames, rng, dtype=np.float64):
    """A frame without empty space, where colours would jump as a support's edge passes a sample."""
    scene, camera = frames.scene(rng, dtype=dtype), frames.camera(rng, dtype=dtype)
    particles = scene.particles
    position, support = particles.position.at[0].set(0), particles.support.at[0].set(20)
    volume = particles.volume.at[0].set(1e3)
    particles = dataclasses.replace(particles, position=position, support=support, volume=volume)
    return dataclasses.replace(scene, particles=particles), camera


def leaves_the_image(inputs, rng):
    """The particle that is farthest to the right moves out of the image."""
    scene, camera = inputs
    rightmost = int(np.argmax(np.asarray(camera.to_view(scene.particles.position))[:, 0]))
    return {"position": jnp.zeros_like(scene.particles.position).at[rightmost].set(camera.axes[0])}


def turns(inputs, rng):
    """About all three axes: a tangent of rotations."""
    x, y, z = rng.normal(size=3)
    return {"axes": jnp.asarray([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ inputs[1].axes}


def anyhow(*names):
    def move(inputs, rng):
        parts = {**vars(inputs[0].particles), **vars(inputs[0].transfer), **vars(inputs[1])}
        return {name: jnp.asarray(rng.normal(size=parts[name].shape)) for name in names}

    return move


PHENOMENA = {
    "a particle leaves the image": leaves_the_image,
    "particles are stirred": anyhow("position"),
    "supports swell and shrink": anyhow("support"),
    "two colours cross": lambda inputs, rng: {"quantity": jnp.zeros_like(inputs[0].particles.quantity).at[:2].set([1, -1])},
    "particles gain volume": anyhow("volume"),
    "a band of the transfer function sweeps by": lambda inputs, rng: {"values": jnp.ones_like(inputs[0].transfer.values)},
    "control points part": anyhow("values"),
    "colours fade": lambda inputs, rng: {"colors": -inputs[0].transfer.colors},
    "the fluid clears up": lambda inputs, rng: {"extinction": -inputs[0].transfer.extinction},
    "the eye moves": anyhow("eye"),
    "the camera turns": turns,
    "the camera orbits": lambda inputs, rng: anyhow("eye")(inputs, rng) | turns(inputs, rng),
    "the field of view widens": lambda inputs, rng: {"half_height": jnp.ones(())},
    "samples move apart": anyhow("near", "far"),
}


def towards(inputs, named):
    """The direction that moves the parts that are `named`, and nothing else."""
    zero = still(inputs)
    scene, camera = zero

    def put(part):
        return dataclasses.replace(part, **{name: move for name, move in named.items() if name in vars(part)})

    return dataclasses.replace(scene, particles=put(scene.particles), transfer=put(scene.transfer)), put(camera)


@pytest.mark.parametrize("phenomenon", PHENOMENA)
def test_gradients_are_those_of_differences_when(frames, x64, phenomenon):
    rng = np.random.default_rng(list(PHENOMENA).index(phenomenon))
    inputs, worth, plan = filled(frames, rng), weights(rng, frames), frames.plan()
    move = towards(inputs, PHENOMENA[phenomenon](inputs, rng))
    difference, pushed, owed = differ(inputs, move, worth, frames.settings, plan)
    slope, size = along(owed, move)
    assert difference != 0
    assert slope == pytest.approx(difference, abs=CLOSE * (1 + size))
    assert pushed == pytest.approx(slope, abs=AGREE * size)


@pytest.mark.parametrize(("kernel", "projection"), [("poly6", "perspective"), ("cubic_spline", "orthographic")])
@settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_both_modes_agree_on_hard_scenes(frames, adversary, kernel, projection, seed):
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        inputs = adversary.scene(rng, kernel, np.float64), adversary.camera(rng, projection, np.float64)
        names = ("position", "support", "quantity", "volume", "values", "colors", "extinction", "eye", "axes", "half_height")
        move = towards(inputs, anyhow(*names)(inputs, rng))
        worth, plan = weights(rng, frames), frames.plan()
        _, pushed, owed = looked(inputs, move, worth, frames.settings, plan)
        slope, size = along(owed, move)
        assert np.isfinite(size)
        assert float(pushed) == pytest.approx(slope, abs=AGREE * size)


def alone(scene, count):
    """Only the first `count` particles exist."""
    exists = jnp.arange(scene.particles.capacity) < count
    return dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, valid=exists))


def at_a_sample(scene, camera, frames):
    """The first particle sits where a sample is: on the ray of pixel (9, 10), which is the middle column's."""
    depth = camera.depth(jnp.asarray(18.5), frames.samples)
    view = jnp.stack([camera.column(jnp.asarray(10.5)) * depth, camera.row(jnp.asarray(9.5)) * depth, depth])
    position = scene.particles.position.at[0].set(camera.eye + view @ camera.axes)
    return dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, position=position))


def with_edge_at_a_sample(scene, camera, frames):
    """The first particle's support ends where the next sample of that ray is."""
    scene = at_a_sample(scene, camera, frames)
    depth = camera.depth(jnp.asarray([18.5, 19.5]), frames.samples)
    slant = jnp.sqrt(1 + camera.column(jnp.asarray(10.5)) ** 2 + camera.row(jnp.asarray(9.5)) ** 2)
    support = scene.particles.support.at[0].set((depth[1] - depth[0]) * slant)
    return dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, support=support))


def of_extinction(factor):
    def change(scene, camera, frames):
        return dataclasses.replace(
            scene, transfer=dataclasses.replace(scene.transfer, extinction=factor * jnp.ones_like(scene.transfer.extinction))
        )

    return change


SPECIAL = {
    "a particle at a sample": at_a_sample,
    "a support that ends at a sample": with_edge_at_a_sample,
    "one particle": lambda scene, camera, frames: alone(at_a_sample(scene, camera, frames), 1),
    "empty space": lambda scene, camera, frames: alone(scene, 0),
    "no extinction": of_extinction(0.0),
    "what is opaque": of_extinction(1e30),
    "no volume": lambda scene, camera, frames: dataclasses.replace(
        scene, particles=dataclasses.replace(scene.particles, volume=scene.particles.volume.at[:3].set(0))
    ),
}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("special", SPECIAL)
def test_gradients_are_finite_with(frames, special, dtype):
    rng = np.random.default_rng(5)
    with jax.enable_x64(dtype is np.float64):
        scene, camera = frames.scene(rng, dtype=dtype), frames.camera(rng, dtype=dtype)
        inputs = SPECIAL[special](scene, camera, frames), camera
        worth = weights(rng, frames).astype(dtype)
        plan = frames.plan()
        owed = (pulled if dtype is np.float64 else lambda *given: valued(*given)[1])(inputs, worth, frames.settings, plan)
        for part in jax.tree.leaves(owed):
            assert part.dtype == jax.dtypes.float0 or (part.dtype == dtype and np.isfinite(part).all())
        if special == "empty space":
            assert not any(np.any(part) for part in jax.tree.leaves(owed) if part.dtype != jax.dtypes.float0)


def test_single_precision_gives_the_same_gradients_but_for_rounding(frames):
    owed = {}
    for dtype in (np.float64, np.float32):
        with jax.enable_x64(dtype is np.float64):
            rng = np.random.default_rng(1)
            scene, camera = filled(frames, rng, dtype)
            worth = weights(rng, frames).astype(dtype)
            given = (scene, camera), worth, frames.settings, frames.plan()
            owed[dtype] = jax.tree.map(np.asarray, pulled(*given) if dtype is np.float64 else valued(*given)[1])
    for exact, rounded in zip(*(jax.tree.leaves(found) for found in owed.values()), strict=True):
        if exact.dtype != jax.dtypes.float0:
            np.testing.assert_allclose(rounded, exact, atol=1e-3 * max(np.abs(exact).max(), 1))


def test_padding_and_what_is_out_of_view_owe_nothing(frames, x64):
    rng = np.random.default_rng(2)
    scene, camera = alone(frames.scene(rng, dtype=np.float64), 9), frames.camera(rng, dtype=np.float64)
    behind = scene.particles.position.at[3].set(camera.eye - 5 * camera.axes[2])
    scene = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, position=behind))
    owed = pulled((scene, camera), weights(rng, frames), frames.settings, frames.plan())[0].particles
    for part in (owed.position, owed.support, owed.quantity, owed.volume):
        assert not np.any(part[9:]) and not np.any(part[3])
        assert np.any(part[:9])


def test_gradients_of_a_batch_are_a_batch_of_gradients(frames, x64):
    rng = np.random.default_rng(3)
    scene, worth, plan = frames.scene(rng, dtype=np.float64), weights(rng, frames), frames.plan()
    cameras = [frames.camera(rng, dtype=np.float64) for _ in range(2)]
    many = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)

    def of(quantity, camera):
        particles = dataclasses.replace(scene.particles, quantity=quantity)
        return total((dataclasses.replace(scene, particles=particles), camera), worth, frames.settings, plan)

    def of_all(quantity, cameras):
        return jax.vmap(of, (None, 0))(quantity, cameras).sum()

    by_both = (0, 1)
    each = jax.jit(jax.vmap(jax.grad(of, by_both), (None, 0)), compiler_options=QUICKLY)(scene.particles.quantity, many)
    summed = jax.jit(jax.grad(of_all, by_both), compiler_options=QUICKLY)(scene.particles.quantity, many)
    for i, camera in enumerate(cameras):
        owed = pulled((scene, camera), worth, frames.settings, plan)
        np.testing.assert_allclose(each[0][i], owed[0].particles.quantity, rtol=1e-9, atol=1e-12)
        for batch in (each[1], summed[1]):
            np.testing.assert_allclose(batch.eye[i], owed[1].eye, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(batch.axes[i], owed[1].axes, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(summed[0], each[0].sum(0), rtol=1e-9, atol=1e-12)


def adaptive(frames, tolerance):
    """Settings and plan of error control by levels alone."""
    plan = dataclasses.replace(frames.plan(), control=ControlPlan(False, True, "budget"))
    return dataclasses.replace(frames.settings, tolerance=tolerance, **ADAPTIVE), plan


def even(frames, rng):
    """A frame that is filled, and varies so little that samples can be saved."""
    scene, camera = filled(frames, rng)
    particles, transfer = scene.particles, scene.transfer
    particles = dataclasses.replace(particles, support=4 * particles.support, quantity=0.3 + 0.02 * particles.quantity)
    values, extinction = jnp.linspace(0.0, 1.0, 5), jnp.linspace(0.1, 2.0, 5)
    return js.Scene(particles, dataclasses.replace(transfer, values=values, extinction=extinction)), camera


def test_the_gradient_of_an_adaptive_image_is_that_of_this_image(frames, x64):
    rng = np.random.default_rng(4)
    inputs, worth = even(frames, rng), weights(rng, frames)
    asked, plan = adaptive(frames, 0.03)
    names = ("position", "support", "quantity", "values", "extinction", "eye")
    move = towards(inputs, anyhow(*names)(inputs, rng))
    ahead, behind = (valued(stepped(inputs, move, by), worth, asked, plan)[0] for by in (STEP, -STEP))
    coarse, owed = valued(inputs, worth, asked, plan)
    fine, of_fine = valued(inputs, worth, dataclasses.replace(asked, tolerance=0.0), plan)
    assert coarse != fine  # samples were saved
    slope, size = along(owed, move)
    assert abs(slope - along(of_fine, move)[0]) > 100 * CLOSE * (1 + size)
    assert slope == pytest.approx(float(ahead - behind) / (2 * STEP), abs=CLOSE * (1 + size))


def test_tightening_the_tolerance_moves_gradients_no_more_than_so_much(frames, x64):
    rng = np.random.default_rng(4)
    inputs, worth = even(frames, rng), weights(rng, frames)
    found = {}
    for tolerance in (0.1, 0.03, 0.01, 0.003, 0.0):
        asked, plan = adaptive(frames, tolerance)
        found[tolerance] = valued(inputs, worth, asked, plan)[1][0].particles.quantity
    exact = found[0.0]
    off = {tolerance: float(np.linalg.norm(slope - exact) / np.linalg.norm(exact)) for tolerance, slope in found.items()}
    assert all(off[tolerance] <= STEEPEST * tolerance for tolerance in found)


@pytest.mark.parametrize(("how", "control", "asked"), [
    ("super-pixels", ControlPlan(True, True, "budget", 1), {}), ("pilot", PilotPlan(), {"estimator": "pilot"}),
])  # fmt: skip
def test_what_has_no_gradient_says_so(frames, how, control, asked):
    rng = np.random.default_rng(0)
    inputs, worth = (frames.scene(rng), frames.camera(rng)), jnp.ones((frames.height, frames.width, 4))
    asked = dataclasses.replace(frames.settings, tolerance=0.01, **asked)
    plan = dataclasses.replace(frames.plan(), control=control)
    with pytest.raises(NotImplementedError, match=f"{how}.*tolerance=None"):
        jax.eval_shape(
            lambda inputs, move: jax.jvp(lambda i: total(i, worth, asked, plan), (inputs,), (move,)), inputs, still(inputs)
        )


def test_second_derivatives_say_that_there_are_none(frames):
    rng = np.random.default_rng(0)
    scene, camera, worth = frames.scene(rng), frames.camera(rng), jnp.ones((frames.height, frames.width, 4))

    def of(extinction):
        transfer = dataclasses.replace(scene.transfer, extinction=extinction)
        return total((dataclasses.replace(scene, transfer=transfer), camera), worth, frames.settings, frames.plan())

    with pytest.raises(NotImplementedError, match="second derivatives"):
        jax.eval_shape(jax.hessian(of), scene.transfer.extinction)
