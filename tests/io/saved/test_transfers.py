"""Files of transfer functions: the same numbers again, readable by people, and refused with a reason."""

import json

import jax
import numpy as np
import pytest
from examples import examples
from hypothesis import given
from hypothesis import strategies as st

import jaxsph as js
from jaxsph import io

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


def test_float64_stays_float64(tmp_path):
    with jax.enable_x64(True):
        made = js.TransferFunction.from_points(np.array([0.1, 1 / 3]), np.full((2, 3), 1 / 7), np.array([1 / 9, 1e-300]))
        made.save(tmp_path / "x.json")
        again = js.TransferFunction.load(tmp_path / "x.json")
        assert again.values.dtype == np.float64
        np.testing.assert_array_equal(again.extinction, made.extinction)


def test_people_can_write_one_and_leave_a_note(tmp_path):
    made = js.TransferFunction.load(written(tmp_path / "x.json", note="by hand"))
    assert np.asarray(made.extinction).tolist() == [0, 2] and made.values.dtype == np.float32


def test_what_stood_there_stays_when_writing_fails(tmp_path, monkeypatch):
    path = written(tmp_path / "x.json")
    monkeypatch.setattr("pathlib.Path.write_text", lambda *_, **__: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises((ValueError, OSError)):
        io.write_transfer(path, js.TransferFunction.from_colormap("heat", (0, 1)))
    assert json.loads(path.read_text())["values"] == [0, 1] and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"version": 2}, "update jaxsph"),
        ({"version": 0}, "save it again"),
        ({"version": None}, "None"),
        ({"format": "another"}, "jaxsph transfer function"),
        ({"colors": None}, "lacks colors"),
        ({"colours": []}, "colours, unknown"),
        ({"dtype": "float16"}, "float32 or float64"),
        ({"values": [1, 0]}, "ascend"),
        ({"extinction": [0, -1]}, "never a gain"),
        ({"colors": [[0, 0], [1]]}, "rows of one length"),
        ({"values": ["a", "b"]}, "numbers"),
        ({"values": ["0", "1"]}, "without quotes"),
        ({"values": [False, True]}, "numbers"),
        ({"colors": [[0, 0, 0], [1, 1, True]]}, "numbers"),
        ({"version": True}, "True"),
        ({"values": [0, 10**400]}, "401 digits"),
        ({"values": [0, 1e39]}, "finite"),
    ],
)
def test_what_is_no_transfer_function_is_refused_by_file_and_reason(tmp_path, changes, said):
    path = written(tmp_path / "x.json", **changes)
    with pytest.raises(ValueError, match=said) as refused:
        js.TransferFunction.load(path)
    assert str(path) in str(refused.value)


def test_json_that_is_broken_says_where(tmp_path):
    (tmp_path / "x.json").write_text('{"format": \n oops')
    with pytest.raises(ValueError, match="line 2"):
        js.TransferFunction.load(tmp_path / "x.json")
    (tmp_path / "y.json").write_text("[1, 2]")
    with pytest.raises(ValueError, match="no transfer function"):
        js.TransferFunction.load(tmp_path / "y.json")


def test_other_suffixes_and_missing_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"\.json"):
        js.TransferFunction.from_colormap("heat", (0, 1)).save(tmp_path / "x.txt")
    with pytest.raises(FileNotFoundError, match="no such file"):
        js.TransferFunction.load(tmp_path / "none.json")
