"""Cameras along axes show all there is, with axes where a reader of plots expects them."""

import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.camera.framing import VIEWS, sight
from jaxsph.model.preview.frame import Direction


class Bounds:
    def __init__(self, lower, upper):
        self.lower, self.upper = np.asarray(lower, float), np.asarray(upper, float)

    def bounds(self):
        return self.lower, self.upper


THERE = Bounds((-1, 2, 10), (3, 3, 16))


@pytest.mark.parametrize(("axis", "right", "up", "ahead"), [("x", 1, 2, -1), ("y", 0, 2, 1), ("z", 0, 1, -1)])
def test_axes_point_to_the_right_and_upwards(axis, right, up, ahead):
    axes = np.asarray(js.Camera.along_axis(THERE, axis, 30, 20).axes)
    np.testing.assert_allclose(axes, [np.eye(3)[right], np.eye(3)[up], ahead * np.eye(3)["xyz".index(axis)]], atol=1e-7)


@pytest.mark.parametrize("view", ["iso", "x", "y", "z"])
@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (1, 0, 0), (0, -2, 0), (0.3, 1, -0.2)])
def test_what_is_up_is_so_in_the_picture_or_seen_from_above(view, up):
    forward, upward = sight(view, up)
    axes, up = Direction.along(forward, upward, None, (8, 8)).axes, np.array(up) / np.linalg.norm(up)
    right, upright, ahead = axes @ up
    assert abs(right) < 1e-9 and upright >= -1e-9 and ahead <= 1e-9
    if view == "iso":
        assert ahead == pytest.approx(-0.35 / np.linalg.norm((0.45, 0.35, 1)))
        return
    np.testing.assert_array_equal(np.abs(axes[2]), np.abs(VIEWS[view][0]))
    if upright < 1e-9 and abs(up[0]) < 1:
        np.testing.assert_allclose(axes[0], (1, 0, 0), atol=1e-12)


@pytest.mark.parametrize(("axis", "up", "rows"), [("x", 1, (-3, 2, -1)), ("y", 1, (1, -3, -2)), ("z", 2, (1, 2, -3))])
def test_an_axis_is_seen_with_what_is_said_to_be_up(axis, up, rows):
    axes = js.Camera.along_axis(THERE, axis, 30, 20, up=np.eye(3)[up]).axes
    np.testing.assert_allclose(axes, [np.sign(row) * np.eye(3)[abs(row) - 1] for row in rows], atol=1e-7)


@pytest.mark.parametrize("axis", "xyz")
@pytest.mark.parametrize("size", [(30, 20), (20, 30), (16, 16)])
def test_all_of_it_is_in_the_image_and_between_the_depths(axis, size):
    camera = js.Camera.along_axis(THERE, axis, *size)
    corners = np.stack(np.meshgrid(*zip(THERE.lower, THERE.upper, strict=True)), -1).reshape(-1, 3)
    view = (corners - camera.exact_eye()) @ np.asarray(camera.axes, np.float64).T
    half = float(camera.half_height) * np.array([size[0] / size[1], 1])
    assert (np.abs(view[:, :2]) <= half * (1 + 1e-6)).all() and np.isclose((np.abs(view[:, :2]) / half).max(), 1)
    assert float(camera.near) < view[:, 2].min() and view[:, 2].max() < float(camera.far)
    wider = js.Camera.along_axis(THERE, axis, *size, margin=1.25)
    np.testing.assert_allclose(wider.half_height, 1.25 * camera.half_height, rtol=1e-6)


@pytest.mark.parametrize("axis", "xyz")
def test_a_slab_is_between_two_coordinates(axis):
    camera, k = js.Camera.along_axis(THERE, axis, depth_range=(2.25, 2.75)), "xyz".index(axis)
    ends = [camera.exact_eye()[k] + float(depth) * np.asarray(camera.axes)[2, k] for depth in (camera.near, camera.far)]
    np.testing.assert_allclose(sorted(ends), (2.25, 2.75), atol=1e-5)


def test_a_point_and_what_is_flat_have_cameras_too():
    for there in (Bounds((1, 1, 1), (1, 1, 1)), Bounds((0, 0, 5), (1, 1, 5)), Bounds((0, 2, 0), (0, 2, 3))):
        for axis in "xyz":
            camera = js.Camera.along_axis(there, axis)
            assert float(camera.half_height) > 0 and float(camera.near) < float(camera.far)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"axis": "w"}, "`axis` must be 'x', 'y' or 'z'"),
        ({"depth_range": (2, 1)}, "`depth_range` must be"),
        ({"depth_range": (0, np.inf)}, "`depth_range` must be"),
    ],
)
def test_bad_input_is_refused_by_name(given, said):
    with pytest.raises(ValueError, match=said):
        js.Camera.along_axis(THERE, **given)
