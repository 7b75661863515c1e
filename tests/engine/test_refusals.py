"""What float32 cannot hold is refused by name: an error where numbers are given, a fault under jit; never an image of NaN."""

import dataclasses
import re

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
    faults.BAD_PARTICLES: ("particles", {"position": [np.nan], "support": [np.nan, -1.0], "quantity": [np.nan, np.inf],
                                         "volume": [np.nan, -1.0]}),
    faults.BAD_TRANSFER: ("transfer", {field: [np.nan] for field in ("values", "colors", "extinction")}),
    faults.CLIPPED_LOOK: ("transfer", {"colors": [2.0], "extinction": [-1.0]}),
    faults.BAD_CAMERA: ("camera", {"eye": [np.nan], "axes": [np.nan], "half_height": [np.nan], "near": [np.nan, -1.0],
                                   "far": [np.nan, 0.001]}),
}  # fmt: skip


@pytest.mark.parametrize("bit", SPOILT, ids=lambda bit: faults.MESSAGES[bit][:30])
def test_numbers_that_mean_nothing_are_an_error_and_under_jit_a_fault_and_no_image_of_nan(frames, traced, bit):
    part, fields = SPOILT[bit]
    for field, value in ((field, value) for field, values in fields.items() for value in values):
        scene, camera = Extreme().scene(frames), Extreme().camera(frames)
        if part == "camera":
            camera = spoilt(camera, field, value)
        else:
            scene = dataclasses.replace(scene, **{part: spoilt(getattr(scene, part), field, value)})
        image = traced(scene, camera, plan=frames.plan())
        assert int(image.faults) & bit and not image.certified and (np.asarray(image.error_bound) == 1).all(), field
        assert np.isfinite(image.color).all() and np.isfinite(image.transmittance).all(), field
        if bit & faults.UNUSABLE:  # nothing of the image means anything, so there is none
            assert not np.asarray(image.color).any() and np.all(np.asarray(image.transmittance) == 1), field
            assert np.all(np.isinf(image.depth)), field
        for told in (
            image.check,
            lambda scene=scene, camera=camera: js.render(scene, camera, frames.settings, plan=frames.plan()),
        ):
            with pytest.raises(ValueError, match=re.escape(faults.MESSAGES[bit][:30])):
                told()


def test_what_cannot_be_held_apart_is_a_fault_under_jit(frames, traced):
    scene, camera = Extreme().scene(frames), Extreme().camera(frames)
    assert int(traced(scene, camera, plan=frames.plan()).faults) == 0
    thin = dataclasses.replace(camera, far=np.asarray(camera.near) * np.float32(1.00001))
    assert int(traced(scene, thin, plan=frames.plan()).faults) & faults.UNRESOLVED
    tiny = dataclasses.replace(scene.transfer, values=np.asarray(scene.transfer.values) * np.float32(1e-37))
    assert int(traced(dataclasses.replace(scene, transfer=tiny), camera, plan=frames.plan()).faults) & faults.BAD_TRANSFER
    for field, value in (("volume", 1e-37), ("support", 1e-12)):
        weak = spoilt(scene.particles, field, value)
        assert int(traced(dataclasses.replace(scene, particles=weak), camera, plan=frames.plan()).faults) & faults.WEAK_PARTICLES
