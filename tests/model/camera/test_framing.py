"""Cameras show all there is, along axes as readers of plots expect; depths that are not given hold all that, and little else."""

import dataclasses

import jax
import numpy as np
import pytest
from rows import Fog

import jaxsph as js
from jaxsph.model.camera.directions import VIEWS, sight
from jaxsph.model.camera.framing import snug, with_depths
from jaxsph.model.preview.frame import Direction, snug_in_picture


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


pytestmark = pytest.mark.usefixtures("quick_programs")

RNG = np.random.default_rng(4)
POSITION = RNG.uniform(-0.5, 0.5, (40, 3))
PARTICLES = js.Particles.from_arrays(POSITION, 0.3, POSITION[:, 2])
LOOK = js.TransferFunction.from_points([-1.0, 1.0], [[1, 0, 0], [0, 0, 1]], [1.0, 2.0])
SCENE = js.Scene(PARTICLES, LOOK)
VIEW = {"eye": (0, 0, 4), "target": (0, 0, 0), "width": 24, "height": 16}
OPEN = js.Camera.look_at(**VIEW)
SETTINGS = js.Settings(samples=16)


def between(near, far, camera):
    assert float(camera.near) == pytest.approx(near, rel=3e-4, abs=3e-4)
    assert float(camera.far) == pytest.approx(far, rel=3e-4, abs=3e-4)


def test_depths_are_those_of_supports_radii_and_grids():
    depth = 4 - POSITION[:, 2]
    between((depth - 0.3).min(), (depth + 0.3).max(), with_depths(OPEN, SCENE))
    between((depth - 0.3).min(), (depth + 0.3).max(), with_depths(OPEN, PARTICLES))
    points = js.Points.from_arrays([[0, 0, 1.0]], 0.5, opacity=0.5)
    volume = js.Volume.from_array(np.zeros((2, 2, 2)), lower=(0, 0, -3), spacing=1.0)
    between(2.5, 3.5, with_depths(OPEN, points))
    between(2.5, 7.0, with_depths(OPEN, js.Scene(points=points, volume=volume, volume_transfer=LOOK)))
    between(
        3.5, 4.5, with_depths(OPEN, js.Particles.from_arrays(np.zeros((1, 3)), 0.1, 1.0, box=js.Box((-1, -1, -0.5), (1, 1, 0.5))))
    )


@pytest.mark.parametrize(
    ("within", "ends"),
    [
        (js.Box((-9, -9, 0.1), (9, 9, 0.3)), (3.7, 3.9)),
        (js.Plane((0, 0, 0.2), (0, 0, -3)), (3.8, None)),
        (js.Sphere((0, 0, 0.3), 0.1) | js.Sphere((0, 0, -0.2), 0.1), (3.6, 4.3)),
        (js.Sphere((0, 0, 20), 0.1), (None, None)),
    ],
)
def test_depths_follow_what_a_clip_shows(within, ends):
    """Of an open camera, and of one that is fitted; a clip that shows nothing changes none."""
    depth = 4 - POSITION[:, 2]
    all_of = (depth - 0.3).min(), (depth + 0.3).max()
    ends = tuple(of if end is None else end for end, of in zip(ends, all_of, strict=True))
    shown = dataclasses.replace(SCENE, within=within)
    between(*ends, with_depths(OPEN, shown))
    wide = js.Camera.look_at(**VIEW, near=1, far=9)
    assert snug_in_picture(wide, shown).near_and_far() == pytest.approx(ends, rel=3e-3)


def test_what_is_given_stays():
    given = js.Camera.look_at(**VIEW, near=1, far=9)
    assert with_depths(given, SCENE) is given
    one = with_depths(js.Camera.look_at(**VIEW, near=1.5), SCENE)
    assert float(one.near) == 1.5 and 4.5 < float(one.far) < 5
    flat = with_depths(js.Camera.orthographic(**VIEW, view_height=2.0), SCENE)
    assert 3 < float(flat.near) < float(flat.far) < 5


def test_the_eye_may_be_inside_and_a_scene_empty_or_behind():
    inside = with_depths(js.Camera.look_at(**VIEW | {"eye": (0, 0, 0.1)}), SCENE)
    assert 0 < float(inside.near) < float(inside.far) < 1
    behind = with_depths(js.Camera.look_at(**VIEW | {"target": (0, 0, 8)}), SCENE)
    empty = with_depths(OPEN, dataclasses.replace(SCENE, particles=js.Particles.from_arrays(np.zeros((0, 3)), 1.0, 1.0)))
    for camera in (behind, empty):
        assert 0 < float(camera.near) < float(camera.far)
    assert snug(behind, PARTICLES) is behind


def test_verbs_take_depths_from_the_scene():
    closed = with_depths(OPEN, SCENE)
    image = js.render(SCENE, OPEN, SETTINGS)
    np.testing.assert_array_equal(image.color, js.render(SCENE, closed, SETTINGS).color)
    assert dict(image.metadata) == dict(js.render(SCENE, closed, SETTINGS).metadata)
    assert js.plan(SCENE, OPEN, SETTINGS) == js.plan(SCENE, closed, SETTINGS)
    truth = js.reference.render(SCENE, OPEN, SETTINGS)
    np.testing.assert_array_equal(truth.color, js.reference.render(SCENE, closed, SETTINGS).color)
    assert np.abs(np.asarray(image.color) - truth.color).max() < 1e-5
    np.testing.assert_array_equal(js.reference.project(PARTICLES, OPEN).values, js.reference.project(PARTICLES, closed).values)


def test_under_a_trace_depths_are_asked_for():
    plan = js.plan(SCENE, OPEN, SETTINGS)
    for render in (lambda camera: js.render(SCENE, camera, SETTINGS, plan=plan).color,):
        with pytest.raises(ValueError, match="`near` and `far` must be given under jit"):
            jax.eval_shape(render, OPEN)


def test_depths_found_for_a_picture_are_its_own_but_not_those_of_columns():
    closed = with_depths(OPEN, SCENE)
    found = dataclasses.replace(OPEN, snug=np.array([3.5, 4.25], np.float32))
    given = dataclasses.replace(OPEN, near=np.float32(3.5), far=np.float32(4.25))
    assert with_depths(found, SCENE).near_and_far() == found.near_and_far() == (3.5, 4.25)
    assert with_depths(dataclasses.replace(found, near=np.float32(3)), SCENE).near_and_far() == (3, 4.25)
    assert with_depths(found, PARTICLES).near_and_far() == closed.near_and_far() and "of the scene" in repr(found)
    image = js.render(SCENE, given, SETTINGS)
    np.testing.assert_array_equal(js.render(SCENE, found, SETTINGS).color, image.color)
    assert dict(js.render(SCENE, found, SETTINGS).metadata) == dict(image.metadata)
    plan = js.plan(SCENE, found, SETTINGS)
    shape = jax.eval_shape(lambda camera: js.render(SCENE, camera, SETTINGS, plan=plan).color, found)
    assert shape.shape == (16, 24, 3)


def test_what_cannot_tell_depths_is_refused():
    with pytest.raises(ValueError, match="`near` and `far` must be given with `media`"):
        js.render(js.Scene(media=(Fog.of(),)), OPEN, SETTINGS)
    with pytest.raises(ValueError, match="hold nothing of the scene"):
        js.render(SCENE, js.Camera.look_at(**VIEW, near=8.0), SETTINGS)
    for call in (OPEN.near_and_far, OPEN.describe, lambda: js.CameraPath.from_keys([(0, OPEN), (1, OPEN)]).at(0.5)):
        with pytest.raises(ValueError, match="`near` and `far` must be numbers here"):
            call()
    for wrong in ({"near": -1.0}, {"near": np.nan}, {"far": np.inf}):
        with pytest.raises(ValueError, match="`near` must be"):
            js.Camera.look_at(**VIEW, **wrong)
    assert "near of the scene, far of the scene" in repr(OPEN)
