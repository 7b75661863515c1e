"""Some rows of a snapshot are those of the whole; runs cover all rows once, and do not cut cells."""

import numpy as np
import pytest
from snapshots_made import particles, write

import jaxsph as js
from jaxsph.io.disk import rows as snapshot_rows
from jaxsph.io.disk.rows import Snapshot, needed_columns, supports_and_volumes


@pytest.fixture(autouse=True)
def short_runs(monkeypatch):
    monkeypatch.setattr(snapshot_rows, "RUN", 64)


def test_runs_cover_all_rows_of_all_files_once(tmp_path):
    snapshot = Snapshot(write(tmp_path, particles(500), files=3))
    rows = [(file, row) for file, begin, end in snapshot.runs() for row in range(begin, end)]
    assert len(rows) == len(set(rows)) == len(snapshot) == 500
    assert max(end - begin for _, begin, end in snapshot.runs()) <= 128


def test_rows_are_those_that_the_whole_has(tmp_path):
    path = write(tmp_path, particles(200), files=2)
    whole, some = js.io.read_table(path), Snapshot(path).read(1, slice(10, 30), ["InternalEnergy", "Density"])
    np.testing.assert_array_equal(some.position, whole.position[110:130])
    np.testing.assert_array_equal(some.columns["Density"], whole.columns["Density"][110:130])
    assert sorted(some.columns) == ["Density", "InternalEnergy"] and some.support is None


def test_short_cells_are_not_cut_and_long_ones_are(tmp_path):
    counts = np.array([40, 0, 50, 30, 300, 80])
    snapshot = Snapshot(write(tmp_path, particles(500), files=1, cells=counts))
    ends = [end for _, _, end in snapshot.runs()]
    last = np.cumsum(counts)
    short = [(end - count, end) for count, end in zip(counts, last, strict=True) if count <= 64]
    assert not [edge for edge in ends for begin, end in short if begin < edge < end]
    assert ends[-1] == 500 and sum(120 < end < 420 for end in ends) >= 2


def test_only_the_columns_of_a_quantity_are_needed(tmp_path):
    first = Snapshot(write(tmp_path, particles(100))).first
    needed = set(needed_columns(first, "log10:InternalEnergy"))
    assert {"InternalEnergy", "Masses", "Density"} <= needed and "ParticleIDs" not in needed
    with pytest.raises(ValueError, match="no quantity 'dust'"):
        needed_columns(first, "dust")


def test_sums_over_neighbours_are_refused(tmp_path):
    columns = particles(100)
    del columns["Density"]
    snapshot = Snapshot(write(tmp_path, columns))
    with pytest.raises(ValueError, match="sum over neighbours"):
        needed_columns(snapshot.first, "density")
    with pytest.raises(ValueError, match="need all neighbours"):
        supports_and_volumes(snapshot.first)


def test_a_file_that_is_missing_or_of_another_format_is_named(tmp_path):
    path = write(tmp_path, particles(100), files=3)
    (tmp_path / "snap.1.hdf5").unlink()
    with pytest.raises(ValueError, match=r"snap\.1\.hdf5"):
        Snapshot(path)
    with pytest.raises(FileNotFoundError):
        Snapshot(tmp_path / "nothing.hdf5")
