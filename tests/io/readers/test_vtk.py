import numpy as np
import pytest
from refusals import refused

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


@pytest.mark.parametrize("section", ["SCALARS id vtkIdType 1\nLOOKUP_TABLE default\n", "FIELD FieldData 1\nid 1 2 vtkIdType\n"])
def test_vtk_writes_its_ids_as_int(section, tmp_path):
    head = "# vtk DataFile Version 3.0\nt\n{}\nDATASET POLYDATA\nPOINTS 2 float\n{}\nPOINT_DATA 2\n" + section
    points, ids = np.array([[1, 2, 3], [4, 5, 6]]), np.array([7, -8])
    binary = head.encode().replace(b"{}", b"BINARY", 1).replace(b"{}", points.astype(">f4").tobytes())
    for content in (binary + ids.astype(">i4").tobytes() + b"\n", head.format("ASCII", "1 2 3 4 5 6").encode() + b"7 -8\n"):
        (tmp_path / "a.vtk").write_bytes(content)
        table = io.read_table(tmp_path / "a.vtk")
        np.testing.assert_array_equal(table.position, points)
        np.testing.assert_array_equal(table.columns["id"], ids)


FOUR = b"POINTS 4 float\n0 0 0 0 0 0 0 0 0 0 0 0\nVERTICES 7 14"
HEAD = "# vtk DataFile Version 3.0\nt\n{}\nDATASET {}\n"


@pytest.mark.parametrize(("old", "new"), [(b"density 1", b"velocity 1"), (b"density 1", b"id 1"), (b"VERTICES 7 14", FOUR)])
def test_what_is_there_twice_is_refused(old, new, samples, tmp_path):
    samples.write_vtk(tmp_path / "a.vtk", samples.particles(), binary=False)
    (tmp_path / "a.vtk").write_bytes((tmp_path / "a.vtk").read_bytes().replace(old, new))
    refused(r"a\.vtk: has .* twice", io.read_table, tmp_path / "a.vtk")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEAD.format("ASCII", "STRUCTURED_POINTS"), "holds a STRUCTURED_POINTS"),
        (HEAD.format("BINARY", "POLYDATA") + "POINTS 99999999999 float\n", "announces .* cut short"),
        *(
            (HEAD.format("ASCII", "POLYDATA") + text, f"has b'{word}' where a number should be")  # numbers have no underscores
            for word in ("2_5", "_25", "25_")
            for kind in ("int", "double")
            for text in (f"POINTS 1 float\n1 2 {word}\n", f"POINTS 1 float\n1 2 3\nPOINT_DATA 1\nSCALARS a {kind}\n{word}\n")
        ),
    ],
)
def test_what_holds_no_particles_is_refused(text, said, tmp_path):
    (tmp_path / "a.vtk").write_text(text)
    refused(rf"a\.vtk: {said}", io.read_table, tmp_path / "a.vtk")


def test_one_long_word_does_not_widen_all_others(tmp_path, measured):
    numbers = ["1"] * 2999 + ["2." + "0" * 50_000]
    (tmp_path / "a.vtk").write_text(
        f"# vtk DataFile Version 3.0\nt\nASCII\nDATASET POLYDATA\nPOINTS 1000 float\n{' '.join(numbers)}\n"
    )
    with measured() as memory:
        table = io.read_table(tmp_path / "a.vtk")
    assert table.position[-1, -1] == 2 and memory.peak < 2**24


def test_binary_data_that_does_not_end_with_its_line_is_refused(samples, tmp_path):
    """A byte less, and the end of the line is taken for data."""
    samples.write_vtk(tmp_path / "a.vtk", samples.particles())
    content = (tmp_path / "a.vtk").read_bytes()
    start = content.index(b"POINTS 7 float\n") + 20
    for damaged in (content[:start] + content[start + 1 :], content[:start] + b"\1" + content[start:]):
        (tmp_path / "a.vtk").write_bytes(damaged)
        refused(r"a\.vtk: has no end of the line after points", io.read_table, tmp_path / "a.vtk")


@pytest.mark.parametrize("binary", [False, True])
def test_arrays_of_words_bits_and_other_rows_refuse_no_file(binary, tmp_path):
    x = np.arange(9.0).reshape(3, 3)
    head = f"# vtk DataFile Version 3.0\nt\n{'BINARY' if binary else 'ASCII'}\nDATASET POLYDATA\nPOINTS 3 double\n".encode()

    def encode(values, kind):
        return values.astype(kind).tobytes() if binary else " ".join(map(str, values.ravel().tolist())).encode()

    out = head + encode(x, ">f8") + b"\nPOINT_DATA 3\nFIELD f 3\n"
    out = out if binary else out.replace(b"FIELD f 3", b"FIELD f 4\nwords 1 3 string\na b\n\nc")
    bits = np.packbits([1, 0, 1]) if binary else np.array([1, 0, 1])
    out += b"few 1 2 double\n" + encode(x[0, :2], ">f8") + b"\nflags 1 3 bit\n" + encode(bits, "u1")
    out += b"\nrho 1 3 double\n" + encode(x[0], ">f8") + b"\n"
    (tmp_path / "a.vtk").write_bytes(out)
    table = io.read_table(tmp_path / "a.vtk")
    assert table.columns["flags"].tolist() == [1, 0, 1] and table.columns["rho"].tolist() == [0, 1, 2] and len(table.columns) == 2
    refused("left out .*few: words, or other rows than points", io.read_particles, tmp_path / "a.vtk", "few", 0.5)
