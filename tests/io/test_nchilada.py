"""NChilada snapshots are read as they were written, and refused where their files do not agree."""

import numpy as np
import pytest

import jaxsph as js
from jaxsph.io.nchilada import HEADER, MAGIC, TYPES


def write(file, values, time=0.5):
    values = np.asarray(values)
    code = next(code for code, name in TYPES.items() if np.dtype(name) == values.dtype)
    table = values.reshape(len(values), -1)
    header = np.array((MAGIC, time, len(table) >> 32, len(table) & 0xFFFFFFFF, table.shape[1], code), HEADER)
    file.parent.mkdir(parents=True, exist_ok=True)
    ends = [table.min(0), table.max(0)] if len(table) else [np.zeros(table.shape[1])] * 2
    big = values.dtype.newbyteorder(">")
    file.write_bytes(header.tobytes() + b"".join(np.asarray(part).astype(big).tobytes() for part in (*ends, table)))


@pytest.fixture
def snapshot(tmp_path):
    """Five gas and three dark particles."""
    rng, folder = np.random.default_rng(0), tmp_path / "run.000100"
    for kind, count in (("gas", 5), ("dark", 3)):
        write(folder / kind / "pos", rng.random((count, 3)).astype(np.float32))
        write(folder / kind / "vel", rng.random((count, 3)))
        write(folder / kind / "iOrder", np.arange(count, dtype=np.int64))
    write(folder / "gas" / "temperature", rng.random(5).astype(np.float32))
    (folder / "description.xml").write_text("<simulation/>")
    (folder / "gas" / "notes.txt").write_text("no field")
    return folder


def test_gas_is_read_with_all_its_columns_and_the_time(snapshot):
    table = js.io.read_table(snapshot)
    rng = np.random.default_rng(0)
    np.testing.assert_array_equal(table.position, rng.random((5, 3)).astype(np.float32))
    np.testing.assert_array_equal(table.columns["vel"], rng.random((5, 3)))
    assert sorted(table.columns) == ["iOrder", "temperature", "vel"] and table.columns["iOrder"].tolist() == [0, 1, 2, 3, 4]
    assert (table.source, table.time, table.part_type) == ("NChilada", 0.5, 0)


def test_other_types_are_read_when_asked_for_and_named_when_missing(snapshot):
    assert len(js.io.read_table(snapshot, part_type=1)) == 3
    with pytest.raises(ValueError, match="type 4; `part_type` can be 0, 1"):
        js.io.read_table(snapshot, part_type=4)


def test_files_that_are_cut_short_or_of_another_snapshot_are_named(snapshot):
    write(snapshot / "gas" / "temperature", np.zeros(4, np.float32))
    with pytest.raises(ValueError, match="gas/temperature has 4 values, but there are 5 positions"):
        js.io.read_table(snapshot)
    (snapshot / "gas" / "pos").write_bytes((snapshot / "gas" / "pos").read_bytes()[:-4])
    with pytest.raises(ValueError, match=r"gas/pos is cut short"):
        js.io.read_table(snapshot)


def test_other_folders_are_refused(tmp_path):
    with pytest.raises(ValueError, match="is a folder"):
        js.io.read_table(tmp_path)


def test_it_renders(snapshot):
    particles = js.io.read_particles(snapshot, support=0.5)
    assert particles.num_particles == 5
