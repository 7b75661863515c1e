import base64
import itertools
import lzma
import re
import struct
import zlib

import numpy as np
import pytest
from refusals import refused

import jaxsph.io as io

POINTS = np.arange(6, dtype=np.float32).reshape(2, 3)
DATA = np.array([7.0, 8.0])


PVD = '<VTKFile type="Collection"><Collection>{}</Collection></VTKFile>'


def test_the_last_moment_of_a_list_of_files_is_read_with_its_parts(tmp_path):
    (tmp_path / "out").mkdir()
    for name in ("one", "two", "three"):
        write_by_hand(tmp_path / "out" / f"{name}.vtu")
    rows = [("0.5", "out/one.vtu"), ("2", "out/two.vtu"), ("2", "out/three.vtu"), ("1", "gone.vtu")]
    entries = "".join(f'<DataSet timestep="{time}" part="{nth}" file="{name}"/>' for nth, (time, name) in enumerate(rows))
    (tmp_path / "run.pvd").write_text(PVD.format(entries))
    table = io.read_table(tmp_path / "run.pvd")
    np.testing.assert_array_equal(table.position, np.concatenate([POINTS, POINTS]))
    assert table.time == 2 and table.columns["a"].tolist() == [7, 8, 7, 8]
    assert any(said.startswith("the last of 3 moments") for said in table.conventions)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (PVD.format(""), "names no file"),
        (PVD.format('<DataSet file="run.pvd"/>'), "names another list"),
        (PVD.format('<DataSet file="list.vtu"/>'), "names another list"),
        (PVD.format('<DataSet file="../a.vtu"/>'), "lies outside of the folder"),
        (PVD.format('<DataSet file="http://host/a.vtu"/>'), "is no regular file"),
        ('<!DOCTYPE a [<!ENTITY b "ccc">]>' + PVD.format("&b;"), "has entities of its own"),
    ],
)
def test_lists_of_files_that_lead_astray_are_refused(text, said, tmp_path):
    for name in ("run.pvd", "list.vtu"):
        (tmp_path / name).write_text(text)
    refused(rf"run\.pvd: .*{said}", io.read_table, tmp_path / "run.pvd")


@pytest.mark.parametrize("names", [("whole", "part"), ("part", "whole")])
def test_volumes_of_some_parts_alone_are_refused(names, tmp_path):
    write_by_hand(tmp_path / "part.vtu")
    content = (tmp_path / "part.vtu").read_bytes()
    (tmp_path / "whole.vtu").write_bytes(content.replace(b'Name="a"', b'Name="volume"'))
    (tmp_path / "run.pvd").write_text(PVD.format("".join(f'<DataSet file="{name}.vtu"/>' for name in names)))
    refused("volumes of the particles are in some files", io.read_table, tmp_path / "run.pvd")


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


def test_pieces_are_joined(tmp_path):
    piece = """<Piece NumberOfPoints="1"><Points><DataArray type="Float32" NumberOfComponents="3">1 2 3</DataArray>
    </Points></Piece>"""
    (tmp_path / "a.vtp").write_text(f'<VTKFile type="PolyData"><PolyData>{piece * 3}</PolyData></VTKFile>')
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.vtp").position, [[1, 2, 3]] * 3)


def write_compressed(path, blocks, compressor="vtkZLibDataCompressor", missing=0):
    """One array of points in compressed blocks."""
    compress = {"vtkZLibDataCompressor": zlib.compress, "vtkLZMADataCompressor": lzma.compress}[compressor]
    packed = [compress(block)[: -missing or None] for block in blocks]
    head = struct.pack(f"<{3 + len(packed)}I", len(packed), len(blocks[0]), len(blocks[-1]), *map(len, packed))
    body = (base64.b64encode(head) + base64.b64encode(b"".join(packed))).decode()
    path.write_text(
        f"""<VTKFile type="PolyData" byte_order="LittleEndian" compressor="{compressor}"><PolyData>
        <Piece NumberOfPoints="2"><Points><DataArray type="Float32" NumberOfComponents="3" format="binary">{body}
        </DataArray></Points></Piece></PolyData></VTKFile>"""
    )


@pytest.mark.parametrize("compressor", ["vtkZLibDataCompressor", "vtkLZMADataCompressor"])
def test_compressed_data_is_unpacked_to_what_the_points_need_and_no_further(compressor, tmp_path, measured):
    content = POINTS.astype("<f4").tobytes()
    write_compressed(tmp_path / "a.vtp", [content[:16], content[16:]], compressor)
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.vtp").position, POINTS)
    write_compressed(tmp_path / "a.vtp", [content, bytes(2**25)], compressor)
    with measured() as memory, pytest.raises(ValueError, match=r"a\.vtp: .*more than the 24 bytes that `points` need"):
        io.read_table(tmp_path / "a.vtp")
    assert memory.peak < 2**24


def test_a_compressed_block_that_does_not_end_is_refused(tmp_path):
    write_compressed(tmp_path / "a.vtp", [POINTS.astype("<f4").tobytes()], missing=4)  # the check sum
    refused(r"a\.vtp: is cut short inside `points`", io.read_table, tmp_path / "a.vtp")


def test_many_arrays_over_the_same_data_take_no_more_memory_than_the_file_can_hold(tmp_path, measured):
    count = 100_000
    array = '<DataArray type="Float32" Name="{}" NumberOfComponents="{}" format="appended" offset="0"/>'
    arrays = "".join(array.format(index, 3) for index in range(1000))
    content = f"""<VTKFile type="PolyData" byte_order="LittleEndian"><PolyData><Piece NumberOfPoints="{count}"><Points>
    {array.format("p", 3)}</Points><PointData>{arrays}</PointData></Piece></PolyData><AppendedData encoding="raw">_""".encode()
    content += struct.pack("<I", 12 * count) + bytes(12 * count) + b"</AppendedData></VTKFile>"
    (tmp_path / "a.vtu").write_bytes(content)
    with measured() as memory, pytest.raises(ValueError, match=r"a\.vtu: .*more data than"):
        io.read_table(tmp_path / "a.vtu")
    assert memory.peak < 16 * len(content)


@pytest.mark.parametrize("white", [b"", b"\n  "])
@pytest.mark.parametrize("encoding", ["raw", "appended"])
def test_appended_data_ends_with_its_last_array(encoding, white, tmp_path):
    write_by_hand(tmp_path / "a.vtu", encoding=encoding)
    whole = (tmp_path / "a.vtu").read_bytes()
    stop = whole.index(b"</AppendedData>")
    (tmp_path / "a.vtu").write_bytes(whole[:stop] + white + whole[stop:])
    np.testing.assert_array_equal(io.read_table(tmp_path / "a.vtu").columns["a"], DATA)
    for rest in (whole[stop - 4 : stop] + b"AAAA", b""):
        (tmp_path / "a.vtu").write_bytes(whole[: stop - 4] + rest + white + whole[stop:])
        with pytest.raises(ValueError, match=r"a\.vtu: (is cut short inside its data|has 4 more bytes than its appended arrays)"):
            io.read_table(tmp_path / "a.vtu")


ARRAY = re.compile(rb'<DataArray type="Float64".*?</DataArray>')
VECTOR = b'<DataArray type="Float32" Name="v" NumberOfComponents="3" format="ascii">1 2 3 4</DataArray></PointData>'


@pytest.mark.parametrize(
    ("encoding", "change", "said"),
    [
        ("raw", lambda c: c[: c.index(b">_") + 20], "is cut short inside its data"),
        ("base64", lambda c: c.replace(b"UnstructuredGrid", b"ImageData"), "is XML of type ImageData; save it as UnstructuredG"),
        ("base64", lambda c: c.replace(b"</PointData>", VECTOR), "has 4 numbers of `v`, but 2 points of 3 components"),
        ("base64", lambda c: ARRAY.sub(lambda found: 2 * found[0], c), "has the array `a` twice"),
        ("base64", lambda c: c.replace(b"NumberOfPoints", b"NumberOfPonts"), "has a Piece that does not say its NumberOfPoints"),
        ("base64", lambda c: c.replace(b"</DataArray>", b"AAAA</DataArray>", 1), "has 4 more characters than `a`"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused(encoding, change, said, tmp_path):
    write_by_hand(tmp_path / "a.vtu", encoding=encoding)
    (tmp_path / "a.vtu").write_bytes(change((tmp_path / "a.vtu").read_bytes()))
    refused(rf"a\.vtu: {said}", io.read_table, tmp_path / "a.vtu")


def parallel(folder, sources, extra=""):
    pieces = "".join(f'<Piece Source="{source}"/>' for source in sources)
    (folder / "all.pvtu").write_text(
        f'<VTKFile type="PUnstructuredGrid" byte_order="LittleEndian"><PUnstructuredGrid>{pieces}</PUnstructuredGrid></VTKFile>'
    )
    return folder / "all.pvtu"


def test_a_parallel_file_is_all_of_its_pieces_without_their_ghosts(samples, tmp_path):
    for number in range(2):
        samples.writers["ascii.vtu"](tmp_path / f"p_{number}.vtu", samples.particles(seed=number))
    path = parallel(tmp_path, ["p_0.vtu", "p_1.vtu"])
    table, each = io.read_table(path), [samples.particles(seed=number) for number in range(2)]
    np.testing.assert_array_equal(table.position, np.concatenate([p.position for p in each]))
    np.testing.assert_array_equal(table.columns["density"], np.concatenate([p.density for p in each]))
    ghosts = '<DataArray type="UInt8" Name="vtkGhostType" format="ascii">0 1 0 0 1 8 0</DataArray></PointData>'
    content = (tmp_path / "p_1.vtu").read_text()
    (tmp_path / "p_1.vtu").write_text(content.replace("</PointData>", ghosts))
    kept = np.concatenate([each[0].position, each[1].position[[0, 2, 3, 5, 6]]])
    np.testing.assert_array_equal(io.read_table(path).position, kept)


@pytest.mark.parametrize(
    ("sources", "said"),
    [
        (["p.vtu", "./p.vtu"], "one of its pieces twice"),
        (["../p.vtu"], "outside of the folder"),
        (["gone.vtu"], "no regular file"),
        ([], "no Piece"),
    ],
)
def test_pieces_of_a_parallel_file_are_others_beside_it(sources, said, samples, tmp_path):
    (tmp_path / "sub").mkdir()
    for folder in (tmp_path, tmp_path / "sub"):
        samples.writers["ascii.vtu"](folder / "p.vtu", samples.particles())
    refused(rf"all\.pvtu: .*{said}", io.read_table, parallel(tmp_path / "sub", sources))
