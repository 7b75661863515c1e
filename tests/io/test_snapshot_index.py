"""The index has true boxes and supports, is kept, is made again where a file changed, and is written whole or not at all."""

import os

import numpy as np
import pytest
from snapshots_made import particles, write

from jaxsph.io import snapshot_index, snapshot_rows
from jaxsph.io.snapshot_index import index_of, index_path
from jaxsph.io.snapshot_rows import Snapshot


@pytest.fixture(autouse=True)
def short_runs(monkeypatch):
    for module in (snapshot_index, snapshot_rows):
        monkeypatch.setattr(module, "RUN", 64)


def test_every_particle_lies_in_the_box_of_its_run_and_none_is_wider(tmp_path):
    columns = particles(300)
    index = index_of(Snapshot(write(tmp_path, columns, files=1)))
    for run in range(len(index.file)):
        rows = slice(index.begin[run], index.end[run])
        position, support = columns["Coordinates"][rows].astype(float), columns["SmoothingLength"][rows]
        assert (position >= index.lower[run]).all() and (position <= index.upper[run]).all()
        assert support.max() == np.float32(index.support[run]) and support.min() == np.float32(index.least[run])
        assert columns["SmoothingLength"][index.widest[run]] == support.max()
    lower, upper = index.bounds()
    assert (lower <= 0).all() and (upper >= 1).all() and len(index) == 300


def test_it_is_read_once_and_again_where_a_file_has_changed(tmp_path):
    snapshot, read = Snapshot(write(tmp_path, particles(300))), []
    index_of(snapshot, progress=lambda done, total: read.append(done))
    assert read == list(range(1, len(read) + 1)) and index_path(snapshot).exists()
    read.clear()
    index_of(Snapshot(snapshot.files[0]), progress=lambda done, total: read.append(done))
    assert read == []
    os.utime(snapshot.files[1], ns=(1, 1))
    index_of(Snapshot(snapshot.files[0]), progress=lambda done, total: read.append(done))
    assert read


def test_a_damaged_index_is_made_again(tmp_path):
    snapshot = Snapshot(write(tmp_path, particles(100)))
    index_of(snapshot)
    index_path(snapshot).write_bytes(b"PK\x03\x04 cut short")
    assert len(index_of(snapshot)) == 100


def test_where_the_disk_is_full_it_is_used_but_not_kept(tmp_path, monkeypatch):
    snapshot = Snapshot(write(tmp_path, particles(100)))

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    before = sorted(tmp_path.iterdir())
    with pytest.warns(UserWarning, match="No space left"):
        assert len(index_of(snapshot)) == 100
    assert sorted(tmp_path.iterdir()) == before
