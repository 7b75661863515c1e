"""Camera paths: keys are met, curves between are smooth, ordered and in range, and bad keys are refused by name."""

import itertools

import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st
from scipy.spatial.transform import Rotation

import jaxsph as js
from jaxsph.model.camera.path import through, turning

FEW = examples(20)


def camera(eye, target=(0, 0, 0), near=1.0, far=20.0, **more):
    return js.Camera.look_at(eye, target, width=40, height=30, near=near, far=far, **more)


def numbers(one):
    return {name: float(getattr(one, name)) for name in ("half_height", "near", "far")}


@FEW
@given(st.integers(0, 1000), st.booleans())
def test_the_camera_of_a_keys_time_is_that_key_and_others_see_no_more_depth_or_zoom(seed, goes_around):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.1, 2, 4))
    keys = []
    for time in times:
        near = 10 ** rng.uniform(-2, 1)
        eye = rng.normal(size=3) + (0, 0, 6)
        keys.append(
            (time, camera(eye, rng.normal(size=3) * 0.1, near, near * 10 ** rng.uniform(0.1, 2), fov_degrees=rng.uniform(5, 90)))
        )
    path = js.CameraPath.from_keys(keys, around=(0, 0, 0) if goes_around else None)
    for time, key in keys:
        met = path.at(time)
        np.testing.assert_allclose(met.exact_eye(), key.exact_eye(), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(met.axes, key.axes, atol=1e-6)
        assert numbers(met) == pytest.approx(numbers(key), rel=1e-5)
    for (begin, one), (end, other) in itertools.pairwise(keys):
        for time in np.linspace(begin, end, 9):
            between = numbers(path.at(time))
            for name, value in between.items():
                low, high = sorted((numbers(one)[name], numbers(other)[name]))
                assert low * (1 - 1e-5) <= value <= high * (1 + 1e-5), name
            assert between["near"] < between["far"]


def test_an_orbit_is_a_circle_that_always_looks_at_its_centre():
    path = js.CameraPath.orbit(camera((0, 3, 10), (0, 1, 0)), 360, center=(0, 1, 0), seconds=4)
    for time in np.linspace(0, 4, 33):
        at, angle = path.at(time), 2 * np.pi * time / 4
        planar = np.hypot(*at.exact_eye()[[0, 2]])
        assert planar == pytest.approx(10, rel=1e-6) and at.exact_eye()[1] == pytest.approx(3, rel=1e-6)
        np.testing.assert_allclose(at.exact_eye()[[0, 2]] / 10, [np.sin(angle), np.cos(angle)], atol=1e-6)
        ahead = np.asarray(at.axes, float) @ (np.array([0, 1, 0]) - at.exact_eye())
        np.testing.assert_allclose(ahead[:2], 0, atol=1e-5)


def test_an_orbit_of_a_ball_has_it_in_view_and_between_near_and_far():
    path = js.CameraPath.orbit(center=(5, 0, 0), radius=2.0, degrees=-90, width=30, height=20)
    for time in (0, 3.3, 10):
        at = path.at(time)
        depth = np.asarray(at.axes, float)[2] @ (np.array([5, 0, 0]) - at.exact_eye())
        assert float(at.near) == pytest.approx(depth - 2, rel=1e-5) and float(at.far) == pytest.approx(depth + 2, rel=1e-5)
        assert np.arcsin(2 / depth) < np.arctan(float(at.half_height) * 1.1)


def test_flying_to_something_is_geometric_in_its_distance_and_begins_and_ends_at_rest():
    path = js.CameraPath.from_keys([(0, camera((0, 0, 1000), near=500, far=1500))]).fly_to(camera((0, 0, 10), near=5, far=15), 4)
    distance = np.array([path.at(time).exact_eye()[2] for time in np.linspace(0, 4, 41)])
    assert (np.diff(distance) < 0).all() and distance[20] == pytest.approx(100, rel=1e-4)
    logs = np.diff(np.log(distance))
    assert abs(logs[0]) < 0.1 * abs(logs).max() and abs(logs[-1]) < 0.1 * abs(logs).max()


def test_two_views_of_one_thing_from_two_sides_stay_views_of_it():
    path = js.CameraPath.from_keys([(0, camera((0, 0, 10))), (1, camera((10, 0, 0)))], around=(0, 0, 0))
    np.testing.assert_allclose(path.at(0.5).exact_eye(), [50**0.5, 0, 50**0.5], rtol=1e-6)


def test_turning_the_head_leaves_the_eye_where_it_is():
    path = js.CameraPath.from_keys([(0, camera((1, 2, 3), (0, 0, 0))), (1, camera((1, 2, 3), (9, 2, 3)))])
    for time in (0.2, 0.5, 0.9):
        np.testing.assert_allclose(path.at(time).exact_eye(), [1, 2, 3], atol=1e-6)


def test_a_path_after_a_path_begins_where_that_ends_and_stands_still_outside():
    orbit = js.CameraPath.orbit(camera((0, 0, 10), near=8, far=12), 90, seconds=2)
    path = orbit.then(js.CameraPath.orbit(orbit.at(2), -90, center=(0, 0, 0), seconds=3))
    assert (path.start, path.end) == (0, 5)
    for time in (-1, 0, 5, 99):
        np.testing.assert_allclose(path.at(time).exact_eye(), [0, 0, 10], atol=1e-5)
    assert len(path.cameras(7)) == 7


def test_parallel_rays_zoom_geometrically():
    keys = [js.Camera.orthographic((0, 0, 0), (0, 0, 1), view_height=size, near=-size, far=size) for size in (1.0, 100.0)]
    middle = js.CameraPath.from_keys([(0, keys[0]), (1, keys[1])]).at(0.5)
    assert 2 * float(middle.half_height) == pytest.approx(10, rel=1e-5) and not middle.is_perspective


def test_far_from_the_origin_the_eye_keeps_its_place():
    at = np.array([1e7, -2e7, 3e7])
    path = js.CameraPath.orbit(camera(at + (0, 0, 10), at), 360, center=at, seconds=1)
    np.testing.assert_allclose(path.at(0.25).exact_eye() - at, [10, 0, 0], atol=1e-5)


GOOD = camera((0, 0, 9))


@pytest.mark.parametrize(
    ("keys", "more", "said"),
    [
        ([], {}, "at least one"),
        ([(0, GOOD), (0, GOOD)], {}, "0 follows 0"),
        ([(1, GOOD), (0.5, GOOD)], {}, "0.5 follows 1"),
        ([(np.nan, GOOD)], {}, "finite"),
        ([(0, GOOD), (1, js.Camera.look_at((0, 0, 9), (0, 0, 0), near=1, far=2, width=41, height=30))], {}, "width"),
        ([(0, GOOD), (1, js.Camera.orthographic((0, 0, 9), (0, 0, 0), near=1, far=2, width=40, height=30))], {}, "projection"),
        ([(0, "camera")], {}, "str"),
        ([GOOD], {}, "pairs"),
        ([(0, GOOD), (1, GOOD)], {"around": (0, 0, 99)}, "behind that of time 0"),
        ([(0, GOOD)], {"around": (0, 0)}, r"`around` must have shape \(3,\)"),
    ],
)
def test_keys_that_make_no_path_are_refused_with_the_reason(keys, more, said):
    with pytest.raises(ValueError, match=said):
        js.CameraPath.from_keys(keys, **more)


@pytest.mark.parametrize(("given", "said"), [
    ({}, "needs a `camera`"), ({"camera": GOOD, "up": (0, 0, 0)}, "axis"),
    ({"camera": GOOD, "degrees": np.inf}, "degrees"), ({"camera": GOOD, "seconds": 0}, "seconds"),
    ({"camera": GOOD, "width": 3}, "leave it out"), ({"center": (0, 0, 0), "radius": -1}, "radius"),
])  # fmt: skip
def test_an_orbit_without_what_it_needs_is_refused(given, said):
    with pytest.raises(ValueError, match=said):
        js.CameraPath.orbit(**given)


OFTEN = examples(25)
seeds = st.integers(0, 10_000)


def drawn(seed, keys=6):
    rng = np.random.default_rng(seed)
    return rng, np.cumsum(rng.uniform(0.2, 3, keys))


@OFTEN
@given(seeds)
def test_places_and_rotations_are_met_and_their_speed_is_continuous(seed):
    rng, times = drawn(seed)
    keys = Rotation.from_rotvec(rng.normal(size=(len(times), 3)))
    places, turned = through(times, rng.normal(size=(len(times), 3))), turning(times, keys)
    for k, time in enumerate(times):
        assert (turned(time).inv() * keys[k]).magnitude() < 1e-9
    small = 1e-7
    for time in times[1:-1]:
        before, after = turned(time - small).inv() * turned(time), turned(time).inv() * turned(time + small)
        np.testing.assert_allclose(before.as_rotvec() / small, after.as_rotvec() / small, atol=0.01)
        slopes = places(time) - places(time - small), places(time + small) - places(time)
        np.testing.assert_allclose(slopes[0] / small, slopes[1] / small, atol=0.01)


def test_what_stands_still_between_two_keys_stands_still():
    times = np.array([0.0, 1, 2, 3])
    places = through(times, np.array([[0.0, 0], [1, 2], [1, 2], [5, 5]]))
    turned = turning(times, Rotation.from_rotvec([[0, 0, 0], [0, 1, 0], [0, 1, 0], [1, 1, 0]]))
    for time in np.linspace(1, 2, 11):
        np.testing.assert_allclose(places(time), [1, 2], atol=1e-14)
        np.testing.assert_allclose(turned(time).as_rotvec(), [0, 1, 0], atol=1e-12)


@pytest.mark.parametrize("spacing", [(1, 1, 1), (0.2, 3, 1)])
def test_turning_evenly_about_one_axis_stays_even(spacing):
    times = np.cumsum((0, *spacing))
    axis = np.array([0.6, 0, 0.8])
    turned = turning(times, Rotation.from_rotvec(0.7 * times[:, None] * axis))
    for time in np.linspace(0, times[-1], 23):
        assert (turned(time).inv() * Rotation.from_rotvec(0.7 * time * axis)).magnitude() < 1e-9


def test_two_rotations_are_joined_on_the_shortest_way():
    keys = Rotation.from_euler("y", [[10], [350]], degrees=True)
    found = turning(np.array([0.0, 1]), keys)(0.5)
    assert found.magnitude() < 1e-9  # by 0 degrees, not by 180
