"""Files of transfer functions: the same numbers again, readable by people, and refused with a reason."""

import json
import re

import jax
import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st
from refusals import refused

import jaxsph as js
from jaxsph import io
from jaxsph.io.json_files import read_json

SIMPLE = {
    "format": "jaxsph transfer function",
    "version": 1,
    "values": [0, 1],
    "colors": [[0, 0, 0], [1, 1, 1]],
    "extinction": [0, 2],
}


def written(path, **changes):
    path.write_text(json.dumps({name: value for name, value in (SIMPLE | changes).items() if value is not None}))
    return path


@examples(20)
@given(st.integers(0, 2**31), st.integers(1, 40), st.integers(-20, 20))
def test_a_file_gives_the_same_numbers_again(tmp_path_factory, seed, points, decade):
    rng = np.random.default_rng(seed)
    values = np.sort(rng.normal(size=points) * 10.0**decade).astype(np.float32)
    made = js.TransferFunction.from_points(values, rng.uniform(size=(points, 3)), rng.exponential(size=points) * 1e3)
    path = tmp_path_factory.mktemp("transfer") / "x.json"
    made.save(path)
    again = js.TransferFunction.load(path)
    for name in ("values", "colors", "extinction"):
        np.testing.assert_array_equal(getattr(again, name), getattr(made, name))


def test_float64_stays_float64_and_people_can_write_one_and_leave_a_note(tmp_path):
    made = js.TransferFunction.load(written(tmp_path / "x.json", note="by hand"))
    assert np.asarray(made.extinction).tolist() == [0, 2] and made.values.dtype == np.float32
    with jax.enable_x64(True):
        made = js.TransferFunction.from_points(np.array([0.1, 1 / 3]), np.full((2, 3), 1 / 7), np.array([1 / 9, 1e-300]))
        made.save(tmp_path / "x.json")
        again = js.TransferFunction.load(tmp_path / "x.json")
        assert again.values.dtype == np.float64
        np.testing.assert_array_equal(again.extinction, made.extinction)


def test_what_stood_there_stays_when_writing_fails(tmp_path, monkeypatch):
    path = written(tmp_path / "x.json")
    monkeypatch.setattr("pathlib.Path.write_text", lambda *_, **__: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises((ValueError, OSError)):
        io.write_transfer(path, js.TransferFunction.from_colormap("heat", (0, 1)))
    assert json.loads(path.read_text())["values"] == [0, 1] and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(("changes", "said"), [
    ({"version": 2}, "update jaxsph"), ({"version": 0}, "save it again"), ({"version": None}, "None"),
    ({"format": "another"}, "jaxsph transfer function"), ({"colors": None}, "lacks colors"),
    ({"colours": []}, "'colours', which is not known"), ({"dtype": "float16"}, "float32 or float64"),
    ({"values": [1, 0]}, "ascend"), ({"extinction": [0, -1]}, "never a gain"),
    ({"colors": [[0, 0], [1]]}, "rows of one length"), ({"values": ["a", "b"]}, "numbers"),
    ({"values": ["0", "1"]}, "without quotes"), ({"values": [False, True]}, "numbers"),
    ({"colors": [[0, 0, 0], [1, 1, True]]}, "numbers"), ({"values": [None, {}]}, "numbers"), ({"version": True}, "True"),
    ({"values": [0, 10**400]}, "401 digits"), ({"values": [0, 1e39]}, "finite"),
])  # fmt: skip
def test_what_is_no_transfer_function_is_refused_by_file_and_reason(tmp_path, changes, said):
    path = written(tmp_path / "x.json", **changes)
    refused(rf"{path}: .*{said}", js.TransferFunction.load, path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 100_000, "too deeply"),
        ('{"a": ' * 100_000, "too deeply"),
        ("[" + "1" * 5000 + "]", "5000 digits"),
        ("[1" + "0" * 400 + "]", "401 digits"),
        ('{"keys": 1, "keys": 2}', '"keys" stands twice'),
        ('{"format": \n oops', "is no JSON: .* line 2"),
    ],
    ids=lambda text: text[:12],
)
def test_what_is_refused_names_the_file_in_one_line(tmp_path, text, said):
    path = tmp_path / "look.json"
    path.write_text(text)
    refused(rf"{path}: .{{,200}}{said}", read_json, path)


KEY = {"time": 0, "eye": [0, 0, 9], "target": [0, 0, 0], "near": 1, "far": 20}
LATER = KEY | {"time": 4, "eye": [9, 0, 0]}


def path_written(tmp_path, content):
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
    path = js.CameraPath.load(path_written(tmp_path, {"keys": keys, "around": [0, 0, 0]}), width=20, height=10, shown=particles)
    refused("`width` must be an integer from 1", js.CameraPath.load, tmp_path / "keys.json", width=0, shown=particles)
    for time in (0, 4):
        camera = path.at(time)
        assert (camera.width, camera.height) == (20, 10)
        assert float(camera.near) == pytest.approx(7.5, rel=1e-3) and float(camera.far) == pytest.approx(9.5, rel=1e-3)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "no JSON"), ([KEY], "must be an object"), ({}, '"keys", or "legs"'), ({"keys": []}, "at least one key"),
        ({"legs": 3}, "list of objects"), ({"keys": [KEY], "loop": True}, "'loop'"),
        ({"keys": [KEY | {"roll": 3}]}, "key 1 has 'roll', which is not known; it may have time, eye"),
        ({"keys": [{"time": 0, "eye": [0, 0, 1]}]}, "key 1 lacks `target`"),
        ({"keys": [KEY, {name: LATER[name] for name in LATER if name != "time"}]}, "key 2 lacks `time`"),
        ({"keys": [KEY | {"eye": [0, 0]}]}, "`eye` of key 1 must be three finite numbers"),
        ({"keys": [KEY | {"fov": "wide"}]}, "`fov` of key 1"), ({"keys": [KEY | {"fov": 200}]}, "fov_degrees"),
        ({"keys": [KEY | {"fov": 30, "view_height": 2}]}, "both"), ({"keys": [KEY | {"target": [0, 0, 9]}]}, "key 1: `target`"),
        ({"keys": [LATER, KEY]}, "0 follows 4"), ({"keys": [{name: KEY[name] for name in KEY if name != "far"}]}, "lacks `far`"),
        ({"keys": [KEY], "width": 0}, "width"), ({"keys": [KEY], "version": 9}, "version"),
        ({"keys": [KEY], "version": True}, "version"), ({"keys": [KEY], "ease": "yes"}, '"ease" must be true or false'),
        ({"keys": [KEY], "width": "20"}, '"width" must be a whole number'),
        ({"keys": [KEY], "height": True}, '"height" must be a whole number'), ({"keys": [KEY | {"time": 10**400}]}, "401 digits"),
        ({"keys": [KEY], "format": "other"}, "format"),
    ],
)  # fmt: skip
def test_files_that_hold_no_path_are_refused_with_their_name_and_the_reason(tmp_path, content, said):
    refused(rf"keys\.json: .*{re.escape(said)}", js.CameraPath.load, path_written(tmp_path, content))


def test_a_key_that_looks_away_from_all_there_is_is_refused(tmp_path):
    particles = js.Particles.from_arrays([[0.0, 0, 0]], 0.5, 1.0)
    key = {"time": 0, "eye": [0, 0, 9], "target": [0, 0, 10]}
    refused("looks away", js.CameraPath.load, path_written(tmp_path, {"keys": [key]}), shown=particles)


def test_other_suffixes_and_missing_files_are_refused(tmp_path):
    for made in (js.TransferFunction.from_colormap("heat", (0, 1)), js.CameraPath.orbit(center=(0, 0, 0), radius=1)):
        refused(r"\.json", made.save, tmp_path / "x.txt")
        with pytest.raises(FileNotFoundError, match="no such file"):
            type(made).load(tmp_path / "none.json")
