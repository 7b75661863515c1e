"""Links of HDF5 files lead where they may, or are refused by name: none makes a column vanish, hangs or opens other folders."""

import os
import subprocess
import sys
import zlib

import numpy as np
import pytest
from refusals import refused
from snapshots_made import particles, write

import jaxsph.io as io

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
def test_a_link_that_leads_nowhere_is_refused_by_name(target, said, tmp_path):
    path = snapshot(tmp_path)
    link(path, target)
    with pytest.raises(ValueError, match=r"snap\.hdf5: `/PartType0/Density` is .*cannot be followed; put back") as caught:
        io.read_table(path)
    assert said in str(caught.value)


@pytest.mark.parametrize("name", ["PartType0", "PartType0/Coordinates", "Header"])
def test_other_particles_are_not_taken_where_a_link_to_the_first_leads_nowhere(name, tmp_path):
    path = snapshot(tmp_path)
    with h5py.File(path, "a") as file:
        file.copy("PartType0", "PartType1")
    link(path, h5py.ExternalLink("gone.hdf5", "/x"), name)
    refused(rf"`/{name}` is a link to `/x` in `gone\.hdf5`, which cannot be followed", io.read_table, path)


@pytest.mark.parametrize("column", ["h", "id", "extra", "density"])
def test_links_of_what_is_needed_are_refused_others_are_said(column, samples, tmp_path):
    samples.write_phantom(tmp_path / "a.h5", samples.particles())
    samples.write_points(tmp_path / "b.h5", samples.particles())
    link(tmp_path / "a.h5", h5py.SoftLink("/gone"), f"particles/{column}")
    link(tmp_path / "b.h5", h5py.SoftLink("/gone"), column)
    for path, needed in ((tmp_path / "a.h5", "h"), (tmp_path / "b.h5", "density")):
        wrong = f"{column}` is a link to `/gone`, which cannot be followed"
        if column == needed:
            refused(rf"{path.name}: .*{wrong}", io.read_table, path)
        else:
            assert wrong in " ".join(said for said in io.read_table(path).conventions if said.startswith(f"left out {column}: "))


@pytest.mark.parametrize("absolute", [False, True])
@pytest.mark.parametrize("name", ["PartType0/Density", "Header"])
def test_a_link_out_of_the_folder_is_not_opened(name, absolute, tmp_path):
    (tmp_path / "inner").mkdir()
    path = snapshot(tmp_path / "inner")
    other = tmp_path / "secret.hdf5"
    os.rename(tmp_path / "inner" / "other.hdf5", other)
    link(path, h5py.ExternalLink(str(other) if absolute else "../secret.hdf5", "/Density"), name)
    refused(r"secret\.hdf5`, which lies outside of the folder of this file", io.read_table, path)


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
for path in map(Path, sys.argv[1:]):
    try:
        hdf5.read(path)
        print("read", path, flush=True)
    except ValueError as error:
        print("refused", error, flush=True)
"""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes are POSIX's")
def test_pipes_and_views_of_themselves_neither_hang_nor_crash(tmp_path):
    os.mkfifo(tmp_path / "pipe.hdf5")
    names = ["link", "far", "soft", "view", "unlimited", "self", "mutual", "halo", "raw"]
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
    view(paths["halo"], ".", "PartType1/Masses")
    view(paths["halo"], ".", "PartType1/Density", name="Masses")
    with h5py.File(paths["halo"], "a") as file:
        file.move("PartType0", "PartType1")  # no gas: masses tell which type shines
    with h5py.File(paths["raw"], "a") as file:
        del file["PartType0/Density"]
        file["PartType0"].create_dataset("Density", (30,), "f4", external=[(str(tmp_path / "raw" / "pipe"), 0, 120)])
    given = [tmp_path / "pipe.hdf5", *paths.values()]
    done = subprocess.run([sys.executable, "-c", HOSTILE, *map(str, given)], capture_output=True, text=True, timeout=SECONDS)
    lines = done.stdout.splitlines()
    assert done.returncode == 0, (lines, done.stderr)
    assert len(lines) == len(given) and all(line.startswith("refused") for line in lines), lines
    assert all(str(path) in line for path, line in zip(given, lines, strict=True))


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


POSITION = np.random.default_rng(0).random((10, 3))


def write_source(path, values=POSITION, **more):
    with h5py.File(path, "w") as file:
        file.create_dataset("x", data=values, **more)


def write_view(folder, pieces, shape=(10, 3), name="a.h5"):
    """Positions that are a view by pieces: what of the view, which file, which data set, its shape, what of it."""
    layout = h5py.VirtualLayout(shape, "f8")
    for shown, file, dataset, size, taken in pieces:
        layout[shown] = h5py.VirtualSource(file, dataset, size)[taken]
    with h5py.File(folder / name, "w") as file:
        file.create_virtual_dataset("Coordinates", layout, fillvalue=0)
    return folder / name


def whole_view(dataset="x", size=(10, 3), file="source.h5"):
    return [(np.s_[:, :], file, dataset, size, np.s_[:, :])]


HALF, REST = np.s_[0:5, :], np.s_[5:10, :]


@pytest.mark.parametrize(
    "pieces",
    [
        whole_view(),
        [(HALF, "source.h5", "x", (10, 3), HALF), (REST, "source.h5", "x", (10, 3), REST)],
        [(np.s_[:, axis], "source.h5", "x", (10, 3), np.s_[:, axis]) for axis in range(3)],
        [(np.s_[0:7, :], "source.h5", "x", (10, 3), np.s_[0:7, :]), (REST, "source.h5", "x", (10, 3), REST)],
    ],
    ids=["whole", "rows", "columns", "with rows twice"],
)
def test_a_view_that_shows_all_is_read(pieces, tmp_path):
    write_source(tmp_path / "source.h5")
    np.testing.assert_array_equal(io.read_table(write_view(tmp_path, pieces)).position, POSITION)


def test_a_view_of_the_same_file_is_read(tmp_path):
    path = write_view(tmp_path, whole_view(file="."))
    with h5py.File(path, "a") as file:
        file["x"] = POSITION
    np.testing.assert_array_equal(io.read_table(path).position, POSITION)


@pytest.mark.parametrize(
    ("pieces", "said"),
    [
        (whole_view("gone"), r"is a view of `gone` in `source\.h5`, which is not there"),
        (whole_view(file="gone.h5"), r"is a view of `gone\.h5`, which is not there: its part would be read as 0"),
        (whole_view("unwritten"), r"is a view of `unwritten` in `source\.h5`: there `/unwritten` has shape"),
        (whole_view("group"), "which is no data set"),
        (whole_view("short"), r"`short` in `source\.h5`, which has the shape \(6, 3\) there"),
        ([(np.s_[:, :], "source.h5", "short", (20, 3), np.s_[4:14, :])], r"which has the shape \(6, 3\) there"),
        (whole_view("flat"), r"which has the shape \(30,\) there|cannot be read"),
        ([(HALF, "source.h5", "x", (10, 3), HALF)] * 2, "is a view of 15 numbers only"),
        ([(HALF, "source.h5", "x", (10, 3), HALF)], "is a view of 15 numbers only"),
        ([(np.s_[::2, :], "source.h5", "x", (10, 3), HALF), (np.s_[1::2, :], "source.h5", "x", (10, 3), REST)], "no blocks"),
        (whole_view("view"), "which is a view itself"),
        (whole_view(file="../source.h5"), "lies outside of the folder"),
        (whole_view(file="folder"), "is no regular file"),
    ],
)
def test_a_view_with_anything_missing_is_refused_by_name(pieces, said, tmp_path):
    (tmp_path / "inner" / "folder").mkdir(parents=True)
    write_source(tmp_path / "source.h5")
    write_source(tmp_path / "inner" / "source.h5")
    with h5py.File(tmp_path / "inner" / "source.h5", "a") as file:
        file["short"], file["flat"], file["group/y"] = POSITION[:6], POSITION.ravel(), 1.0
        file.create_dataset("unwritten", (10, 3), "f8")
        layout = h5py.VirtualLayout((10, 3), "f8")
        layout[:] = h5py.VirtualSource(".", "x", (10, 3))
        file.create_virtual_dataset("view", layout)
    path = write_view(tmp_path / "inner", pieces)
    refused(rf"a\.h5: .*({said})", io.read_table, path)


def endless(folder, source=None, dataset="x"):
    """A view of what grows, or of a pattern of names."""
    layout, every = h5py.VirtualLayout((10, 3), "f8", maxshape=(None, 3)), np.s_[0 : h5py.h5s.UNLIMITED, :]
    if source is None:
        layout[every] = h5py.VirtualSource("source.h5", "x", (10, 3), maxshape=(None, 3))[every]
    else:
        shown, own = h5py.h5s.create_simple((10, 3), (h5py.h5s.UNLIMITED, 3)), h5py.h5s.create_simple((5, 3), (5, 3))
        shown.select_hyperslab((0, 0), (h5py.h5s.UNLIMITED, 1), (5, 1), (5, 3))
        layout.dcpl.set_virtual(shown, source.encode(), dataset.encode(), own)
    with h5py.File(folder / "a.h5", "w") as made:
        made.create_virtual_dataset("Coordinates", layout)
    return folder / "a.h5"


def test_a_view_by_a_pattern_of_names_or_of_what_grows_is_refused(tmp_path):
    write_source(tmp_path / "source.h5", maxshape=(None, 3))
    for file, dataset in (("part%b.h5", "x"), ("source.h5", "x%b")):
        refused(r"a pattern.*how many there must be is not said", io.read_table, endless(tmp_path, file, dataset))
    refused("a view of what grows", io.read_table, endless(tmp_path))


def test_a_source_that_loses_its_data_is_noticed_the_next_time(tmp_path):
    write_source(tmp_path / "source.h5")
    path = write_view(tmp_path, whole_view())
    io.read_table(path)
    with h5py.File(tmp_path / "source.h5", "w") as file:
        file["y"] = POSITION
    refused("which is not there", io.read_table, path)


def write_raw(folder, name="raw.bin", offset=16, size=240):
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("Coordinates", (10, 3), "f8", external=[(name, offset, size)])
    return folder / "a.h5"


@pytest.mark.parametrize("size", [240, 1000, h5py.h5f.UNLIMITED])
def test_raw_bytes_in_another_file_are_read_if_all_are_there(size, empty, tmp_path):
    (tmp_path / "raw.bin").write_bytes(bytes(16) + POSITION.tobytes())
    path = write_raw(tmp_path, size=size)
    np.testing.assert_array_equal(io.read_table(path).position, POSITION)
    (tmp_path / "raw.bin").write_bytes(bytes(16) + POSITION.tobytes()[:-1])
    refused(r"a\.h5: `/Coordinates` lies in `raw\.bin`, which must have 256 bytes and has 255", io.read_table, path)


def test_raw_bytes_are_not_read_from_anywhere(tmp_path, monkeypatch):
    (tmp_path / "inner").mkdir()
    monkeypatch.chdir(tmp_path / "inner")
    (tmp_path / "raw.bin").write_bytes(bytes(300))
    for name in ("../raw.bin", str(tmp_path / "raw.bin")):
        refused(r"raw\.bin`, which lies outside of the folder", io.read_table, write_raw(tmp_path / "inner", name))
    with pytest.raises(ValueError, match=r"and there is no .*gone\.bin; start the program in the folder"):
        io.read_table(write_raw(tmp_path / "inner", "gone.bin"))


@pytest.mark.parametrize(("rows", "is_refused"), [(2**26, True), (2**20, False)])
def test_no_chunk_is_unpacked_that_is_far_larger_than_its_data_set(rows, is_refused, samples, tmp_path, measured):
    samples.write_points(tmp_path / "a.hdf5", samples.particles())
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        made = file.create_dataset("heat", (7,), "f8", maxshape=(None,), chunks=(rows,), compression="gzip")
        made.id.write_direct_chunk((0,), zlib.compress(bytes(8 * 2**20)))
    with measured() as memory:
        if is_refused:
            refused(
                r"a\.hdf5: .*left out heat: `/heat` .* chunks of 536870912 bytes", io.read_particles, tmp_path / "a.hdf5", "heat"
            )
        else:
            assert io.read_table(tmp_path / "a.hdf5").columns["heat"].tolist() == [0.0] * 7
    assert memory.peak < 2**23
