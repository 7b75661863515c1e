"""Data of a data set that lies in other files is there, all of it, or the data set is refused: nothing is read as zeros."""

import zlib

import numpy as np
import pytest

import jaxsph.io as io

h5py = pytest.importorskip("h5py")
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


def whole(dataset="x", size=(10, 3), file="source.h5"):
    return [(np.s_[:, :], file, dataset, size, np.s_[:, :])]


HALF, REST = np.s_[0:5, :], np.s_[5:10, :]


@pytest.mark.parametrize(
    "pieces",
    [
        whole(),
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
    path = write_view(tmp_path, whole(file="."))
    with h5py.File(path, "a") as file:
        file["x"] = POSITION
    np.testing.assert_array_equal(io.read_table(path).position, POSITION)


@pytest.mark.parametrize(
    ("pieces", "said"),
    [
        (whole("gone"), r"is a view of `gone` in `source\.h5`, which is not there"),
        (whole("unwritten"), r"is a view of `unwritten` in `source\.h5`: there `/unwritten` has shape"),
        (whole("group"), "which is no data set"),
        (whole("short"), r"`short` in `source\.h5`, which has the shape \(6, 3\) there"),
        ([(np.s_[:, :], "source.h5", "short", (20, 3), np.s_[4:14, :])], r"which has the shape \(6, 3\) there"),
        (whole("flat"), r"which has the shape \(30,\) there|cannot be read"),
        ([(HALF, "source.h5", "x", (10, 3), HALF)] * 2, "shows some data sets twice"),
        ([(HALF, "source.h5", "x", (10, 3), HALF)], "is a view of 15 numbers only"),
        ([(np.s_[::2, :], "source.h5", "x", (10, 3), HALF), (np.s_[1::2, :], "source.h5", "x", (10, 3), REST)], "no blocks"),
        (whole("view"), "which is a view itself"),
        (whole(file="../source.h5"), "lies outside of the folder"),
        (whole(file="folder"), "is no regular file"),
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
    with pytest.raises(ValueError, match=rf"a\.h5: .*({said})"):
        io.read_table(path)


@pytest.mark.parametrize(("file", "dataset"), [("part%b.h5", "x"), ("source.h5", "x%b")])
def test_a_view_by_a_pattern_of_names_is_refused(file, dataset, tmp_path):
    write_source(tmp_path / "source.h5")
    layout, endless = h5py.VirtualLayout((10, 3), "f8", maxshape=(None, 3)), h5py.h5s.UNLIMITED
    shown, source = (h5py.h5s.create_simple(shape, most) for shape, most in (((10, 3), (endless, 3)), ((5, 3), (5, 3))))
    shown.select_hyperslab((0, 0), (endless, 1), (5, 1), (5, 3))
    layout.dcpl.set_virtual(shown, file.encode(), dataset.encode(), source)
    with h5py.File(tmp_path / "a.h5", "w") as made:
        made.create_virtual_dataset("Coordinates", layout)
    with pytest.raises(ValueError, match=r"a pattern.*how many there must be is not said"):
        io.read_table(tmp_path / "a.h5")


def test_a_view_of_what_grows_is_refused(tmp_path):
    write_source(tmp_path / "source.h5", maxshape=(None, 3))
    layout = h5py.VirtualLayout((10, 3), "f8", maxshape=(None, 3))
    every = np.s_[0 : h5py.h5s.UNLIMITED, :]
    layout[every] = h5py.VirtualSource("source.h5", "x", (10, 3), maxshape=(None, 3))[every]
    with h5py.File(tmp_path / "a.h5", "w") as made:
        made.create_virtual_dataset("Coordinates", layout)
    with pytest.raises(ValueError, match="a view of what grows"):
        io.read_table(tmp_path / "a.h5")


def test_a_source_that_loses_its_data_is_noticed_the_next_time(tmp_path):
    write_source(tmp_path / "source.h5")
    path = write_view(tmp_path, whole())
    io.read_table(path)
    with h5py.File(tmp_path / "source.h5", "w") as file:
        file["y"] = POSITION
    with pytest.raises(ValueError, match="which is not there"):
        io.read_table(path)


def write_raw(folder, name="raw.bin", offset=16, size=240):
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("Coordinates", (10, 3), "f8", external=[(name, offset, size)])
    return folder / "a.h5"


@pytest.mark.parametrize("size", [240, 1000, h5py.h5f.UNLIMITED])
def test_raw_bytes_in_another_file_are_read_if_all_are_there(size, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "raw.bin").write_bytes(bytes(16) + POSITION.tobytes())
    path = write_raw(tmp_path, size=size)
    np.testing.assert_array_equal(io.read_table(path).position, POSITION)
    (tmp_path / "raw.bin").write_bytes(bytes(16) + POSITION.tobytes()[:-1])
    with pytest.raises(ValueError, match=r"a\.h5: `/Coordinates` lies in `raw\.bin`, which must have 256 bytes and has 255"):
        io.read_table(path)


def test_raw_bytes_are_not_read_from_anywhere(tmp_path, monkeypatch):
    (tmp_path / "inner").mkdir()
    monkeypatch.chdir(tmp_path / "inner")
    (tmp_path / "raw.bin").write_bytes(bytes(300))
    for name in ("../raw.bin", str(tmp_path / "raw.bin")):
        with pytest.raises(ValueError, match=r"raw\.bin`, which lies outside of the folder"):
            io.read_table(write_raw(tmp_path / "inner", name))
    with pytest.raises(ValueError, match=r"and there is no .*gone\.bin; start the program in the folder"):
        io.read_table(write_raw(tmp_path / "inner", "gone.bin"))


@pytest.mark.parametrize(("rows", "refused"), [(2**26, True), (2**20, False)])
def test_no_chunk_is_unpacked_that_is_far_larger_than_its_data_set(rows, refused, samples, tmp_path, measured):
    samples.write_points(tmp_path / "a.hdf5", samples.particles())
    with h5py.File(tmp_path / "a.hdf5", "a") as file:
        made = file.create_dataset("heat", (7,), "f8", maxshape=(None,), chunks=(rows,), compression="gzip")
        made.id.write_direct_chunk((0,), zlib.compress(bytes(8 * 2**20)))
    with measured() as memory:
        if refused:
            with pytest.raises(ValueError, match=r"a\.hdf5: `/heat` .* chunks of 536870912 bytes"):
                io.read_table(tmp_path / "a.hdf5")
        else:
            assert io.read_table(tmp_path / "a.hdf5").columns["heat"].tolist() == [0.0] * 7
    assert memory.peak < 2**23
