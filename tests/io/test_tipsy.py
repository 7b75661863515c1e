"""Tipsy files are read in either byte order, and refused when their numbers do not add up."""

import numpy as np
import pytest

import jaxsph as js
from jaxsph.io.tipsy import HEADER, RECORDS

COUNTS = {0: 4, 1: 3, 4: 2}


def records():
    rng = np.random.default_rng(0)
    return {kind: rng.random((COUNTS[kind], len(fields))).astype(np.float32) for kind, (_, fields) in RECORDS.items()}


def write(path, order=">", padded=True):
    header = np.array((0.25, 9, 3, 4, 3, 2), HEADER.newbyteorder(order))
    found = records()
    parts = [header.tobytes(), b"\0" * 4 * padded] + [found[kind].astype(f"{order}f4").tobytes() for kind in RECORDS]
    path.write_bytes(b"".join(parts))
    return path


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("padded", [True, False])
@pytest.mark.parametrize("kind", [0, 1, 4])
def test_each_type_is_read_as_it_was_written(tmp_path, order, padded, kind):
    table = js.io.read_table(write(tmp_path / "run.00010", order, padded), part_type=kind)
    wanted = records()[kind]
    np.testing.assert_array_equal(table.position, wanted[:, 1:4])
    np.testing.assert_array_equal(table.columns["mass"], wanted[:, 0])
    np.testing.assert_array_equal(table.columns["velocity"], wanted[:, 4:7])
    assert (table.source, table.time, table.part_type) == ("Tipsy", 0.25, kind)


def test_gas_is_what_is_shown_without_a_type(tmp_path):
    assert len(js.io.read_table(write(tmp_path / "run.00010"))) == 4


def test_a_file_cut_short_says_so(tmp_path):
    path = write(tmp_path / "run.tipsy")
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(ValueError, match="cut short"):
        js.io.read_table(path)


def test_a_type_that_is_not_there_names_those_that_are(tmp_path):
    with pytest.raises(ValueError, match="type 2; `part_type` can be 0, 1, 4"):
        js.io.read_table(write(tmp_path / "run.tipsy"), part_type=2)


def test_the_padding_of_the_standard_is_zero(tmp_path):
    """Else four bytes too many anywhere would be taken for it."""
    path = write(tmp_path / "run.00010", padded=False)
    content = path.read_bytes()
    path.write_bytes(content[:200] + b"\1\2\3\4" + content[200:])
    with pytest.raises(ValueError, match=r"run\.00010: has \d more bytes than its header and its records"):
        js.io.read_table(path)
