import numpy as np
import pytest

import jaxsph.io as io


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_every_encoding_is_read(encoding, samples, tmp_path):
    p = samples.particles()
    samples.write_ply(tmp_path / "a.ply", p, encoding)
    table = io.read_table(tmp_path / "a.ply")
    np.testing.assert_array_equal(table.position, p.position)
    np.testing.assert_array_equal(table.columns["v"], p.velocity)
    np.testing.assert_array_equal(table.columns["density"], p.density)
    np.testing.assert_array_equal(table.columns["id"], p.id)
    assert table.columns["id"].dtype == np.int32


def test_lists_in_vertices_are_refused(tmp_path):
    header = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty list uchar int a\nend_header\n1 1 1\n"
    (tmp_path / "a.ply").write_text(header)
    with pytest.raises(ValueError, match="lists or of unknown type"):
        io.read_table(tmp_path / "a.ply")


def test_faces_before_vertices_are_refused(tmp_path):
    (tmp_path / "a.ply").write_text("ply\nformat ascii 1.0\nelement face 0\nelement vertex 0\nend_header\n")
    with pytest.raises(ValueError, match="does not have `vertex` as its first element"):
        io.read_table(tmp_path / "a.ply")


HEADER = "ply\nformat ascii 1.0\nelement vertex {count}\n{properties}end_header\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"


def test_blank_lines_between_vertices_cost_no_particle(tmp_path):
    header = HEADER.format(count=2, properties=XYZ) + "\n"
    (tmp_path / "a.ply").write_text(header + "1 2 3\n\n  \n4 5 6\n")
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.ply").position, [[1, 2, 3], [4, 5, 6]])
    (tmp_path / "a.ply").write_text(header + "1 2 3\n\n\n")
    with pytest.raises(ValueError, match=r"a\.ply: is cut short: 2 vertices are announced, 1 are there"):
        io.read_table(tmp_path / "a.ply")


def test_integers_of_text_keep_all_their_digits(tmp_path):
    ids = [2**53 + 1, 2**63 - 1, -(2**63)]
    header = HEADER.format(count=3, properties=XYZ + "property int64 id\nproperty uint64 key\n")
    (tmp_path / "a.ply").write_text(header + "".join(f"1 2 3 {id} {2**64 - 1}\n" for id in ids))
    columns = io.read_table(tmp_path / "a.ply").columns
    assert columns["id"].tolist() == ids and columns["id"].dtype == np.int64
    assert columns["key"].tolist() == [2**64 - 1] * 3


def test_an_integer_that_its_type_cannot_hold_is_refused(tmp_path):
    (tmp_path / "a.ply").write_text(HEADER.format(count=1, properties=XYZ + "property uchar a\n") + "1 2 3 300\n")
    with pytest.raises(ValueError, match=r"a\.ply: .*300"):
        io.read_table(tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_vertices_without_properties_are_refused(encoding, tmp_path):
    (tmp_path / "a.ply").write_text(HEADER.format(count=1, properties="").replace("ascii", encoding) + "1 2 3\n")
    with pytest.raises(ValueError, match=r"a\.ply: has vertices without properties"):
        io.read_table(tmp_path / "a.ply")


def test_another_number_of_values_than_of_properties_is_refused(tmp_path):
    (tmp_path / "a.ply").write_text(HEADER.format(count=1, properties=XYZ) + "1 2 3 4\n")
    with pytest.raises(ValueError, match="has 4 numbers a vertex, but 3 properties are announced"):
        io.read_table(tmp_path / "a.ply")


def test_only_a_line_of_its_own_ends_the_header(samples, tmp_path):
    p = samples.particles()
    for encoding in ("binary_little_endian", "ascii"):
        samples.write_ply(tmp_path / "a.ply", p, encoding)
        content = (tmp_path / "a.ply").read_bytes()
        comment = b"comment the end_header follows\ncomment end_header\nproperty float density\n"
        (tmp_path / "a.ply").write_bytes(content.replace(b"property float density\n", comment))
        table = io.read_table(tmp_path / "a.ply")
        np.testing.assert_array_equal(table.position, p.position)
        np.testing.assert_array_equal(table.columns["density"], p.density)
