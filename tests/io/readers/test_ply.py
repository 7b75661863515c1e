import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io

XYZ = "property float x\nproperty float y\nproperty float z\n"


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


def around(path, encoding, missing=0):
    """Vertices between a view of two numbers and polygons of three to nine corners, of which some vertices are missing."""
    rng = np.random.default_rng(4)
    points, corners = rng.random((50, 3)).astype("f4"), [3] * 40 + rng.integers(3, 10, 60).tolist() + [3] * 30
    header = f"ply\nformat {encoding} 1.0\nelement view 2\nproperty short a\nproperty double b\nelement vertex 50\n{XYZ}"
    header += f"element face {len(corners)}\nproperty uchar kind\n"
    header += "property list uchar short vertex_indices\nproperty list uchar float u\n"
    rows, faces = points[missing:], [(kind % 7, list(range(kind)), [0.5] * kind) for kind in corners]
    if encoding == "ascii":
        body = ["7 0.5", "8 0.25", *(" ".join(map(repr, row)) for row in rows.tolist())]
        body += [" ".join(map(str, (kind, len(at), *at, len(u), *u))) for kind, at, u in faces]
        path.write_text(header + "end_header\n" + "\n".join(body) + "\n")
        return points
    order = "<" if "little" in encoding else ">"
    body = b"".join(np.array([(n, 0.5)], [("a", f"{order}i2"), ("b", f"{order}f8")]).tobytes() for n in (7, 8))
    body += rows.astype(f"{order}f4").tobytes()
    for kind, at, u in faces:
        body += bytes([kind, len(at)]) + np.array(at, f"{order}i2").tobytes()
        body += bytes([len(u)]) + np.array(u, f"{order}f4").tobytes()
    path.write_bytes(header.encode() + b"end_header\n" + body)
    return points


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_vertices_are_found_between_other_elements(encoding, tmp_path):
    points = around(tmp_path / "a.ply", encoding)
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.ply").position, points)
    whole = (tmp_path / "a.ply").read_bytes()
    short = whole[:-9] if encoding != "ascii" else whole[: whole.rindex(b"\n", 0, -1) + 1]
    for content, said in ((short, ""), (whole + b"\n1 2 3 4\n", r"has \d+ more (lines|bytes) than 50 vertices")):
        (tmp_path / "a.ply").write_bytes(content)
        refused(rf"a\.ply: {said}", io.read_table, tmp_path / "a.ply")


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("missing", [1, 4, 30])
def test_faces_are_not_read_as_vertices_that_are_missing(encoding, missing, tmp_path):
    around(tmp_path / "a.ply", encoding, missing)
    refused(r"a\.ply: ", io.read_table, tmp_path / "a.ply")


HEADER = "ply\nformat ascii 1.0\nelement vertex {count}\n{properties}end_header\n"
ONE, LIST = HEADER.format(count=1, properties=XYZ), "property float x\nproperty list uchar int a\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (HEADER.format(count=1, properties=LIST) + "1 1 1\n", ".*lists or of unknown type"),
        *(
            (f"ply\nformat ascii 1.0\n{elements}end_header\n1 2 3\n4 5 6\n", "announces .* must have one element `vertex`")
            for elements in ("element face 0\n", 2 * f"element vertex 1\n{XYZ}", f"element vertex -1\n{XYZ}")
        ),
        (HEADER.format(count=2, properties=XYZ) + "\n1 2 3\n\n\n", "is cut short: 2 vertices are announced, 1 are there"),
        (HEADER.format(count=1, properties=XYZ + "property uchar a\n") + "1 2 3 300\n", ".*300"),
        (HEADER.format(count=1, properties="") + "1 2 3\n", "has vertices without properties"),
        (HEADER.format(count=1, properties="").replace("ascii", "binary_little_endian"), "has vertices without properties"),
        (ONE + "1 2 3 4\n", "has 4 numbers a vertex, but 3 properties are announced"),
    ],
)
def test_vertices_that_are_not_what_the_header_says_are_refused(text, said, tmp_path):
    (tmp_path / "a.ply").write_text(text)
    refused(rf"a\.ply: {said}", io.read_table, tmp_path / "a.ply")


def test_blank_lines_between_vertices_cost_no_particle(tmp_path):
    (tmp_path / "a.ply").write_text(HEADER.format(count=2, properties=XYZ) + "\n1 2 3\n\n  \n4 5 6\n")
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.ply").position, [[1, 2, 3], [4, 5, 6]])


def test_integers_of_text_keep_all_their_digits(tmp_path):
    ids = [2**53 + 1, 2**63 - 1, -(2**63)]
    header = HEADER.format(count=3, properties=XYZ + "property int64 id\nproperty uint64 key\n")
    (tmp_path / "a.ply").write_text(header + "".join(f"1 2 3 {id} {2**64 - 1}\n" for id in ids))
    columns = io.read_table(tmp_path / "a.ply").columns
    assert columns["id"].tolist() == ids and columns["id"].dtype == np.int64
    assert columns["key"].tolist() == [2**64 - 1] * 3


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


@pytest.mark.parametrize("missing", range(1, 9))
def test_plain_triangles_are_no_vertices_though_they_end_where_they_should(missing, tmp_path):
    rng = np.random.default_rng(missing)
    points, corners = rng.random((30, 4)).astype("<f4"), rng.integers(0, 30, (40, 3)).astype("<i4")
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex 30\n{XYZ}property float a\nelement face 40\n"
    header += "property list uchar int vertex_indices\nend_header\n"
    for kept in (30, 30 - missing):
        faces = b"".join(b"\3" + row.tobytes() for row in corners)
        (tmp_path / "a.ply").write_bytes(header.encode() + points[:kept].tobytes() + faces)
        if kept == 30:
            np.testing.assert_array_equal(io.read_table(tmp_path / "a.ply").position, points[:, :3])
    refused(r"a\.ply: ", io.read_table, tmp_path / "a.ply")
