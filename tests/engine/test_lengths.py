"""Any unit of length gives the same picture, bit for bit, and frames in a comfortable one are left alone."""

import dataclasses

import numpy as np
import pytest
from extreme import Extreme, error_and_allowance, same_in_another_unit
from rows import Fog

import jaxsph as js
from jaxsph.engine.request import LENGTHS, Request, digits_to_scale, scaled, times
from jaxsph.numerics import faults

pytestmark = pytest.mark.usefixtures("quick_programs")

DIGITS = (-80, -61, -42, -7, 7, 42, 61, 80)


def frame(frames, **extreme):
    return Extreme(**extreme).scene(frames), Extreme(**extreme).camera(frames)


@pytest.mark.core
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_a_frame_in_any_unit_of_length_is_the_same_bit_for_bit(frames, projection):
    scene, camera = frame(frames, projection=projection)
    image = js.render(scene, camera, frames.settings, plan=frames.plan())
    assert np.asarray(image.transmittance).min() < 0.5 and np.isfinite(image.depth).any()
    for digits in DIGITS:
        moved, seen = scaled(scene, digits), scaled(camera, digits)
        of_unit = js.render(moved, seen, frames.settings, plan=frames.plan())
        same_in_another_unit(of_unit, image, digits)
        assert dict(of_unit.metadata)["jaxsph.camera"] == seen.describe()


@pytest.mark.core
@pytest.mark.parametrize("length", [1e-24, 1e-20, 1e19, 1e24])
def test_frames_of_lengths_beyond_those_of_float32_are_right(frames, length):
    scene, camera = frame(frames, length=length)
    image = js.render(scene, camera, frames.settings, plan=frames.plan())
    error, allowed = error_and_allowance(image, scene, camera, frames.settings)
    assert (error <= allowed).all() and np.asarray(image.transmittance).min() < 0.5


def test_a_plan_of_such_a_frame_is_that_of_the_frame_in_another_unit(frames):
    scene, camera = frame(frames)
    moved, seen = scaled(scene, 80), scaled(camera, 80)
    assert js.plan(moved, seen, frames.settings) == js.plan(scene, camera, frames.settings)


def test_comfortable_frames_are_left_alone(frames):
    for length in (1e-9, 1e-3, 1.0, 1e5, 1e9):
        scene, camera = frame(frames, length=length)
        asked = Request.of(scene, camera, frames.settings)
        assert asked.digits == 0 and asked.scene is scene and asked.camera is camera


def test_under_a_trace_the_fault_stays(frames, traced):
    scene, camera = frame(frames, length=1e24)
    image = traced(scene, camera, frames.plan())
    assert int(image.faults) & faults.UNRESOLVED


def test_all_parts_of_a_scene_have_their_lengths_scaled(frames):
    values = js.Volume.from_array(np.random.default_rng(0).random((4, 5, 6)), (-0.9, -0.8, -0.7), 0.3)
    parts = {
        "within": js.Sphere((0, 0, 0), 0.8) & ~js.Box((-0.2,) * 3, (0.3,) * 3) & js.Plane((0, 0.5, 0), (0, -1, 0)),
        "points": js.Points.from_arrays(np.eye(3) * 0.4, 0.3, (1.0, 0.5, 0.0), 2.0, splats_beyond=2.5),
        "volume": values,
        "volume_transfer": js.TransferFunction.from_points([0, 1], np.ones((2, 3)), [0, 2.0]),
        "media": (js.IsoSurface.from_volume(values, 0.6),),
    }
    scene, camera = frame(frames)
    scene = dataclasses.replace(scene, **parts)
    image = js.render(scene, camera, frames.settings)
    assert np.isfinite(image.depth).any()
    same_in_another_unit(js.render(scaled(scene, 80), scaled(camera, 80), frames.settings), image, 80)


def test_periodic_sets_have_their_box_scaled(frames):
    scene, camera = frame(frames)
    scene = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, box=js.Box((-1.0,) * 3, (1.0,) * 3)))
    image = js.render(scene, camera, frames.settings)
    same_in_another_unit(js.render(scaled(scene, -70), scaled(camera, -70), frames.settings), image, -70)


def test_a_medium_of_unknown_lengths_is_not_scaled(frames):
    scene, camera = frame(frames, length=1e24)
    assert digits_to_scale(dataclasses.replace(scene, media=(Fog.of(),)), camera) == 0 and digits_to_scale(scene, camera) != 0


def test_every_field_that_is_named_is_there_and_numbers_come_back_from_a_scale_and_its_inverse():
    for kind, powers in LENGTHS.items():
        assert powers.keys() <= {field.name for field in dataclasses.fields(kind)}, kind
    values = np.float32([1.1, 0, np.inf, 3e-5])
    for digits in (-90, -80, 1, 126):
        np.testing.assert_array_equal(times(times(values, digits), -digits), values)
    assert times(None, 3) is None
