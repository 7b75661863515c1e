"""What a view shows: inputs change the pose and the look, or nothing at all; no picture is made."""

import numpy as np
import pytest

import jaxsph as js
from jaxsph.viewer.inputs import InputError
from jaxsph.viewer.state import State


@pytest.fixture
def state():
    return State(*js.scenes.load("radial", 60, width=12, height=8))


def nowhere(_):
    raise AssertionError("nobody asks what is seen")


def test_the_camera_is_that_which_was_given_until_something_moves(state):
    given = state.camera
    state.do({"do": "orbit", "right": 0.1, "down": 0.0}, nowhere)
    assert state.moved and not np.allclose(state.camera.eye, given.eye)
    state.do({"do": "home"}, nowhere)
    assert state.camera is given and not state.moved


def test_a_look_that_is_edited_changes_the_scene_and_nothing_else(state):
    pose, before = state.pose, np.asarray(state.transfer.extinction)
    state.do({"do": "exposure", "stops": 1.0}, nowhere)
    assert state.edited and state.pose is pose
    np.testing.assert_allclose(np.asarray(state.transfer.extinction), 2 * before, rtol=1e-6)


@pytest.mark.parametrize("points", [[[0.5, -1, 0, 0, 0]], "none"])
def test_a_view_is_restored_whole_or_not_at_all(state, points):
    there = State(*js.scenes.load("radial", 60, width=12, height=8))
    there.do({"do": "orbit", "right": 0.2, "down": 0.1}, nowhere)
    told = there.told()
    with pytest.raises(InputError):
        state.do({"do": "restore", "pose": told["pose"], "points": points}, nowhere)
    assert not state.moved and not state.edited
    state.do({"do": "restore", "pose": told["pose"], "points": None}, nowhere)
    for name, vector in told["pose"].items():
        np.testing.assert_allclose(state.told()["pose"][name], vector, atol=1e-6)


def test_the_middle_is_what_is_seen_there(state):
    state.do({"do": "center", "right": 0.1, "down": 0.1}, lambda message: np.array([0.25, 0.5, 0.125]))
    np.testing.assert_allclose(state.pose.target, (0.25, 0.5, 0.125))
