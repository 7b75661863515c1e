"""Where places are in a picture: on the rays that the camera casts, and lengths as long as they are."""

import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.plot.places import box_lines, pixels_per_length, round_length, to_pixels


def cameras():
    more = {"near": 1.0, "far": 20.0, "width": 40, "height": 30}
    perspective = js.Camera.look_at((3, 2, -7), (0.5, 0, 0), (0, 1, 0.2), 50.0, 40, 30, near=1.0, far=20.0)
    return [perspective, js.Camera.orthographic((3, 2, -7), (0.5, 0, 0), (0, 1, 0.2), view_height=5, **more)]


@pytest.mark.parametrize("camera", cameras(), ids=["perspective", "orthographic"])
@examples(20)
@given(row=st.integers(0, 29), column=st.integers(0, 39), depth=st.floats(1.5, 19))
def test_a_place_on_the_ray_of_a_pixel_is_in_its_middle(camera, row, column, depth):
    half = float(camera.half_height)
    u, v = half * 40 / 30 * (2 * (column + 0.5) / 40 - 1), half * (1 - 2 * (row + 0.5) / 30)
    spread = depth if camera.is_perspective else 1.0
    place = camera.exact_eye() + np.array([u * spread, v * spread, depth]) @ np.asarray(camera.axes, np.float64)
    pixels, found = to_pixels(camera, place)
    np.testing.assert_allclose(pixels, [column + 0.5, row + 0.5], atol=1e-3)
    assert found == pytest.approx(depth, rel=1e-5)


@pytest.mark.parametrize("camera", cameras(), ids=["perspective", "orthographic"])
def test_a_length_across_the_line_of_sight_takes_as_many_pixels_as_are_said(camera):
    middle = camera.exact_eye() + 6 * np.asarray(camera.axes[2], np.float64)
    ends = [to_pixels(camera, middle + side * np.asarray(camera.axes[0], np.float64))[0] for side in (-0.5, 0.5)]
    assert np.hypot(*(ends[1] - ends[0])) == pytest.approx(pixels_per_length(camera, 6.0), rel=1e-5)


def test_what_is_behind_the_eye_has_no_place():
    camera = cameras()[0]
    assert np.isnan(to_pixels(camera, camera.exact_eye() - np.asarray(camera.axes[2]))[0]).all()


@given(st.floats(1e-20, 1e20))
def test_lengths_are_rounded_down_to_one_two_or_five(most):
    length = round_length(most)
    assert most / 2.51 < length <= most * (1 + 1e-12)
    assert f"{length:e}"[0] in "125" and float(f"{length:.0e}") == pytest.approx(length)


def test_a_box_has_twelve_edges_that_meet_in_its_corners():
    camera, lower, upper = cameras()[0], np.zeros(3), np.array([1.0, 2.0, 3.0])
    lines = box_lines(camera, lower, upper)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], float)
    pixels = to_pixels(camera, corners)[0]
    ends = np.unique(lines.ends.reshape(-1, 2).round(6), axis=0)
    assert len(lines.depth) == 12 * 128
    assert all(np.abs(ends - corner).max(1).min() < 1e-5 for corner in pixels)


def test_edges_are_hidden_behind_the_depth_at_which_half_of_the_light_is_gone():
    camera = cameras()[0]
    lines = box_lines(camera, np.zeros(3), np.ones(3))
    for depth, hidden in ((np.inf, False), (0.0, True)):
        assert (lines.hidden(np.full((30, 40), depth)) == hidden).all()


def test_an_eye_within_the_box_sees_only_what_is_ahead():
    camera = js.Camera.look_at((0.5, 0.5, 0.5), (0.5, 0.5, 2), width=10, height=10, near=0.1, far=2.0)
    lines = box_lines(camera, np.zeros(3), np.ones(3))
    assert 0 < len(lines.depth) < 12 * 128 and np.isfinite(lines.ends).all() and (lines.depth > 0).all()


def test_bounds_are_those_of_all_parts():
    points = js.Points.from_arrays(np.array([[4.0, 0, 0]], np.float32), 0.5, (1, 1, 1), opacity=0.5)
    volume = js.Volume.from_array(np.zeros((2, 2, 2), np.float32), (-1, -2, -3), 1.0)
    look = js.TransferFunction.from_colormap("heat", (0, 1))
    lower, upper = js.Scene(volume=volume, volume_transfer=look, points=points).bounds()
    assert (lower <= [-1, -2, -3]).all() and upper[0] >= 4 and (np.abs(lower) < 10).all()
    assert not js.Scene(media=(js.IsoSurface.from_volume(volume, 0.5),)).parts
