"""Camera paths as files: what is saved is read again, what a person wrote is understood or refused by name."""

import json

import numpy as np
import pytest

import jaxsph as js

KEY = {"time": 0, "eye": [0, 0, 9], "target": [0, 0, 0], "near": 1, "far": 20}
LATER = KEY | {"time": 4, "eye": [9, 0, 0]}


def written(tmp_path, content):
    path = tmp_path / "keys.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_a_saved_path_gives_the_same_cameras(tmp_path):
    camera = js.Camera.look_at((1, 2, 30), (0, 0.5, 0), fov_degrees=20, width=44, height=33, near=2, far=50)
    closer = js.Camera.look_at((0.5, 0, 2), (0, 0.5, 0), width=44, height=33, near=0.1, far=5)
    path = js.CameraPath.orbit(camera, 200).fly_to(closer, 3)
    path.save(tmp_path / "path.json")
    again = js.CameraPath.load(tmp_path / "path.json")
    for time in np.linspace(-1, 14, 31):
        one, other = path.at(time), again.at(time)
        assert (one.width, one.height) == (other.width, other.height)
        np.testing.assert_allclose(one.exact_eye(), other.exact_eye(), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(one.axes, other.axes, atol=1e-6)
        np.testing.assert_allclose(float(one.near), float(other.near), rtol=1e-6)


def test_parallel_cameras_are_saved_too(tmp_path):
    key = js.Camera.orthographic((1, 2, 3), (0, 0, 0), view_height=7.0, near=-2, far=9)
    js.CameraPath.from_keys([(2, key)]).save(tmp_path / "path.json")
    again = js.CameraPath.load(tmp_path / "path.json").at(2)
    assert again.projection == "orthographic" and float(again.half_height) == 3.5 and float(again.near) == -2


def test_what_is_left_out_is_of_the_box_that_is_shown_and_of_the_size_asked_for(tmp_path):
    particles = js.Particles.from_arrays([[0.0, 0, 0], [1, 1, 1]], 0.5, 1.0)
    keys = [{name: key[name] for name in ("time", "eye", "target")} for key in (KEY, LATER)]
    path = js.CameraPath.load(written(tmp_path, {"keys": keys, "around": [0, 0, 0]}), width=20, height=10, shown=particles)
    for time in (0, 4):
        camera = path.at(time)
        assert (camera.width, camera.height) == (20, 10)
        assert float(camera.near) == pytest.approx(7.5, rel=1e-3) and float(camera.far) == pytest.approx(9.5, rel=1e-3)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "no JSON"),
        ([KEY], "must be an object"),
        ({}, '"keys", or "legs"'),
        ({"keys": []}, "at least one key"),
        ({"legs": 3}, "list of objects"),
        ({"keys": [KEY], "loop": True}, "'loop'"),
        ({"keys": [KEY | {"roll": 3}]}, "key 1 has 'roll', which is not known; it may have time, eye"),
        ({"keys": [{"time": 0, "eye": [0, 0, 1]}]}, "key 1 lacks `target`"),
        ({"keys": [KEY, {name: LATER[name] for name in LATER if name != "time"}]}, "key 2 lacks `time`"),
        ({"keys": [KEY | {"eye": [0, 0]}]}, "`eye` of key 1 must be three finite numbers"),
        ({"keys": [KEY | {"fov": "wide"}]}, "`fov` of key 1"),
        ({"keys": [KEY | {"fov": 200}]}, "fov_degrees"),
        ({"keys": [KEY | {"fov": 30, "view_height": 2}]}, "both"),
        ({"keys": [KEY | {"target": [0, 0, 9]}]}, "key 1: `target`"),
        ({"keys": [LATER, KEY]}, "0 follows 4"),
        ({"keys": [{name: KEY[name] for name in KEY if name != "far"}]}, "lacks `far`"),
        ({"keys": [KEY], "width": 0}, "width"),
        ({"keys": [KEY], "version": 9}, "version"),
        ({"keys": [KEY], "version": True}, "version"),
        ({"keys": [KEY], "ease": "yes"}, '"ease" must be true or false'),
        ({"keys": [KEY], "width": "20"}, '"width" must be a whole number'),
        ({"keys": [KEY], "height": True}, '"height" must be a whole number'),
        ({"keys": [KEY | {"time": 10**400}]}, "401 digits"),
        ({"keys": [KEY], "format": "other"}, "format"),
    ],
)
def test_files_that_hold_no_path_are_refused_with_their_name_and_the_reason(tmp_path, content, said):
    with pytest.raises(ValueError, match=r"keys\.json") as error:
        js.CameraPath.load(written(tmp_path, content))
    assert said in str(error.value)


def test_a_key_that_looks_away_from_all_there_is_is_refused(tmp_path):
    particles = js.Particles.from_arrays([[0.0, 0, 0]], 0.5, 1.0)
    key = {"time": 0, "eye": [0, 0, 9], "target": [0, 0, 10]}
    with pytest.raises(ValueError, match="looks away"):
        js.CameraPath.load(written(tmp_path, {"keys": [key]}), shown=particles)


def test_other_suffixes_and_missing_files_are_refused(tmp_path):
    path = js.CameraPath.orbit(center=(0, 0, 0), radius=1)
    with pytest.raises(ValueError, match=r"\.json"):
        path.save(tmp_path / "path.txt")
    with pytest.raises(FileNotFoundError, match="no such file"):
        js.CameraPath.load(tmp_path / "none.json")
