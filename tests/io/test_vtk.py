import numpy as np
import pytest

import jaxsph.io as io


@pytest.mark.parametrize("dataset", ["POLYDATA", "UNSTRUCTURED_GRID"])
@pytest.mark.parametrize("binary", [True, False])
def test_points_and_data_are_read_from_every_kind_of_legacy_file(dataset, binary, samples, tmp_path):
    p = samples.particles()
    samples.write_vtk(tmp_path / "a.vtk", p, dataset, binary)
    table = io.read_table(tmp_path / "a.vtk")
    np.testing.assert_array_equal(table.position, p.position)
    np.testing.assert_array_equal(table.columns["velocity"], p.velocity)
    np.testing.assert_array_equal(table.columns["density"], p.density)
    np.testing.assert_array_equal(table.columns["id"], p.id)
    assert all(column.dtype.isnative for column in table.columns.values())


def test_scalars_without_a_width_have_width_one(samples, tmp_path):
    samples.write_vtk(tmp_path / "a.vtk", samples.particles(), scalar_width="")
    assert io.read_table(tmp_path / "a.vtk").columns["id"].ndim == 1


def test_data_of_cells_and_metadata_are_skipped(samples, tmp_path):
    samples.write_vtk5(tmp_path / "a.vtk", samples.particles())
    assert set(io.read_table(tmp_path / "a.vtk").columns) == {"velocity"}


def test_what_meshio_writes_is_read(tmp_path):
    meshio = pytest.importorskip("meshio")
    position = np.random.default_rng(0).random((5, 3))
    cells = [("vertex", np.arange(5)[:, None])]
    for version in ("vtk42", "vtk51"):
        mesh = meshio.Mesh(position, cells, point_data={"a": np.arange(5.0), "v": position})
        mesh.write(tmp_path / "a.vtk", file_format=version)
        table = io.read_table(tmp_path / "a.vtk")
        np.testing.assert_array_equal(table.position, position)
        np.testing.assert_array_equal(table.columns["a"], np.arange(5.0))


def test_grids_are_refused(tmp_path):
    (tmp_path / "a.vtk").write_text("# vtk DataFile Version 3.0\nt\nASCII\nDATASET STRUCTURED_POINTS\n")
    with pytest.raises(ValueError, match=r"a\.vtk: holds a STRUCTURED_POINTS"):
        io.read_table(tmp_path / "a.vtk")


def test_a_count_that_the_file_has_no_room_for_is_refused_before_memory_is_asked_for(tmp_path):
    (tmp_path / "a.vtk").write_text("# vtk DataFile Version 3.0\nt\nBINARY\nDATASET POLYDATA\nPOINTS 99999999999 float\n")
    with pytest.raises(ValueError, match="cut short"):
        io.read_table(tmp_path / "a.vtk")
