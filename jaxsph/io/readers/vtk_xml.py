"""VTK XML point sets: unstructured grids (`.vtu`, `.pvtu` of several) and polydata; points and point data, cells are not read.

Of ParaView's lists of files (`.pvd`) the last moment is read.

Data may be ASCII, base64 or appended (raw or base64), plain or compressed by zlib or LZMA, of both byte orders, in any
number of pieces. Point sets without a single cell are common among particle codes, and are read like others.
Source: VTK File Formats, Kitware, "XML File Formats"; the layout of blocks after vtkXMLDataParser.
"""

from __future__ import annotations

import base64
import dataclasses
import itertools
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from jaxsph.io import parsing
from jaxsph.io.damage import DataError, explained, inside
from jaxsph.io.snapshot_files import concatenated
from jaxsph.io.table import ParticleTable, single_number, table_from_columns

SOURCE = "VTK XML"
DATASETS = ("UnstructuredGrid", "PolyData")
PARALLEL = ("PUnstructuredGrid", "PPolyData")
COLLECTION = "Collection"
GHOST = "vtkGhostType"
TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4",
    "Int64": "i8", "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}  # fmt: skip
COMPRESSORS: dict[str | None, tuple[parsing.Decompressor | None, int]] = {
    None: (None, 4),  # a number of eight bytes is a digit and a space, where it is text
    "vtkZLibDataCompressor": (parsing.INFLATING, parsing.DEFLATE_RATIO),
    "vtkLZMADataCompressor": (parsing.UNLZMA, parsing.LZMA_RATIO),
}  # how data is unpacked, and the most bytes that one byte of the file can hold


def read(path: Path) -> ParticleTable:
    """Read points and point data of all pieces; columns of words are left out, and said so."""
    root, decoder = _any(path)
    return _last(path, root) if root.get("type") == COLLECTION else _points(path, root, decoder)


def _points(path: Path, root: ElementTree.Element, decoder: Decoder) -> ParticleTable:
    with explained(path, SOURCE):
        files = [(root, decoder)]
        if root.get("type") in PARALLEL:
            names = [piece.get("Source", "") for piece in root.iter("Piece")]
            parts = [inside(name, path, f"has a piece in `{name}`") for name in names]
            if len({part.resolve() for part in parts}) < len(parts):
                raise DataError("has one of its pieces twice; write it again")
            files = [parsed(part, DATASETS, ".vtu, .vtp") for part in parts]
        pieces = [_piece(piece, decoder) for root, decoder in files for piece in root.iter("Piece")]
        words = dict.fromkeys(word for _, decoder in files for word in decoder.words)
        if not pieces:
            raise DataError("has no Piece, so it is cut short or damaged; copy it again")
        shared = [name for name in pieces[0][1] if all(name in columns for _, columns in pieces)]
        columns = {name: np.concatenate([columns[name] for _, columns in pieces]) for name in shared}
        partial = {name for _, columns in pieces for name in columns} - set(columns)
        said = [f"left out {', '.join(sorted(partial))}: not in every piece"] if partial else []
        if words:
            said.append(f"left out {', '.join(words)}: not numbers")
        position = np.concatenate([position for position, _ in pieces])
        return table_from_columns(position, columns, source=SOURCE, conventions=said)


def _any(path: Path) -> tuple[ElementTree.Element, Decoder]:
    with explained(path, SOURCE):
        return parsed(path, (*DATASETS, *PARALLEL, COLLECTION), ".vtu, .vtp, .pvtu, .pvtp")


def parsed(path: Path, datasets: tuple[str, ...], suffixes: str) -> tuple[ElementTree.Element, Decoder]:
    """The XML of a file of one of those types of data set, and what reads its arrays."""
    content = path.read_bytes()
    start, stop = content.find(b"<AppendedData"), content.rfind(b"</AppendedData>")
    if stop < start:
        raise DataError("is cut short inside its data: `<AppendedData>` has no end; copy it again")
    root = xml_of(content if start < 0 else content[:start] + b"</VTKFile>")
    kind = root.get("type", "unknown")
    if root.tag != "VTKFile" or kind not in datasets:
        raise DataError(f"is XML of type {kind}; save it as {' or '.join(datasets)} ({suffixes})")
    mark = content.find(b"_", max(start, 0), max(stop, 0))
    tag, appended = (b"", b"") if mark < 0 else (content[start:mark], memoryview(content)[mark + 1 : stop])
    decoder = Decoder(root, tag, appended, len(content))
    decoder.refuse_leftover_data(root)
    return root, decoder


def xml_of(content: bytes) -> ElementTree.Element:
    """The root of XML without entities of its own: a few of them unpack to more than any memory."""
    if b"<!ENTITY" in content or b"<!DOCTYPE" in content:
        raise DataError("has entities of its own (`<!DOCTYPE`), which are not read; write it again without")
    return ElementTree.fromstring(content)


def _last(path: Path, root: ElementTree.Element) -> ParticleTable:
    """The particles of all parts at the last moment of a list of files."""
    with explained(path, SOURCE):
        moments: dict[float, list[str]] = {}
        for entry in root.iter("DataSet"):
            moments.setdefault(float(entry.get("timestep", "0")), []).append(entry.get("file", ""))
        if not moments:
            raise DataError("names no file of particles; write it again")
        time, names = max(moments.items())
        tables = []
        for name in names:
            part = inside(name, path, f"names `{name}`")
            inner, decoder = _any(part)
            if inner.get("type") == COLLECTION:
                raise DataError("names another list of files; open that")
            tables.append(dataclasses.replace(_points(part, inner, decoder), path=str(part)))
        table = concatenated(tables, 1)
        said = [f"the last of {len(moments)} moments: give the name of another's file for that"] if len(moments) > 1 else []
        return dataclasses.replace(table, time=single_number(time), conventions=(*said, *table.conventions))


def _piece(piece: ElementTree.Element, decoder: Decoder) -> tuple[np.ndarray, parsing.Columns]:
    stated = piece.get("NumberOfPoints")
    if stated is None:
        raise DataError("has a Piece that does not say its NumberOfPoints, so it is damaged; copy it again, or write it again")
    count = int(stated)
    if count < 0:
        raise DataError(f"announces {count} points, so it is damaged; copy it again")
    points = piece.find("Points/DataArray")
    if points is None and count:
        raise DataError("has a Piece without Points, so it is cut short or damaged; copy it again")
    position = np.zeros((0, 3)) if points is None else decoder.array(points, count, 3)
    if position is None or position.shape != (count, 3):
        raise DataError("has points that are not three numbers each; write it again")
    columns = decoder.point_data(piece, count)
    shown = (columns.pop(GHOST)[:, 0] & 1) == 0 if GHOST in columns else np.ones(count, bool)  # others are in another piece
    return position[shown], {name: column[shown] for name, column in columns.items()}


class Decoder:
    """What all data arrays of a file share: byte order, compression, and the appended data."""

    def __init__(self, root: ElementTree.Element, tag: bytes, appended: bytes | memoryview, file_bytes: int) -> None:
        order = {"LittleEndian": "<", "BigEndian": ">"}[root.get("byte_order", "LittleEndian")]
        self.order = order
        self.length = np.dtype(order + TYPES[root.get("header_type", "UInt32")])
        compressor = root.get("compressor") or None
        if compressor not in COMPRESSORS:
            raise DataError(f"is compressed by {compressor}, which is not supported; save it with zlib")
        self.decompressor, ratio = COMPRESSORS[compressor]
        self.file_bytes, self.room = file_bytes, ratio * file_bytes
        self.appended = memoryview(appended)
        self.appended_is_text = b"base64" in tag
        self.words: list[str] = []

    def point_data(self, piece: ElementTree.Element, count: int) -> parsing.Columns:
        """(count, width) numbers of each array of a piece's points, by name; those of words are left out."""
        columns: parsing.Columns = {}
        for element in piece.iterfind("PointData/DataArray"):
            name = element.get("Name", "unnamed")
            values = self.array(element, count, 1)
            if values is not None or name in columns:
                parsing.enter(columns, name, values)
        return columns

    def array(self, element: ElementTree.Element, count: int, default_width: int) -> np.ndarray | None:
        """(count, width) numbers of one `DataArray`, or `None` where it holds words."""
        name, kind = element.get("Name", "points"), element.get("type", "")
        if kind not in TYPES:
            self.words.append(name)
            return None
        width = int(element.get("NumberOfComponents") or default_width)
        dtype = np.dtype(self.order + TYPES[kind])
        need = count * max(width, 0) * dtype.itemsize
        self.room -= need
        if self.room < 0:
            raise DataError(f"announces more data than its {self.file_bytes} bytes can hold, so it is damaged; write it again")
        values = self._values(element, dtype, need, name) if count else np.zeros(0, dtype)
        if width < 1 or len(values) != count * width:
            wrong = f"has {len(values)} numbers of `{name}`, but {count} points of {width} components each;"
            raise DataError(f"{wrong} it is cut short or damaged: copy it again")
        return values.reshape(count, width)

    def _values(self, element: ElementTree.Element, dtype: np.dtype, need: int, name: str) -> np.ndarray:
        encoding, text = element.get("format", "ascii"), element.text or ""
        if encoding == "ascii":
            return parsing.numbers(text.split(), dtype)
        if encoding == "binary":
            stored = memoryview("".join(text.split()).encode("ascii"))
            parsing.refuse_leftover(len(stored) - self._span_of(stored, True), f"`{name}`", "characters")
            return np.frombuffer(self._decode(stored, True, need, name), dtype)
        if encoding == "appended":
            offset = int(element.get("offset", "0"))
            if offset < 0:
                raise DataError(f"has `{name}` at the offset {offset} of its appended data; it is damaged: copy it again")
            return np.frombuffer(self._decode(self.appended[offset:], self.appended_is_text, need, name), dtype)
        raise DataError(f"has data of format {encoding!r}; known are ascii, binary and appended")

    def refuse_leftover_data(self, root: ElementTree.Element) -> None:
        """Refuse appended data whose last array does not end where all of it does, but for white space."""
        offsets = [int(each.get("offset", "0")) for each in root.iter() if each.get("format") == "appended"]
        last = self.appended[max(offsets, default=0) :]
        if not offsets or not bytes(last[: self.length.itemsize]).strip():
            return
        stop = self._span_of(last, self.appended_is_text)
        parsing.refuse_leftover(len(bytes(last[stop:]).strip()), "its appended arrays")
        if stop > len(last) or (stop == len(last) and bytes(last[-1:]).isspace()):
            where = "the last array reaches into the end of `<AppendedData>`"
            raise DataError(f"is cut short inside its data: {where}; copy it again")

    def _span_of(self, data: memoryview, is_text: bool) -> int:
        """How many bytes of the file one array takes that begins with `data`."""
        start, sizes = self._header(data, is_text)
        return start + _span(sum(sizes), is_text)

    def _decode(self, data: memoryview, is_text: bool, need: int, name: str) -> bytes | memoryview:
        """The bytes of one array: a header of lengths, then the data, in blocks if compressed."""
        start, sizes = self._header(data, is_text)
        packed = _take(data, start, sum(sizes), is_text)
        if self.decompressor is None:
            return packed[0 if start else self.length.itemsize :]
        ends = itertools.accumulate(sizes, initial=0)
        blocks = (packed[a:b] for a, b in itertools.pairwise(ends))
        return parsing.unpack_blocks(blocks, self.decompressor, need, f"`{name}`")

    def _header(self, data: memoryview, is_text: bool) -> tuple[int, list[int]]:
        """Where the data of an array begins, and the bytes of its blocks; at 0, with the header, where both are one code."""
        size = self.length.itemsize
        first = int(np.frombuffer(_take(data, 0, size, is_text), self.length)[0])
        if self.decompressor is None:
            apart = is_text and b"=" in bytes(data[: _span(size, True)])  # padding inside: the header was encoded alone
            return (_span(size, True), [first]) if apart else (0, [size + first])
        header_size = (3 + first) * size
        sizes = np.frombuffer(_take(data, 0, header_size, is_text), self.length)[3:].tolist()
        return _span(header_size, is_text), sizes


def _span(size: int, is_text: bool) -> int:
    """How many bytes of the file hold `size` bytes of data."""
    return 4 * -(-size // 3) if is_text else size


def _take(data: memoryview, start: int, size: int, is_text: bool) -> bytes | memoryview:
    """`size` bytes of data that begin at `start` in the file."""
    stored = data[start : start + _span(size, is_text)]
    if len(stored) < _span(size, is_text):
        raise DataError("is cut short inside its data; copy it again")
    return base64.b64decode(stored, validate=True)[:size] if is_text else stored
