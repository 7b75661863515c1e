"""The index has true boxes and supports, is kept, is made again where a file changed, and is written whole or not at all."""

import os

import numpy as np
import pytest
from refusals import refused
from snapshots_made import particles, write

import jaxsph as js
from jaxsph.io.disk import index as snapshot_index
from jaxsph.io.disk.index import Snapshot, index_of, index_path, needed_columns, supports_and_volumes


@pytest.fixture(autouse=True)
def short_runs(monkeypatch):
    monkeypatch.setattr(snapshot_index, "RUN", 64)


def test_every_particle_lies_in_the_box_of_its_run_and_none_is_wider(tmp_path):
    columns = particles(300)
    index = index_of(Snapshot(write(tmp_path, columns, files=1)))
    for run in index.runs:
        rows = slice(run.begin, run.end)
        position, support = columns["Coordinates"][rows].astype(float), columns["SmoothingLength"][rows]
        assert (position >= run.lower).all() and (position <= run.upper).all()
        assert support.max() == np.float32(run.support) and support.min() == np.float32(run.least)
        assert columns["SmoothingLength"][run.widest] == support.max()
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


def test_where_the_disk_is_full_it_is_used_but_not_kept(tmp_path, monkeypatch):
    snapshot = Snapshot(write(tmp_path, particles(100)))

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    before = sorted(tmp_path.iterdir())
    with pytest.warns(UserWarning, match="No space left"):
        assert len(index_of(snapshot)) == 100
    assert sorted(tmp_path.iterdir()) == before


def with_other(name, change):
    """Rows of which some numbers are others."""

    def changed(runs):
        runs[name] = change(runs[name])
        return runs

    return changed


@pytest.mark.parametrize(
    "change",
    [
        lambda runs: runs[:0],
        lambda runs: runs[["file", "begin", "end"]],
        lambda runs: runs.astype([(name, "f8", runs[name].shape[1:]) for name in runs.dtype.names]),
        lambda runs: runs["file"].astype(str),
        with_other("end", lambda column: column + 1000),
        with_other("file", lambda column: column + 7),
        with_other("lower", lambda column: np.full_like(column, np.nan)),
        with_other("lower", lambda column: column + 10),
        with_other("support", lambda column: -column),
        with_other("least", lambda column: 0 * column),
        with_other("widest", lambda column: column + 1000),
        with_other("strength", lambda column: column * np.inf),
        with_other("volume", lambda column: column[:, ::-1] - 1),
    ],
)
def test_an_index_that_cannot_be_of_these_rows_is_made_again(change, tmp_path):
    snapshot = Snapshot(write(tmp_path, particles(300)))
    made = index_of(snapshot)
    with np.load(index_path(snapshot)) as kept:
        arrays = dict(kept)
    np.savez(index_path(snapshot), identity=arrays["identity"], runs=change(arrays["runs"]))
    np.testing.assert_array_equal(index_of(snapshot).runs, made.runs)


def test_a_file_that_was_written_over_with_its_old_size_and_time_is_noticed(tmp_path):
    snapshot = Snapshot(write(tmp_path, particles(300)))
    before, stood = index_of(snapshot), [path.stat() for path in snapshot.files]
    write(tmp_path, particles(300, seed=1))
    for path, known in zip(snapshot.files, stood, strict=True):
        os.utime(path, ns=(known.st_atime_ns, known.st_mtime_ns))
        assert path.stat().st_size == known.st_size
    assert not np.array_equal(index_of(Snapshot(snapshot.files[0])).runs.lower, before.runs.lower)


def otherwise_packed(content):
    place = content.index(b"PK\x01\x02") + 10  # the method of compression of its first array
    return content[:place] + b"c" + content[place + 1 :]


@pytest.mark.parametrize("change", [lambda content: b"PK\x03\x04 cut short", otherwise_packed, None])
def test_an_index_that_is_damaged_packed_as_none_is_or_no_file_is_made_again(change, tmp_path):
    snapshot = Snapshot(write(tmp_path, particles(100)))
    index_of(snapshot)
    path = index_path(snapshot)
    if change is None:
        path.unlink()
        os.mkfifo(path)
    else:
        path.write_bytes(change(path.read_bytes()))
    assert len(index_of(snapshot)) == 100 and path.is_file()


def test_of_no_particles_there_is_an_index_that_is_kept(tmp_path):
    snapshot, read = Snapshot(write(tmp_path, particles(1), files=1)), []
    empty = write(tmp_path, {name: column[:0] for name, column in particles(1).items()}, files=1)
    snapshot = Snapshot(empty)
    assert len(index_of(snapshot)) == 0
    assert len(index_of(snapshot, progress=lambda *_: read.append(1))) == 0 and not read


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


def test_only_the_columns_of_a_quantity_are_needed_and_sums_over_neighbours_refused(tmp_path):
    columns = particles(100)
    first = Snapshot(write(tmp_path, columns)).first
    needed = set(needed_columns(first, "log10:InternalEnergy"))
    assert {"InternalEnergy", "Masses", "Density"} <= needed and "ParticleIDs" not in needed
    refused("no quantity 'dust'", needed_columns, first, "dust")
    del columns["Density"]
    first = Snapshot(write(tmp_path, columns)).first
    refused("sum over neighbours", needed_columns, first, "density")
    refused("need all neighbours", supports_and_volumes, first)


def test_a_file_that_is_missing_or_of_another_format_is_named(tmp_path):
    path = write(tmp_path, particles(100), files=3)
    (tmp_path / "snap.1.hdf5").unlink()
    refused(r"snap\.1\.hdf5", Snapshot, path)
    with pytest.raises(FileNotFoundError):
        Snapshot(tmp_path / "nothing.hdf5")
