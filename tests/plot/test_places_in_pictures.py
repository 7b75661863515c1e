"""Where places are in a picture: on the rays that the camera casts, and lengths as long as they are."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.io.table import LENGTH, CodeUnit
from jaxsph.plot.places import described, frame_of, pixels_per_length, round_length

KPC = 3.0856775814913673e21


def cameras():
    more = {"near": 1.0, "far": 20.0, "width": 40, "height": 30}
    perspective = js.Camera.look_at((3, 2, -7), (0.5, 0, 0), (0, 1, 0.2), 50.0, 40, 30, near=1.0, far=20.0)
    return [perspective, js.Camera.orthographic((3, 2, -7), (0.5, 0, 0), (0, 1, 0.2), view_height=5, **more)]


def test_coordinates_of_a_figure_are_those_of_places_and_run_as_the_axes_of_the_camera():
    for eye, up, names in (((0, 0, 5), (0, 1, 0), "xy"), ((0, 0, -5), (0, 1, 0), "xy"), ((5, 0, 0), (0, 0, 1), "yz")):
        camera = js.Camera.orthographic(np.add(eye, (1, 2, 3)), (1, 2, 3), up, view_height=4, width=40, height=20)
        extent, said = frame_of(camera, js.io.Labels("q", length=CodeUnit(KPC, LENGTH), length_unit="pc"), 40, 20)
        corners = np.reshape(extent, (2, 2)) / 1000
        for row, half, name, (low, high), told in zip(np.asarray(camera.axes), (4, 2), names, corners, said, strict=False):
            which = "xyz".index(name)
            middle, sign = (1, 2, 3)[which], np.sign(row[which])
            np.testing.assert_allclose((low, high), (middle - sign * half, middle + sign * half), rtol=1e-6)
            assert told == f"${name}$ (pc)"
    oblique = js.Camera.orthographic((3, 2, 5), (0, 0, 0), view_height=4, width=40, height=20)
    extent, said = frame_of(oblique, js.io.Labels("q"), 40, 20)
    assert extent == pytest.approx((-4, 4, -2, 2)) and said[0] == "$x'$ (code units)"


@pytest.mark.parametrize("camera", cameras(), ids=["perspective", "orthographic"])
def test_a_length_across_the_line_of_sight_takes_as_many_pixels_as_are_said_and_a_camera_is_read_as_described(camera):
    depth = 6.0
    right = 2 * float(camera.half_height) * (depth if camera.is_perspective else 1) * camera.width / camera.height
    assert pixels_per_length(camera, depth) * right == pytest.approx(camera.width)
    read = described(camera.describe())
    for name in ("eye", "axes", "half_height", "near", "far", "width"):
        np.testing.assert_allclose(getattr(read, name), getattr(camera, name), atol=1e-8)
    assert read.is_perspective == camera.is_perspective and described("orthographic") is None


@given(st.floats(1e-20, 1e20))
def test_lengths_are_rounded_down_to_one_two_or_five(most):
    length = round_length(most)
    assert most / 2.51 < length <= most * (1 + 1e-12)
    assert f"{length:e}"[0] in "125" and float(f"{length:.0e}") == pytest.approx(length)


def test_bounds_are_those_of_all_parts():
    points = js.Points.from_arrays(np.array([[4.0, 0, 0]], np.float32), 0.5, (1, 1, 1), opacity=0.5)
    volume = js.Volume.from_array(np.zeros((2, 2, 2), np.float32), (-1, -2, -3), 1.0)
    look = js.TransferFunction.from_colormap("heat", (0, 1))
    lower, upper = js.Scene(volume=volume, volume_transfer=look, points=points).bounds()
    assert (lower <= [-1, -2, -3]).all() and upper[0] >= 4 and (np.abs(lower) < 10).all()
    assert not js.Scene(media=(js.IsoSurface.from_volume(volume, 0.5),)).parts
