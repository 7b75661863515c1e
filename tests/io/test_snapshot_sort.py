"""A sorted snapshot has the same particles, near ones in near rows, and says where its cells are."""

import h5py
import numpy as np
import pytest
from snapshots_made import particles, write

import jaxsph as js
from jaxsph.io import snapshot_rows
from jaxsph.io.snapshot_index import index_of
from jaxsph.io.snapshot_rows import Snapshot


def test_all_columns_of_all_particles_are_there_once_and_near_ones_are_neighbours(tmp_path, monkeypatch):
    monkeypatch.setattr(snapshot_rows, "RUN", 64)
    path = write(tmp_path, particles(700, ordered=False), files=3)
    js.io.sort_snapshot(path, tmp_path / "sorted.hdf5")
    before, after = (js.io.read_table(file) for file in (path, tmp_path / "sorted.hdf5"))
    order = np.argsort(after.columns["ParticleIDs"])
    np.testing.assert_array_equal(after.position[order], before.position)
    np.testing.assert_array_equal(after.support[order], before.support)
    np.testing.assert_array_equal(after.columns["InternalEnergy"][order], before.columns["InternalEnergy"])
    assert after.time == before.time and after.num_files == 1
    indices = [index_of(Snapshot(file)) for file in (path, tmp_path / "sorted.hdf5")]
    volumes = [np.prod(index.upper - index.lower, 1).mean() for index in indices]
    assert volumes[1] < 0.3 * volumes[0]
    with h5py.File(tmp_path / "sorted.hdf5") as file:
        assert file["Cells/Counts/PartType0"][()].sum() == 700


def test_the_snapshot_itself_and_other_suffixes_are_refused(tmp_path):
    path = write(tmp_path, particles(50), files=1)
    with pytest.raises(ValueError, match="is the snapshot itself"):
        js.io.sort_snapshot(path, path)
    with pytest.raises(ValueError, match=r"as \.hdf5 or \.h5"):
        js.io.sort_snapshot(path, tmp_path / "out.npz")
