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
