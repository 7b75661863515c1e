"""A column of width one is a scalar in every format that can hold one, whatever it means."""

import numpy as np
import pytest

import jaxsph.io as io
from jaxsph.io.table import table_from_columns

POSITION = np.random.default_rng(0).random((9, 3))
SUPPORT, VOLUME = np.linspace(0.25, 0.5, 9), np.linspace(1, 2, 9)


def write_npz(path, columns):
    np.savez(path, position=POSITION, **columns)


def write_points(path, columns):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name, column in {"position": POSITION, **columns}.items():
            file[name] = column


def write_by_meshio(path, columns):
    meshio = pytest.importorskip("meshio")
    meshio.Mesh(POSITION, [("vertex", np.arange(9)[:, None])], point_data=columns).write(path)


WRITERS = {
    "a.npz": write_npz, "a.h5": write_points, "a.vtu": write_by_meshio, "a.vtk": write_by_meshio,
}  # fmt: skip


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("label", ["support", "support_radius"])
@pytest.mark.parametrize("shape", [(9,), (9, 1)])
def test_a_support_of_width_one_is_the_support(name, label, shape, tmp_path):
    WRITERS[name](tmp_path / name, {label: SUPPORT.reshape(shape)})
    table = io.read_table(tmp_path / name)
    np.testing.assert_array_equal(table.support, SUPPORT)
    assert f"support = column `{label}`" in table.conventions and label not in table.columns


@pytest.mark.parametrize("name", WRITERS)
def test_volume_mass_density_and_quantity_of_width_one_are_scalars(name, tmp_path):
    columns = {"volume": VOLUME, "mass": 3 * VOLUME, "density": 2 * VOLUME, "dye": SUPPORT}
    WRITERS[name](tmp_path / name, {label: column[:, None] for label, column in columns.items()})
    table = io.read_table(tmp_path / name)
    np.testing.assert_array_equal(table.volume, VOLUME)
    assert set(table.scalars) == {"mass", "density", "dye"} and table.vectors == ()
    particles, report = io.particles_from_table(table, support=0.5)
    np.testing.assert_array_equal(particles.quantity[:9], SUPPORT.astype(np.float32))
    assert report.quantity == "dye" and report.volume == "volume = column `volume`"


@pytest.mark.parametrize(
    ("name", "columns"),
    [
        ("gadget.hdf5", ["PartType0/SmoothingLength"]),
        ("swift.hdf5", ["PartType0/SmoothingLengths"]),
        ("phantom.h5", ["particles/h", "particles/itype"]),
    ],
)
def test_lengths_and_types_of_width_one_are_read_from_codes(name, columns, samples, tmp_path):
    h5py = pytest.importorskip("h5py")
    samples.writers[name](tmp_path / name, samples.particles())
    flat = io.read_table(tmp_path / name)
    with h5py.File(tmp_path / name, "a") as file:
        for column in columns:
            values = file[column][()]
            del file[column]
            file[column] = values[:, None]
    wide = io.read_table(tmp_path / name)
    np.testing.assert_array_equal(wide.position, flat.position)
    np.testing.assert_array_equal(wide.support, flat.support)


def test_a_support_of_several_components_is_not_passed_over_in_silence():
    table = table_from_columns(POSITION, {"support": np.ones((9, 3))}, source="s")
    assert table.support is None and table.vectors == ("support",)
    assert any("column `support` has 3 components and is not used" in sentence for sentence in table.conventions)
