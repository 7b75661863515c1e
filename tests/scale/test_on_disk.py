"""A snapshot that stays on disk: what is read of it, and how it is shown by default."""

import h5py
import numpy as np
import pytest
from snapshots_made import particles, write

import jaxsph as js
from jaxsph.io.disk import index as snapshot_index
from jaxsph.scale.on_disk import seen_by

QUANTITY = "InternalEnergy"


@pytest.fixture(autouse=True)
def short_runs(monkeypatch):
    monkeypatch.setattr(snapshot_index, "RUN", 256)


def test_only_runs_that_the_rows_can_see_are_read(tmp_path, monkeypatch):
    on_disk = js.scale.OnDisk.open(write(tmp_path, particles(6000)), QUANTITY)
    camera, read = js.Camera.framing(on_disk, width=40, height=72), []
    real = snapshot_index.Snapshot.read

    def reading(self, file, rows, only=None):
        read.append(rows)
        return real(self, file, rows, only)

    monkeypatch.setattr(snapshot_index.Snapshot, "read", reading)
    on_disk.seen_by(seen_by(camera, 0, 8, 0, 40))
    assert 0 < len(read) < 0.7 * len(on_disk.index.runs)


def test_log_density_gives_opacity_where_densities_spread(tmp_path):
    columns = particles(1000)
    columns["Density"] = np.geomspace(1e-3, 10, 1000).astype(np.float32)
    on_disk = js.scale.OnDisk.open(write(tmp_path, columns), QUANTITY, opacity_by="auto")
    assert on_disk.quantities == (QUANTITY, "log10:Density") and on_disk.sample.extinction_quantity is not None
    assert np.asarray(on_disk.transfer().extinction)[0] == 0


@pytest.mark.parametrize("side", [1.0, 0.5], ids=["all inside", "some outside"])
def test_a_periodic_snapshot_is_framed_as_in_memory(tmp_path, side):
    path = write(tmp_path, particles(400))
    for name in ("snap.0.hdf5", "snap.1.hdf5"):
        with h5py.File(tmp_path / name, "r+") as file:
            file["Header"].attrs["BoxSize"] = side
    on_disk, in_memory = js.scale.OnDisk.open(path, QUANTITY), js.io.read_particles(path, QUANTITY)
    assert (in_memory.box is None) == (side < 1)
    np.testing.assert_allclose(on_disk.bounds(), in_memory.bounds(), rtol=1e-6)
