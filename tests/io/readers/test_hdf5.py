import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io

h5py = pytest.importorskip("h5py")
POSITION = np.random.default_rng(0).random((10, 3))
LAYOUTS = [
    {},
    {"chunks": (4, 3)},
    {"chunks": (4, 3), "compression": "gzip", "shuffle": True},
    {"chunks": (4, 3), "compression": "lzf"},
]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_what_was_written_whole_is_read(layout, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("Coordinates", data=POSITION, **layout)
        file.create_dataset("constant", data=np.ones((10, 3)), **layout)
    table = io.read_table(tmp_path / "a.h5")
    np.testing.assert_array_equal(table.position, POSITION)
    np.testing.assert_array_equal(table.columns["constant"], 1)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", ["Coordinates", "velocity"])
def test_what_was_never_written_is_refused_and_not_read_as_zeros(name, layout, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for label in ("Coordinates", "velocity"):
            file.create_dataset(label, (10, 3), "f8", **layout)
            if label != name:
                file[label][:] = POSITION
    refused(rf"a\.h5: `/{name}` has shape \(10, 3\).* were ever written", io.read_table, tmp_path / "a.h5")


@pytest.mark.parametrize("layout", LAYOUTS[1:])
def test_chunks_that_were_never_written_are_counted(layout, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("Coordinates", (10, 3), "f8", **layout)[:8] = POSITION[:8]
    refused(r"a\.h5: `/Coordinates` .* only 2 of its 3 chunks were ever written", io.read_table, tmp_path / "a.h5")


@pytest.mark.parametrize("kind", ["gadget", "phantom"])
def test_what_codes_never_wrote_is_refused_too(kind, samples, tmp_path):
    name = {"gadget": "PartType0/Density", "phantom": "particles/h"}[kind]
    {"gadget": samples.write_gadget_hdf5, "phantom": samples.write_phantom}[kind](tmp_path / "a.h5", samples.particles())
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file[name]
        file.create_dataset(name, (7,), "f4")
    refused(rf"a\.h5: `/{name}` has shape \(7,\), which needs 28 bytes, but only 0", io.read_table, tmp_path / "a.h5")


def test_a_shape_that_the_bytes_cannot_hold_is_refused_before_memory_is_asked_for(tmp_path, measured):
    for layout in ({}, {"chunks": (4, 3)}, {"chunks": (2**20, 3), "compression": "gzip"}):
        with h5py.File(tmp_path / "a.h5", "w") as file:
            file.create_dataset("Coordinates", (10**11, 3), "f8", maxshape=(None, 3) if layout else None, **layout)
        with measured() as memory, pytest.raises(ValueError, match=r"a\.h5: `/Coordinates` has shape \(100000000000, 3\)"):
            io.read_table(tmp_path / "a.h5")
        assert memory.peak < 2**22


@pytest.mark.parametrize("shape", [(10, 2), (30,), (10**12, 0), ()])
@pytest.mark.parametrize("name", ["Coordinates", "PartType0/Coordinates"])
def test_positions_of_another_shape_are_refused_before_they_are_read(name, shape, tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset(name, shape, "f8")
        file.create_group("Header").attrs["MassTable"] = np.ones(6)
    refused(rf"a\.h5: `/{name}` must hold numbers of shape \(N, 3\)", io.read_table, tmp_path / "a.h5")


def test_a_group_of_the_name_of_positions_is_refused(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_group("Coordinates")
    refused(r"a\.h5: `/Coordinates` must hold numbers of shape \(N, 3\), got None", io.read_table, tmp_path / "a.h5")


def write_view(folder, mapped=10):
    """Positions that are a view of those in two other files."""
    layout = h5py.VirtualLayout((10, 3), "f8")
    for index, part in enumerate((slice(0, 5), slice(5, mapped))):
        with h5py.File(folder / f"part{index}.h5", "w") as file:
            file["x"] = POSITION[part]
        layout[part] = h5py.VirtualSource(f"part{index}.h5", "x", POSITION[part].shape)
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_virtual_dataset("Coordinates", layout)


def test_a_view_of_other_files_is_read_when_they_are_there(tmp_path):
    write_view(tmp_path)
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.h5").position, POSITION)
    (tmp_path / "part1.h5").unlink()
    refused(r"a\.h5: `/Coordinates` is a view of `part1\.h5`, which is not there", io.read_table, tmp_path / "a.h5")


def test_a_view_of_less_than_its_shape_is_refused(tmp_path):
    write_view(tmp_path, mapped=8)
    refused(r"a\.h5: `/Coordinates` .* is a view of 24 numbers only", io.read_table, tmp_path / "a.h5")
