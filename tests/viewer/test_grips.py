"""What is cut is drawn where the camera sees it, and its grips follow the pointer; no picture is made."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph.viewer.inputs import InputError
from jaxsph.viewer.state import State

WIDTH, HEIGHT = 120, 80
PERSPECTIVE, PARALLEL = {"do": "projection", "name": "perspective"}, {"do": "projection", "name": "parallel"}
PULLS = st.floats(-0.2, 0.2)


def nowhere(_):
    raise AssertionError("nobody asks what is seen")


def viewed(*messages):
    state = State(*js.scenes.load("radial", 60, width=WIDTH, height=HEIGHT))
    for message in messages:
        state.do(message, nowhere)
    return state


def cut(**said):
    return {"do": "cut", **said}


TURN = {"do": "orbit", "right": 0.23, "down": 0.11}
HELD = cut(kind="plane"), cut(follows=False), TURN, {"do": "pan", "right": 0.1, "down": 0.05}


def pixels(camera, places):
    """Where the rays of a camera that meet places cross the picture, from its middle, in shares of its height."""
    view = np.asarray(camera.to_view(np.float32(places)), np.float64)
    lateral = view[..., :2] / (view[..., 2:] if camera.is_perspective else 1)
    ends = [np.array([float(of(0.0)), float(of(float(size)))]) for of, size in ((camera.column, WIDTH), (camera.row, HEIGHT))]
    columns, rows = (
        (lateral[..., k] - end[0]) / (end[1] - end[0]) * size
        for k, (end, size) in enumerate(zip(ends, (WIDTH, HEIGHT), strict=True))
    )
    return np.stack([(columns - WIDTH / 2) / HEIGHT, (rows - HEIGHT / 2) / HEIGHT], -1)


def grips(state):
    return {one["name"]: np.array(one["at"]) for one in state.told()["outline"]["grips"]}


@pytest.mark.parametrize("rays", [PERSPECTIVE, PARALLEL], ids=lambda said: said["name"])
def test_a_box_is_drawn_where_the_camera_sees_its_corners(rays):
    state = viewed(rays, TURN, cut(kind="box", share=0.3), {"do": "pan", "right": 0.1, "down": 0.05})
    lower, upper = (np.asarray(one) for one in state.cut.clip().corners())
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True), indexing="ij"), -1).reshape(-1, 3)
    seen, lines = pixels(state.camera, corners), np.array(state.told()["outline"]["lines"]).reshape(-1, 2, 2)
    assert len(lines) == 12
    nearest = np.linalg.norm(lines[:, :, None] - seen, axis=-1)
    assert nearest.min(-1).max() < 1e-5 and (np.bincount(nearest.argmin(-1).ravel()) == 3).all()
    np.testing.assert_allclose(grips(state)["middle"], pixels(state.camera, (lower + upper) / 2), atol=1e-5)


@pytest.mark.parametrize("rays", [PERSPECTIVE, PARALLEL], ids=lambda said: said["name"])
def test_the_circle_of_a_sphere_is_where_rays_of_the_camera_touch_it(rays):
    state = viewed(rays, TURN, cut(kind="sphere", share=0.6), {"do": "pan", "right": 0.3, "down": 0.1})
    middle, radius = np.array(state.cut.middle), state.cut.reach * state.cut.share
    for right, down, *_ in state.told()["outline"]["lines"]:
        begin, end = (state.pose.place_at(right, down, depth) for depth in (0.0, 1.0))
        np.testing.assert_allclose(pixels(state.camera, end), (right, down), atol=1e-5)
        away = np.linalg.norm(np.cross(end - begin, middle - begin)) / np.linalg.norm(end - begin)
        assert away == pytest.approx(radius)


@pytest.mark.parametrize("rays", [PERSPECTIVE, PARALLEL], ids=lambda said: said["name"])
def test_corners_that_stand_for_a_plane_are_of_the_plane(rays):
    state = viewed(rays, *HELD, cut(share=0.2))
    clip, lines = state.cut.clip(), np.array(state.told()["outline"]["lines"]).reshape(-1, 2, 2)
    normal, point = (np.asarray(one, np.float64) for one in (clip.normal, clip.point))
    for right, down in lines[:4, 0]:
        begin, end = (state.pose.place_at(right, down, depth) for depth in (0.0, 1.0))
        met = begin + (end - begin) * (normal @ (point - begin)) / (normal @ (end - begin))
        assert np.linalg.norm(met - point) == pytest.approx(0.6 * np.sqrt(2) * state.cut.reach, rel=1e-5)
    np.testing.assert_allclose(lines[4, 0], pixels(state.camera, point), atol=1e-5)


@pytest.mark.parametrize("rays", [PERSPECTIVE, PARALLEL], ids=lambda said: said["name"])
@pytest.mark.parametrize(("kind", "name"), [("box", "middle"), ("sphere", "middle"), ("sphere", "share"), ("plane", "tip")])
@given(right=PULLS, down=PULLS)
def test_a_grip_comes_where_it_is_pulled_to_and_the_camera_stays(rays, kind, name, right, down):
    state = viewed(rays, *(HELD if kind == "plane" else (TURN, cut(kind=kind))))
    pose, before = state.pose, grips(state)
    if name == "share":  # along its line alone: a circle has one size
        down = 0.0
    state.do({"do": "grip", "name": name, "right": right, "down": down}, nowhere)
    after = grips(state)
    assert state.pose is pose
    if name == "tip":  # as far as it reaches
        placed = np.array(state.cut.middle) + state.cut.reach * state.cut.share * np.array(state.cut.axis)
        wanted = pose.place_at(*(before[name] + (right, down)), pose.seen_at(placed)[2])
        if np.linalg.norm(wanted - placed) > 0.4 * state.cut.reach:
            return
    np.testing.assert_allclose(after[name], before[name] + (right, down), atol=1e-6)


@pytest.mark.parametrize("rays", [PERSPECTIVE, PARALLEL], ids=lambda said: said["name"])
@pytest.mark.parametrize("messages", [HELD, (TURN, cut(kind="box"))], ids=["plane", "box"])
def test_what_is_pulled_along_its_line_comes_along_and_no_farther_than_the_share_may(rays, messages):
    state = viewed(rays, *messages)
    first, share = grips(state)["share"], state.cut.share
    state.do(cut(share=share + 0.05), nowhere)
    way = grips(state)["share"] - first
    state.do(cut(share=share), nowhere)
    state.do({"do": "grip", "name": "share", "right": way[0], "down": way[1]}, nowhere)
    assert state.cut.share == pytest.approx(share + 0.05)
    for _ in range(9):
        state.do({"do": "grip", "name": "share", "right": 50 * way[0], "down": 50 * way[1]}, nowhere)
    assert state.cut.share <= 2.0


def test_a_plane_that_faces_parallel_rays_is_pulled_away_from_them():
    state = viewed(PARALLEL, cut(kind="plane"))
    state.do({"do": "grip", "name": "share", "right": 0.3, "down": 0.1}, nowhere)
    assert state.cut.share == pytest.approx(0.2)
    assert set(grips(state)) == {"share"}  # one that follows the view is not turned
    state.do({"do": "grip", "name": "share", "right": 0.0, "down": 50.0}, nowhere)
    assert state.cut.share == 2.0


def test_a_plane_that_is_turned_keeps_its_middle():
    state = viewed(*HELD, cut(share=0.3))

    def placed():
        return np.array(state.cut.middle) + state.cut.reach * state.cut.share * np.array(state.cut.axis)

    before, axis = placed(), state.cut.axis
    state.do({"do": "grip", "name": "tip", "right": 0.05, "down": -0.08}, nowhere)
    np.testing.assert_allclose(placed(), before)
    assert np.linalg.norm(state.cut.axis) == pytest.approx(1) and np.dot(state.cut.axis, axis) < 0.999


@pytest.mark.parametrize("kind", ["plane", "box", "sphere"])
def test_what_is_behind_the_eye_is_not_drawn(kind):
    state = viewed(cut(kind=kind, share=1.5), {"do": "zoom", "factor": 40.0}, {"do": "orbit", "right": 0.4, "down": 0.2})
    lines = np.array(state.told()["outline"]["lines"])
    assert np.isfinite(lines).all() and (np.abs(lines) < 1e5).all()


@pytest.mark.parametrize("said", [{"name": "tip"}, {"name": 3}, {"name": "share", "right": "far"}, {"name": "share"}], ids=str)
def test_a_grip_that_is_none_is_refused(said):
    state = viewed(cut(kind="sphere"))
    before = state.cut
    with pytest.raises(InputError):
        state.do({"do": "grip", **said}, nowhere)
    assert state.cut is before
    with pytest.raises(InputError, match="nothing is cut"):
        viewed().do({"do": "grip", "name": "share", "right": 0, "down": 0}, nowhere)
