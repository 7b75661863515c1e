import base64
import itertools
import struct

import numpy as np
import pytest

import jaxsph.io as io

POINTS = np.arange(6, dtype=np.float32).reshape(2, 3)
DATA = np.array([7.0, 8.0])


def write_by_hand(path, kind="UnstructuredGrid", order="<", encoding="base64", separate=False, words=False):
    """Two points and the scalar `a`, without cells, as VTK lays them out uncompressed."""
    arrays = [POINTS.astype(f"{order}f4").tobytes(), DATA.astype(f"{order}f8").tobytes()]
    lengths = [struct.pack(f"{order}I", len(array)) for array in arrays]
    text = encoding != "raw"
    encode = base64.b64encode if text else bytes
    if separate:
        blocks = [encode(length) + encode(array) for length, array in zip(lengths, arrays, strict=True)]
    else:
        blocks = [encode(length + array) for length, array in zip(lengths, arrays, strict=True)]
    offsets = [0, len(blocks[0])]
    if encoding == "base64":
        attributes, bodies, tail = ['format="binary"'] * 2, [block.decode() for block in blocks], b""
    else:
        attributes, bodies = [f'format="appended" offset="{offset}"' for offset in offsets], ["", ""]
        name = "raw" if encoding == "raw" else "base64"
        tail = f'<AppendedData encoding="{name}">_'.encode() + b"".join(blocks) + b"</AppendedData>"
    label = '<DataArray type="String" Name="label" format="ascii">104 0</DataArray>' if words else ""
    path.write_bytes(
        f"""<?xml version="1.0"?>
<VTKFile type="{kind}" version="1.0" byte_order="{"Little" if order == "<" else "Big"}Endian"><{kind}>
<Piece NumberOfPoints="2" NumberOfCells="0">
<PointData>{label}<DataArray type="Float64" Name="a" {attributes[1]}>{bodies[1]}</DataArray></PointData>
<Points><DataArray type="Float32" NumberOfComponents="3" {attributes[0]}>{bodies[0]}</DataArray></Points>
</Piece></{kind}>""".encode()
        + tail
        + b"</VTKFile>"
    )


CASES = [
    case
    for case in itertools.product(["UnstructuredGrid", "PolyData"], "<>", ["base64", "raw", "appended"], [False, True])
    if case[2] != "raw" or not case[3]
]


@pytest.mark.parametrize(("kind", "order", "encoding", "separate"), CASES)
def test_every_layout_is_read_and_no_cell_is_needed(kind, order, encoding, separate, tmp_path):
    write_by_hand(tmp_path / "a.vtp", kind, order, encoding, separate)
    table = io.read_table(tmp_path / "a.vtp")
    np.testing.assert_array_equal(table.position, POINTS)
    np.testing.assert_array_equal(table.columns["a"], DATA)
    assert table.position.dtype == np.float32 and table.position.dtype.isnative


def test_raw_data_cut_short_is_refused(tmp_path):
    write_by_hand(tmp_path / "a.vtu", encoding="raw")
    whole = (tmp_path / "a.vtu").read_bytes()
    (tmp_path / "a.vtu").write_bytes(whole[: whole.index(b">_") + 20])
    with pytest.raises(ValueError, match=r"a\.vtu: is cut short inside its data"):
        io.read_table(tmp_path / "a.vtu")


def test_words_are_left_out_and_said_so(tmp_path):
    write_by_hand(tmp_path / "a.vtu", words=True)
    table = io.read_table(tmp_path / "a.vtu")
    assert set(table.columns) == {"a"} and "left out label: not numbers" in table.conventions


@pytest.mark.parametrize("options", [{"binary": False}, {"compression": None}, {"compression": "zlib"}, {"compression": "lzma"}])
def test_every_encoding_that_meshio_writes_is_read(options, tmp_path):
    meshio = pytest.importorskip("meshio")
    position = np.random.default_rng(0).random((20_000, 3))  # several compressed blocks
    cells = [("vertex", np.arange(len(position))[:, None])]
    mesh = meshio.Mesh(position, cells, point_data={"a": np.arange(len(position))[:, None], "v": position})
    mesh.write(tmp_path / "a.vtu", **options)
    table = io.read_table(tmp_path / "a.vtu")
    np.testing.assert_allclose(table.position, position, rtol=1e-10)
    np.testing.assert_allclose(table.columns["v"], position, rtol=1e-10)
    np.testing.assert_array_equal(table.columns["a"], np.arange(len(position)))


def test_another_type_of_data_set_is_named(tmp_path):
    (tmp_path / "a.vti").write_text('<?xml version="1.0"?>\n<VTKFile type="ImageData" version="1.0">\n</VTKFile>\n')
    with pytest.raises(ValueError, match=r"a\.vti: is XML of type ImageData; save it as UnstructuredGrid or PolyData"):
        io.read_table(tmp_path / "a.vti")


def test_a_column_of_another_length_is_refused_by_name(tmp_path):
    text = """<VTKFile type="PolyData"><PolyData><Piece NumberOfPoints="2"><PointData>
    <DataArray type="Float32" Name="v" NumberOfComponents="3" format="ascii">1 2 3 4</DataArray></PointData>
    <Points><DataArray type="Float32" NumberOfComponents="3" format="ascii">1 2 3 4 5 6</DataArray></Points>
    </Piece></PolyData></VTKFile>"""
    (tmp_path / "a.vtp").write_text(text)
    with pytest.raises(ValueError, match=r"a\.vtp: has 4 numbers of `v`, but 2 points of 3 components"):
        io.read_table(tmp_path / "a.vtp")
    (tmp_path / "a.vtp").write_text(text.replace("1 2 3 4<", "1 2 3 4 5 6<"))
    assert io.read_table(tmp_path / "a.vtp").columns["v"].shape == (2, 3)


def test_pieces_are_joined(tmp_path):
    piece = """<Piece NumberOfPoints="1"><Points><DataArray type="Float32" NumberOfComponents="3">1 2 3</DataArray>
    </Points></Piece>"""
    (tmp_path / "a.vtp").write_text(f'<VTKFile type="PolyData"><PolyData>{piece * 3}</PolyData></VTKFile>')
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.vtp").position, [[1, 2, 3]] * 3)
