"""Arrays beside a Tipsy file become columns where they have a number for each particle."""

import os

import numpy as np
import pytest

from jaxsph.io.tipsy_arrays import arrays_beside

VALUES = np.arange(1, 10, dtype=np.float32) / 8


def as_bytes(values, order):
    return np.array(len(values), f"{order}i4").tobytes() + values.astype(f"{order}f4").tobytes()


def as_text(values):
    return "\n".join([str(len(values)), *map(str, values.tolist())]).encode() + b"\n"


@pytest.mark.parametrize("content", [as_bytes(VALUES, ">"), as_bytes(VALUES, "<"), as_text(VALUES)])
def test_text_and_bytes_in_either_order_are_read(tmp_path, content):
    (tmp_path / "run.00010.smoothlength").write_bytes(content)
    columns, said = arrays_beside(tmp_path / "run.00010", 9, 4, slice(4, 7))
    np.testing.assert_array_equal(columns["smoothlength"], VALUES[4:7])
    assert said == ["column `smoothlength` is of run.00010.smoothlength"]


def test_an_array_of_gas_alone_is_of_gas_alone(tmp_path):
    (tmp_path / "run.den").write_bytes(as_text(VALUES[:4]))
    np.testing.assert_array_equal(arrays_beside(tmp_path / "run", 9, 4, slice(0, 4))[0]["den"], VALUES[:4])
    columns, said = arrays_beside(tmp_path / "run", 9, 4, slice(4, 7))
    assert columns == {} and said == ["run.den is not used: it holds gas alone"]


@pytest.mark.parametrize(
    "content, told",
    [
        (as_text(VALUES[:8]), "states 8 numbers and has 8, but there are 9 particles"),
        (as_text(VALUES)[:-6], "states 9 numbers and has 8"),
        (as_bytes(VALUES, ">")[:-1], "neither text of numbers nor floats"),
        (b"", "neither text"),
        (b"nine " * 9, "neither text"),
        (b"1e400 " * 9, "neither text"),
        (b" " * 10_000, "has 10000 bytes, too many"),
    ],
)
def test_what_does_not_fit_is_said_and_not_used(tmp_path, content, told):
    (tmp_path / "run.den").write_bytes(content)
    columns, said = arrays_beside(tmp_path / "run", 9, 4, slice(0, 4))
    assert columns == {} and said[0].startswith("run.den is not used: it ") and told in said[0]


def test_only_files_are_opened(tmp_path):
    os.mkfifo(tmp_path / "run.den")  # would wait for ever
    (tmp_path / "run.smoothlength").mkdir()
    assert arrays_beside(tmp_path / "run", 9, 4, slice(0, 4)) == ({}, [])
