"""Gradients of whole images: in batches, in bands, with error control; and what has none says so."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import (
    AGREE,
    CLOSE,
    QUICKLY,
    STEP,
    along,
    anyhow,
    filled,
    looked,
    pulled,
    stepped,
    still,
    total,
    towards,
    valued,
    weights,
)

import jaxsph as js
from jaxsph.engine.control.decide import ControlPlan, PilotPlan

ADAPTIVE = {"super_pixels": False}
STEEPEST = 2.0  # relative change of a gradient a unit of tolerance, in this file's even scene


def test_media_that_are_mixed_by_opacity_have_one_slope_in_both_modes(frames, x64):
    """What they emit may be more than what they take of the light that comes from behind, as all of them show theirs."""
    few, rng = dataclasses.replace(frames, width=8, height=6, samples=12, capacity=6), np.random.default_rng(4)
    scene, camera = few.scene(rng, decades=0.3, dtype=np.float64), few.camera(rng, dtype=np.float64)
    white, thick = np.full((2, 3), 0.9), np.array([5.0, 9.0])
    dense = js.TransferFunction.from_points(np.array([0.0, 1.0]), white, thick)
    volume = js.Volume.from_array(rng.uniform(0.1, 0.9, (3, 3, 3)), lower=np.full(3, -1.0), spacing=np.ones(3))
    both = js.Scene(particles=scene.particles, transfer=dense, volume=volume, volume_transfer=dense, mix="opacity")
    inputs, cotangent, settings = (both, camera), weights(rng, few), few.settings
    move = towards(inputs, anyhow("position", "support", "quantity", "eye")(inputs, rng))
    _, pushed, gradient = looked(inputs, move, cotangent, settings, js.plan(*inputs, settings))
    slope, size = along(gradient, move)
    assert pushed == pytest.approx(slope, abs=AGREE * size)


@pytest.mark.slow
@pytest.mark.parametrize("order", ["a batch of gradients", pytest.param("the gradient of a batch", marks=pytest.mark.slow)])
def test_gradients_are_batched_as(frames, x64, order):
    rng = np.random.default_rng(3)
    scene, cotangent, plan = frames.scene(rng, dtype=np.float64), weights(rng, frames), frames.plan()
    cameras = [frames.camera(rng, dtype=np.float64) for _ in range(2)]
    many = jax.tree.map(lambda *leaves: jnp.stack(leaves), *cameras)

    def of(quantity, camera):
        particles = dataclasses.replace(scene.particles, quantity=quantity)
        return total((dataclasses.replace(scene, particles=particles), camera), cotangent, frames.settings, plan)

    def of_all(quantity, cameras):
        return jax.vmap(of, (None, 0))(quantity, cameras).sum()

    by_both = (0, 1)
    batched = jax.vmap(jax.grad(of, by_both), (None, 0)) if order == "a batch of gradients" else jax.grad(of_all, by_both)
    quantity, batch = jax.jit(batched, compiler_options=QUICKLY)(scene.particles.quantity, many)
    gradients = [pulled((scene, camera), cotangent, frames.settings, plan) for camera in cameras]
    for i, (_, camera) in enumerate(gradients):
        np.testing.assert_allclose(batch.eye[i], camera.eye, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(batch.axes[i], camera.axes, rtol=1e-9, atol=1e-12)
    of_each = np.stack([scene.particles.quantity for scene, _ in gradients])
    wanted = of_each if order == "a batch of gradients" else of_each.sum(0)
    np.testing.assert_allclose(quantity, wanted, rtol=1e-9, atol=1e-12)


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


@pytest.mark.parametrize(("how", "control", "asked"), [
    ("super-pixels", ControlPlan(True, True, "budget", 1), {}), ("pilot", PilotPlan(), {"estimator": "pilot"}),
])  # fmt: skip
def test_what_has_no_gradient_says_so(frames, how, control, asked):
    rng = np.random.default_rng(0)
    inputs, cotangent = (frames.scene(rng), frames.camera(rng)), jnp.ones((frames.height, frames.width, 4))
    asked = dataclasses.replace(frames.settings, tolerance=0.01, **asked)
    plan = dataclasses.replace(frames.plan(), control=control)
    with pytest.raises(NotImplementedError, match=f"{how}.*tolerance=None"):
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
