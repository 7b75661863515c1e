"""XDMF is read with its numbers in the file or in HDF5 beside it; what cannot be read is left out, or refused by name."""

import numpy as np
import pytest
from files_written import make_particles, write_xdmf, xdmf_item
from refusals import refused

import jaxsph.io as io

h5py = pytest.importorskip("h5py")
P = make_particles()


def write_heavy(folder):
    """Its numbers lie in HDF5, by the place in the list of what was written."""
    with h5py.File(folder / "sph.h5", "w") as file:

        def place(values):
            file[f"data/a{len(file.get('data', ()))}"] = values
            return xdmf_item(values, f"sph.h5:/data/a{len(file['data']) - 1}")

        write_xdmf(folder / "a.xdmf", P, place)
    return folder / "a.xdmf"


def test_numbers_in_the_file_and_beside_it_are_the_same(tmp_path):
    write_xdmf(tmp_path / "a.xmf", P)
    for path in (tmp_path / "a.xmf", write_heavy(tmp_path)):
        table = io.read_table(path)
        np.testing.assert_array_equal(table.position, P.position)
        np.testing.assert_array_equal(table.columns["velocity"], P.velocity)
        assert table.columns["density"].tolist() == P.density.tolist() and table.columns["id"].tolist() == P.id.tolist()


def grid(x, more="", kind="XYZ"):
    return f'<Grid><Geometry GeometryType="{kind}">{"".join(map(xdmf_item, x))}</Geometry>{more}</Grid>'


def write(path, grids):
    path.write_text(f"<Xdmf><Domain>{grids}</Domain></Xdmf>")
    return path


def test_the_last_of_several_moments_is_read_and_parts_are_joined(tmp_path):
    x = P.position
    parts = '<Grid GridType="Collection" CollectionType="Spatial"><Time Value="2.5"/>' + grid([x]) + grid([x[:2]]) + "</Grid>"
    times = f'<Grid GridType="Collection" CollectionType="Temporal">{grid([x[:3]])}{parts}</Grid>'
    table = io.read_table(write(tmp_path / "a.xmf", times))
    np.testing.assert_array_equal(table.position, np.concatenate([x, x[:2]]))
    assert table.time == 2.5 and "the last of 2 moments" in table.conventions


def test_coordinates_apart_or_of_a_plane_are_read(tmp_path):
    for kind, arrays in (("X_Y_Z", list(P.position.T)), ("XY", [P.position[:, :2]]), ("X_Y", list(P.position.T[:2]))):
        table = io.read_table(write(tmp_path / "a.xmf", grid(arrays, kind=kind)))
        np.testing.assert_array_equal(table.position, P.position * [1, 1, "Z" in kind])


@pytest.mark.parametrize("item", [
    '<DataItem ItemType="Function">1</DataItem>', '<DataItem Format="HDF">gone.h5:/a</DataItem>', xdmf_item(np.ones(4)),
    '<DataItem Format="HDF">../a.h5:/a</DataItem>', '<DataItem Dimensions="7">1 2 3</DataItem>', "",
    '<DataItem Dimensions="7">a b c d e f g</DataItem>', '<DataItem Precision="3">1 2 3</DataItem>',
    '<DataItem NumberType="Int" Precision="1">300 1 1 1 1 1 1</DataItem>',
])  # fmt: skip
def test_attributes_that_cannot_be_read_are_left_out_and_points_are_refused(item, tmp_path):
    odd = f'<Attribute Name="odd">{item}</Attribute>'
    path = write(tmp_path / "a.xmf", grid([P.position], odd))
    assert len(io.read_table(path)) == 7
    refused("left out odd: ", io.read_particles, path, "odd", 0.5)
    refused(r"a\.xmf: ", io.read_table, write(path, f"<Grid><Geometry>{item}</Geometry></Grid>"))


def test_attributes_without_numbers_or_own_names_are_left_out(tmp_path):
    twice = "".join(f'<Attribute Name="a">{xdmf_item(np.full(7, value))}</Attribute>' for value in (1.0, 2.0))
    none = '<Attribute Name="none"><DataItem Dimensions="7 0"/></Attribute>'
    table = io.read_table(write(tmp_path / "a.xmf", grid([P.position], twice + none)))
    assert "left out none: it has 0 numbers a particle" in " ".join(table.conventions)
    assert table.columns["a"].tolist() == [1] * 7 and "left out a: has the attribute `a` twice" in " ".join(table.conventions)


def test_entities_and_what_has_no_points_are_refused(tmp_path):
    refused("no Grid with a Geometry", io.read_table, write(tmp_path / "a.xmf", ""))
    (tmp_path / "a.xmf").write_text('<!DOCTYPE Xdmf [<!ENTITY a "aaaa">]><Xdmf>&a;</Xdmf>')
    refused("has entities of its own", io.read_table, tmp_path / "a.xmf")
