"""What float32 cannot hold is refused by name: an error where numbers are given, a fault under jit; never an image of NaN."""

import dataclasses

import jax
import numpy as np
import pytest
from extreme import FORWARD, Extreme, error_and_allowance, spoilt

import jaxsph as js
from jaxsph.numerics import faults

pytestmark = pytest.mark.usefixtures("quick_programs")


@pytest.mark.parametrize(
    ("extreme", "message"),
    [
        (Extreme(slab=1e-5), "lengths are too far apart"),
        (Extreme(nearest=1e30), "lengths are too far apart"),
        (Extreme(support=1e16), "lengths are too far apart"),
        (Extreme(decades=14, volume="equal"), "strengths .* are too far apart"),
    ],
)
def test_lengths_and_strengths_that_float32_cannot_hold_are_refused(frames, extreme, message):
    with pytest.raises(ValueError, match=message):
        js.render(extreme.scene(frames), extreme.camera(frames), frames.settings, plan=frames.plan())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda f: Extreme(scale=1e-36).scene(f), "`values` must reach at least"),
        (
            lambda f: js.TransferFunction.from_points(1e8 + np.linspace(0, 1, 5), np.ones((5, 3)), np.ones(5)),
            "subtract an offset",
        ),
        (lambda f: js.Particles.from_arrays(np.zeros((2, 3)), 1.0, 0.0, volume=[1.0, 1e-40]), r"volume\[1\] = 1e-40 underflows"),
    ],
)
def test_numbers_that_float32_would_lose_are_refused_where_they_are_given(frames, make, message):
    with pytest.raises(ValueError, match=message):
        make(frames)


def test_a_particle_too_small_for_a_narrow_view_is_refused_and_from_nearby_it_is_right(frames):
    """A support of 1e-6 seen from 3 units away through a telescope is less than the rounding of its depth."""
    particles = js.Particles.from_arrays(np.full((1, 3), 1 / 3), 1e-6, 0.5, capacity=frames.capacity)
    scene = js.Scene(particles=particles, transfer=Extreme().scene(frames).transfer)
    target, size = particles.exact_position()[0], {"width": frames.width, "height": frames.height}
    narrow = js.Camera.look_at(target - 3 * FORWARD, target, fov_degrees=3e-5, **size, near=2.9999, far=3.0001)
    with pytest.raises(ValueError, match="move the eye nearer instead of narrowing the view"):
        js.render(scene, narrow, frames.settings, plan=frames.plan())
    thick = js.TransferFunction.from_points(scene.transfer.values, scene.transfer.colors, scene.transfer.extinction * 1e6)
    scene = dataclasses.replace(scene, transfer=thick)
    nearby = js.Camera.look_at(target - 3e-6 * FORWARD, target, **size, near=1.9e-6, far=4.1e-6)
    image = js.render(scene, nearby, frames.settings, plan=frames.plan())
    error, allowed = error_and_allowance(image, scene, nearby, frames.settings)
    assert (error <= allowed).all() and np.asarray(image.transmittance).min() < 0.9


SPOILT = {
    "position": ("particles", np.nan, faults.BAD_PARTICLES),
    "support": ("particles", np.nan, faults.BAD_PARTICLES),
    "quantity": ("particles", np.nan, faults.BAD_PARTICLES),
    "volume": ("particles", np.nan, faults.BAD_PARTICLES),
    "values": ("transfer", np.nan, faults.BAD_TRANSFER),
    "colors": ("transfer", np.nan, faults.BAD_TRANSFER),
    "extinction": ("transfer", np.nan, faults.BAD_TRANSFER),
    "eye": ("camera", np.nan, faults.BAD_CAMERA),
    "axes": ("camera", np.nan, faults.BAD_CAMERA),
    "half_height": ("camera", np.nan, faults.BAD_CAMERA),
    "near": ("camera", np.nan, faults.BAD_CAMERA),
    "far": ("camera", np.nan, faults.BAD_CAMERA),
}


@pytest.fixture(scope="module")
def jitted(frames):
    return jax.jit(lambda scene, camera: js.render(scene, camera, frames.settings, plan=frames.plan()))


def test_nan_under_jit_is_a_fault_and_no_image_of_nan(frames, jitted):
    for field, (part, value, bit) in SPOILT.items():
        scene, camera = Extreme().scene(frames), Extreme().camera(frames)
        owner = camera if part == "camera" else getattr(scene, part)
        owner = spoilt(owner, field, value)
        scene, camera = (scene, owner) if part == "camera" else (dataclasses.replace(scene, **{part: owner}), camera)
        image = jitted(scene, camera)
        assert int(image.faults) & bit, field
        assert np.isfinite(image.color).all() and np.isfinite(image.transmittance).all(), field
        if part != "particles":  # nothing of the image means anything, so there is none
            assert not np.asarray(image.color).any() and np.all(np.asarray(image.transmittance) == 1), field
            assert np.all(np.isinf(image.depth)) and np.all(np.asarray(image.error_bound) == 1), field


def test_what_cannot_be_held_apart_is_a_fault_under_jit(frames, jitted):
    scene, camera = Extreme().scene(frames), Extreme().camera(frames)
    assert int(jitted(scene, camera).faults) == 0
    thin = dataclasses.replace(camera, far=np.asarray(camera.near) * np.float32(1.00001))
    assert int(jitted(scene, thin).faults) & faults.UNRESOLVED
    tiny = dataclasses.replace(scene.transfer, values=np.asarray(scene.transfer.values) * np.float32(1e-37))
    assert int(jitted(dataclasses.replace(scene, transfer=tiny), camera).faults) & faults.BAD_TRANSFER
    for field, value in (("volume", 1e-37), ("support", 1e-12)):
        weak = spoilt(scene.particles, field, value)
        assert int(jitted(dataclasses.replace(scene, particles=weak), camera).faults) & faults.WEAK_PARTICLES
