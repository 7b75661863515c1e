"""Links of HDF5 files lead where they may, or are refused by name: none makes a column vanish, hangs or opens other folders."""

import os
import subprocess
import sys

import numpy as np
import pytest
from snapshots_made import particles, write

import jaxsph.io as io
from jaxsph.io.disk.rows import Snapshot

h5py = pytest.importorskip("h5py")
SECONDS = 120
"""A guard against what never ends; most of it is for starting Python."""


def snapshot(folder):
    """One file of the snapshot has its densities in another file."""
    path = write(folder, particles(30), files=1)
    with h5py.File(path, "a") as file, h5py.File(folder / "other.hdf5", "w") as other:
        file.copy("PartType0/Density", other, "Density")
    return path


def link(path, target, name="PartType0/Density"):
    with h5py.File(path, "a") as file:
        if name in file:
            del file[name]
        file[name] = target


def test_a_link_to_a_file_beside_is_followed(tmp_path):
    path = snapshot(tmp_path)
    before = io.read_table(path).columns["Density"]  # an absolute name that is gone is looked for here, as HDF5 does
    for target in ("other.hdf5", str(tmp_path / "other.hdf5"), "/gone/from/here/other.hdf5"):
        link(path, h5py.ExternalLink(target, "/Density"))
        np.testing.assert_array_equal(io.read_table(path).columns["Density"], before)
    link(path, h5py.SoftLink("/PartType0/Masses"))
    assert "Density" in io.read_table(path).columns


@pytest.mark.parametrize("read", [io.read_table, Snapshot])
@pytest.mark.parametrize(
    ("target", "said"),
    [
        (h5py.SoftLink("/nowhere"), "a link to `/nowhere`,"),
        (h5py.SoftLink("/PartType0/Density"), "a link to `/PartType0/Density`,"),
        (h5py.ExternalLink("gone.hdf5", "/Density"), "a link to `/Density` in `gone.hdf5`,"),
        (h5py.ExternalLink("other.hdf5", "/gone"), "a link to `/gone` in `other.hdf5`,"),
        (h5py.ExternalLink("snap.hdf5", "/PartType0/Density"), "a link to `/PartType0/Density` in `snap.hdf5`,"),
    ],
)
def test_a_link_that_leads_nowhere_is_refused_by_name(target, said, read, tmp_path):
    path = snapshot(tmp_path)
    link(path, target)
    with pytest.raises(ValueError, match=r"snap\.hdf5: `/PartType0/Density` is .*cannot be followed; put back") as caught:
        read(path)
    assert said in str(caught.value)


@pytest.mark.parametrize("name", ["PartType0", "PartType0/Coordinates", "Header"])
def test_other_particles_are_not_taken_where_a_link_to_the_first_leads_nowhere(name, tmp_path):
    path = snapshot(tmp_path)
    with h5py.File(path, "a") as file:
        file.copy("PartType0", "PartType1")
    link(path, h5py.ExternalLink("gone.hdf5", "/x"), name)
    with pytest.raises(ValueError, match=rf"`/{name}` is a link to `/x` in `gone\.hdf5`, which cannot be followed"):
        io.read_table(path)


@pytest.mark.parametrize("column", ["h", "id", "extra"])
def test_links_of_phantom_and_of_plain_points_are_followed_or_refused_too(column, samples, tmp_path):
    samples.write_phantom(tmp_path / "a.h5", samples.particles())
    samples.write_points(tmp_path / "b.h5", samples.particles())
    link(tmp_path / "a.h5", h5py.SoftLink("/gone"), f"particles/{column}")
    link(tmp_path / "b.h5", h5py.SoftLink("/gone"), column)
    for path in (tmp_path / "a.h5", tmp_path / "b.h5"):
        with pytest.raises(ValueError, match=rf"{path.name}: .*{column}` is a link to `/gone`, which cannot be followed"):
            io.read_table(path)


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("name", ["PartType0/Density", "Header"])
def test_a_link_out_of_the_folder_is_not_opened(name, absolute, tmp_path):
    (tmp_path / "inner").mkdir()
    path = snapshot(tmp_path / "inner")
    other = tmp_path / "secret.hdf5"
    os.rename(tmp_path / "inner" / "other.hdf5", other)
    link(path, h5py.ExternalLink(str(other) if absolute else "../secret.hdf5", "/Density"), name)
    with pytest.raises(ValueError, match=r"secret\.hdf5`, which lies outside of the folder of this file"):
        io.read_table(path)


def test_a_group_that_holds_itself_is_walked_once(tmp_path):
    path = snapshot(tmp_path)
    with h5py.File(path, "a") as file:
        file["PartType0/self"] = file["PartType0"]
        file["PartType0/top"] = file["/"]
    assert len(io.read_table(path)) == 30


HOSTILE = """
import sys
from pathlib import Path
from jaxsph.io.readers import hdf5
from jaxsph.io.disk.rows import Snapshot
for read in (hdf5.read, Snapshot):
    for path in map(Path, sys.argv[1:]):
        try:
            read(path)
            print("read", path, flush=True)
        except ValueError as error:
            print("refused", error, flush=True)
"""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes are POSIX's")
def test_pipes_and_views_of_themselves_neither_hang_nor_crash(tmp_path):
    os.mkfifo(tmp_path / "pipe.hdf5")
    names = ["link", "far", "soft", "view", "unlimited", "self", "mutual", "raw"]
    paths = {name: write_to(tmp_path / name) for name in names}
    for name in names:
        os.mkfifo(tmp_path / name / "pipe")
    link(paths["link"], h5py.ExternalLink("pipe", "/x"))
    with h5py.File(tmp_path / "far" / "other.hdf5", "w") as other:
        other["a/b/c"] = h5py.ExternalLink("pipe", "/x")
    link(paths["far"], h5py.ExternalLink("other.hdf5", "/a/b/c"))
    link(paths["soft"], h5py.ExternalLink("pipe", "/x"), "a/b/c")
    link(paths["soft"], h5py.SoftLink("/a/b/c"))
    view(paths["view"], "pipe", "x")
    view(paths["unlimited"], "pipe", "x", grows=True)
    view(paths["self"], ".", "PartType0/Density")
    view(paths["mutual"], ".", "PartType0/Masses")
    view(paths["mutual"], ".", "PartType0/Density", name="Masses")
    with h5py.File(paths["raw"], "a") as file:
        del file["PartType0/Density"]
        file["PartType0"].create_dataset("Density", (30,), "f4", external=[(str(tmp_path / "raw" / "pipe"), 0, 120)])
    given = [tmp_path / "pipe.hdf5", *paths.values()]
    done = subprocess.run([sys.executable, "-c", HOSTILE, *map(str, given)], capture_output=True, text=True, timeout=SECONDS)
    lines = done.stdout.splitlines()
    assert done.returncode == 0, (lines, done.stderr)
    assert len(lines) == 2 * len(given) and all(line.startswith("refused") for line in lines), lines
    assert all(str(path) in line for path, line in zip([*given, *given], lines, strict=True))


def write_to(folder):
    folder.mkdir()
    return write(folder, particles(30), files=1)


def view(path, source, what, grows=False, name="Density"):
    """A data set that shows another one, and what is added to that."""
    most, all_of_it = ((None,), slice(0, h5py.h5s.UNLIMITED)) if grows else ((30,), slice(0, 30))
    with h5py.File(path, "a") as file:
        del file[f"PartType0/{name}"]
        layout = h5py.VirtualLayout((30,), "f4", maxshape=most)
        layout[all_of_it] = h5py.VirtualSource(source, what, (30,), maxshape=most)[all_of_it]
        file["PartType0"].create_virtual_dataset(name, layout)
