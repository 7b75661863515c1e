"""What a view shows: inputs change the pose and the look, or nothing at all; no picture is made."""

import dataclasses
import json

import numpy as np
import pytest

import jaxsph as js
from jaxsph.viewer.inputs import InputError
from jaxsph.viewer.state import State, python_of


@pytest.fixture
def state():
    return State.of(*js.scenes.load("radial", 60, width=12, height=8))


def test_the_camera_is_that_which_was_given_until_something_moves(state):
    given = state.camera
    state = state.done({"do": "orbit", "right": 0.1, "down": 0.0})
    assert state.moved and not np.allclose(state.camera.eye, given.eye)
    state = state.done({"do": "home"})
    assert state.camera is given and not state.moved


@pytest.mark.parametrize("lacks", ["middle", "axis", "reach", "share", "kind"])
def test_a_cut_is_restored_with_all_that_it_has(state, lacks):
    told = json.loads(json.dumps(state.done({"do": "cut", "kind": "plane"}).told()))
    assert json.loads(json.dumps(state.done({"do": "restore", **told}).told()))["cut"]["kind"] == "plane"
    with pytest.raises(InputError, match=lacks):
        state.done({"do": "restore", **told, "cut": {name: value for name, value in told["cut"].items() if name != lacks}})


@pytest.mark.parametrize("points", [[[0.5, -1, 0, 0, 0]], "none"])
def test_a_view_is_restored_whole_or_not_at_all(state, points):
    there = state.done({"do": "orbit", "right": 0.2, "down": 0.1}).done({"do": "projection", "name": "parallel"})
    told = there.told()
    with pytest.raises(InputError):
        state = state.done({"do": "restore", "pose": told["pose"], "points": points})
    assert not state.moved and not state.edited
    state = state.done({"do": "restore", "pose": told["pose"], "points": None})
    for name, vector in told["pose"].items():
        np.testing.assert_allclose(state.told()["pose"][name], vector, atol=1e-6)
    np.testing.assert_allclose(state.camera.axes, there.camera.axes, atol=1e-6)
    assert state.camera.projection == "orthographic"


def shown(state):
    """Which particles are shown."""
    within = state.scene.within
    places = np.asarray(state.scene.particles.position, np.float64)
    return np.ones(len(places), bool) if within is None else np.asarray(within.contains(tuple(places.T)))


def test_a_plane_follows_the_view_until_it_is_held_and_cuts_what_is_before_it(state):
    state = state.done({"do": "cut", "kind": "plane"})
    position = np.asarray(state.scene.particles.position, np.float64)
    np.testing.assert_array_equal(shown(state), (position - state.pose.target) @ state.pose.axes[2] >= 0)
    state = state.done({"do": "orbit", "right": 0.3, "down": 0.1})
    np.testing.assert_array_equal(shown(state), (position - state.pose.target) @ state.pose.axes[2] >= 0)
    state = state.done({"do": "cut", "follows": False, "share": 0.1})
    held = shown(state)
    state = state.done({"do": "orbit", "right": 0.3, "down": 0.1})
    np.testing.assert_array_equal(shown(state), held)
    state = state.done({"do": "cut", "outside": True})
    np.testing.assert_array_equal(shown(state), ~held)
    state = state.done({"do": "cut", "kind": "off"})
    assert state.scene.within is None and state.told()["cut"] is None


@pytest.mark.parametrize(("up", "eye"), [((0, 1, 0), (1.5, 1.2, 3)), ((0, 0, 1), (1.5, -3, 1.2))])
def test_what_is_up_in_the_first_view_is_so_along_all_axes(up, eye):
    scene, _ = js.scenes.load("radial", 60, width=12, height=8)
    state = State.of(scene, js.Camera.look_at(eye, (0, 0, 0), up, width=12, height=8))
    for along in ("x", "-x", "y", "z", "iso"):
        state = state.done({"do": "axis", "name": along})
        right, upright, ahead = state.pose.axes @ up
        assert abs(right) < 1e-9 and (upright > 0.5 or ahead == -1)


def test_a_view_of_a_camera_whose_depths_were_found_is_between_these():
    scene, camera = js.scenes.load("radial", 60, width=12, height=8)
    found = dataclasses.replace(camera, near=None, far=None, snug=np.array(camera.near_and_far(), np.float32))
    there, same = State.of(scene, found), State.of(scene, camera)
    assert there.camera.near == camera.near and there.camera.far == camera.far
    assert there.pose.told() == same.pose.told()


@pytest.mark.parametrize("kind", ["box", "sphere"])
def test_a_box_and_a_sphere_are_sized_around_the_middle_of_the_view(state, kind):
    state = state.done({"do": "cut", "kind": kind, "share": 0.2})
    few = shown(state)
    state = state.done({"do": "cut", "share": 0.4})
    assert few.sum() < shown(state).sum() < len(few)
    before = state.pose.target
    state = state.done({"do": "pan", "right": 0.3, "down": 0.0})
    np.testing.assert_allclose(state.cut.middle, before)
    state = state.done({"do": "cut", "here": True})
    np.testing.assert_allclose(state.cut.middle, state.pose.target)


def test_a_cut_is_restored_with_the_view_and_comes_on_top_of_that_of_the_scene():
    scene, camera = js.scenes.load("radial", 60, width=12, height=8)
    scene = dataclasses.replace(scene, within=js.Sphere((0, 0, 0), 0.9))
    there, here = State.of(scene, camera), State.of(scene, camera)
    there = there.done({"do": "cut", "kind": "box", "share": 0.3, "outside": True})
    told = json.loads(json.dumps(there.told()))
    here = here.done({"do": "restore", "pose": told["pose"], "points": None, "cut": told["cut"]})
    assert python_of(here.scene.within) == python_of(there.scene.within)
    assert [word.partition("(")[0] for word in python_of(here.scene.within)[1:].split(" & ")] == ["js.Sphere", "~js.Box"]
    here = here.done({"do": "restore", "pose": told["pose"], "cut": None})
    assert here.scene.within is scene.within


@pytest.mark.parametrize(
    "said", [{}, {"share": 0.1}, {"kind": "cone"}, {"kind": "plane", "share": 3}, {"kind": "box", "share": 0}], ids=str
)
def test_a_cut_that_makes_no_sense_is_refused(state, said):
    with pytest.raises(InputError):
        state = state.done({"do": "cut", **said})
    assert state.cut is None


@pytest.mark.parametrize(
    "change", [{"kind": "cone"}, {"middle": [0, 0]}, {"axis": [0, 0, 0]}, {"reach": -1}, {"share": "a"}], ids=str
)
def test_an_address_with_a_cut_that_is_none_changes_nothing(state, change):
    state = state.done({"do": "cut", "kind": "plane"})
    told, before = state.told(), state.cut
    with pytest.raises(InputError):
        state = state.done({"do": "restore", "pose": told["pose"], "cut": {**told["cut"], **change}})
    assert state.cut is before and not state.moved


def test_key_frames_are_a_path_around_what_the_view_turns_about_and_become_a_file(state, tmp_path):
    state = state.done({"do": "key"})
    assert state.path is None and state.told()["keys"] == 1
    state = state.done({"do": "orbit", "right": 0.3, "down": 0.1})
    state = state.done({"do": "key"})
    path = state.path
    assert path.legs[0].times == (0, 2) and np.allclose(path.legs[0].around, state.pose.target)
    path.save(tmp_path / "keys.json")
    again = js.CameraPath.load(tmp_path / "keys.json")
    np.testing.assert_allclose(again.at(2.0).exact_eye(), state.camera.exact_eye(), atol=1e-6)
    state = state.done({"do": "projection", "name": "parallel"})
    with pytest.raises(InputError, match="all of perspective or all of parallel"):
        state = state.done({"do": "key"})
    for _ in range(3):
        state = state.done({"do": "unkey"})
    assert state.path is None and state.told()["keys"] == 0
