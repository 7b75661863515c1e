"""A sorted snapshot has the same particles, near ones in near rows, and says where its cells are."""

import subprocess
import sys
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
from exec_after import exec_after
from snapshots_made import particles, write

import jaxsph as js
from jaxsph.io.disk import rows as snapshot_rows
from jaxsph.io.disk import sort as snapshot_sort
from jaxsph.io.disk.index import index_of
from jaxsph.io.disk.rows import Snapshot


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


def limited(arguments, num_bytes):
    """What a command ends with when it may write files of so many bytes."""
    limit = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({num_bytes}, {num_bytes}))"
    command = exec_after(limit, *arguments, "--no-cache")
    return subprocess.run(command, capture_output=True, text=True, timeout=300)


@pytest.mark.skipif(sys.platform == "win32", reason="limits of processes are POSIX's")
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_where_there_is_no_room_the_output_is_named_and_nothing_is_left(share, tmp_path):
    path, output = write(tmp_path, particles(700), files=1), tmp_path / "sorted.hdf5"
    done = limited(["sort", path, "-o", output], int(share * path.stat().st_size))
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == f"jaxsph sort: cannot write {output}: File too large; choose another place\n"
    assert list(tmp_path.iterdir()) == [path]


def test_a_disk_that_is_too_small_is_known_before_anything_is_written(tmp_path, monkeypatch):
    path = write(tmp_path, particles(700), files=1)
    monkeypatch.setattr(snapshot_sort.shutil, "disk_usage", lambda folder: SimpleNamespace(free=1000))
    with pytest.raises(
        ValueError, match=r"cannot write .*sorted\.hdf5: about 1\.\d MB are needed, and its disk has room for 0\.0 MB"
    ):
        js.io.sort_snapshot(path, tmp_path / "sorted.hdf5")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("known", [True, False])
def test_what_was_reserved_beyond_need_is_given_back(known, tmp_path, monkeypatch):
    if not known:
        monkeypatch.delattr(snapshot_sort.os, "posix_fallocate", raising=False)
    path, output = write(tmp_path, particles(700), files=1), tmp_path / "sorted.hdf5"
    js.io.sort_snapshot(path, output)
    assert output.stat().st_size < path.stat().st_size + 8 * snapshot_sort.CELLS**3 * 3


def test_a_file_that_is_there_is_replaced_only_if_it_was_sorted_from_the_same(tmp_path):
    path, output = write(tmp_path, particles(50), files=1), tmp_path / "sorted.hdf5"
    js.io.sort_snapshot(path, output)
    js.io.sort_snapshot(path, output)
    other = path.rename(tmp_path / "other.hdf5")
    for source, target in ((other, output), (output, other)):
        before = target.read_bytes()
        with pytest.raises(ValueError, match=rf"{target.name}: is there, and was not sorted from {source.name}; remove it"):
            js.io.sort_snapshot(source, target)
        assert target.read_bytes() == before


def test_what_was_never_written_is_not_sorted_as_zeros(tmp_path):
    path = write(tmp_path, particles(60), files=2)
    with h5py.File(tmp_path / "snap.1.hdf5", "a") as file:
        del file["PartType0/Density"]
        file["PartType0"].create_dataset("Density", (30,), "f4")
    with pytest.raises(ValueError, match=r"snap\.1\.hdf5: `/PartType0/Density` has shape .* were ever written"):
        js.io.sort_snapshot(path, tmp_path / "sorted.hdf5")


@pytest.mark.parametrize("link", [h5py.SoftLink("/gone"), None])
def test_a_column_that_some_files_lack_is_named(link, tmp_path):
    path = write(tmp_path, particles(60), files=2)
    with h5py.File(tmp_path / "snap.1.hdf5", "a") as file:
        del file["PartType0/Density"]
        if link is not None:
            file["PartType0/Density"] = link
    with pytest.raises(ValueError, match=r"snap\.1\.hdf5: .*PartType0/Density"):
        js.io.sort_snapshot(path, tmp_path / "sorted.hdf5")
    assert not (tmp_path / "sorted.hdf5").exists()


def test_other_names_of_particles_stay_names(tmp_path):
    path = write(tmp_path, particles(60), files=1)
    with h5py.File(path, "a") as file:
        file["GasParticles"] = h5py.SoftLink("/PartType0")
    js.io.sort_snapshot(path, tmp_path / "sorted.hdf5")
    with h5py.File(tmp_path / "sorted.hdf5") as file:
        assert file["GasParticles"] == file["PartType0"] and file["GasParticles/Density"].shape == (60,)
