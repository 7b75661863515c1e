"""Legacy VTK files (`.vtk`), ASCII and binary: the points and point data of polydata and unstructured grids.

Binary data is big-endian. Cells of every kind are skipped; versions 2.0 to 5.1 are known. `FIELD` arrays, `SCALARS`,
`VECTORS`, `NORMALS` and `TENSORS` become columns; colours and texture coordinates are skipped.
Source: VTK File Formats, Kitware, "Simple Legacy Formats".
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from jaxsph.io.damage import UNENDED_NOTE, DataError, explained
from jaxsph.io.parsing import Columns, enter, numbers
from jaxsph.io.table import ParticleTable, table_from_columns

SOURCE = "legacy VTK"
TYPES = {
    "unsigned_char": "u1", "char": "i1", "unsigned_short": "u2", "short": "i2", "unsigned_int": "u4", "int": "i4",
    "unsigned_long": "u8", "long": "i8", "float": "f4", "double": "f8", "vtktypeint64": "i8", "vtkidtype": "i4",
    "bit": "u1", "vtktypeuint64": "u8", "vtktypeint32": "i4", "vtktypeuint32": "u4",
}  # fmt: skip
"""`vtkIdType` has 8 bytes in memory, but VTK's legacy writer and reader (vtkDataWriter, vtkDataReader) store it as int."""
DATASETS = ("POLYDATA", "UNSTRUCTURED_GRID")
CELLS = ("VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS", "CELLS")
WIDTHS = {"VECTORS": 3, "NORMALS": 3, "TENSORS": 9}


def read(path: Path) -> ParticleTable:
    """Read points and point data; `ValueError` on grids, unknown sections and data cut short."""
    with explained(path, SOURCE):
        cursor = _Cursor(path.read_bytes())
        if not cursor.line().startswith("# vtk DataFile Version"):
            raise DataError("does not begin with `# vtk DataFile Version`, so it is no legacy VTK file")
        cursor.line()  # the title
        encoding = cursor.line().upper()
        if encoding not in ("ASCII", "BINARY"):
            raise DataError(f"is neither ASCII nor BINARY but {encoding!r}, so its header is damaged or cut short")
        cursor.is_ascii = encoding == "ASCII"
        position, columns = _sections(cursor)
        said = [f"left out {', '.join(cursor.left_out)}: words, or other rows than points"] if cursor.left_out else []
        said += [UNENDED_NOTE] if cursor.is_ascii and not cursor.content.endswith(b"\n") else []
        return table_from_columns(position, columns, source=SOURCE, conventions=said)


class _Cursor:
    """Reads lines and arrays from bytes, and refuses to read past their end."""

    def __init__(self, content: bytes) -> None:
        self.content, self.at, self.is_ascii = content, 0, False
        self.left_out: list[str] = []

    def raw_line(self) -> bytes:
        """The next line, stripped, be it blank."""
        end = self.content.find(b"\n", self.at)
        end = len(self.content) if end < 0 else end
        text, self.at = self.content[self.at : end].strip(), end + 1
        return text

    def line(self) -> str:
        """The next line that is not blank, or an empty string at the end."""
        while self.at < len(self.content):
            if text := self.raw_line():
                return text.decode("ascii", errors="replace")
        return ""

    def skip_metadata(self) -> None:
        """Metadata lasts until a blank line."""
        while self.at < len(self.content) and self.raw_line():
            pass

    def array(self, kind: str, count: int, what: str) -> np.ndarray:
        if kind.lower() not in TYPES:
            raise DataError(f"stores {what} as {kind!r}; known types are {', '.join(TYPES)}")
        if kind.lower() == "bit" and not self.is_ascii:
            return np.unpackbits(self.array("unsigned_char", -(-count // 8), what))[:count]
        dtype = np.dtype(">" + TYPES[kind.lower()])
        if count < 0 or count > len(self.content):
            raise DataError(f"announces {count} numbers of {what}, more than it has room for: it is cut short or damaged")
        if self.is_ascii:
            return numbers(self._tokens(count, what), dtype)
        stop = self.at + count * dtype.itemsize
        if stop > len(self.content):
            raise DataError(f"is cut short: {what} need {stop - self.at} bytes, {len(self.content) - self.at} are left")
        values = np.frombuffer(self.content, dtype, count, self.at)
        self.at = stop
        rest = self.content[stop : stop + 2]
        if count and rest and not rest.startswith((b"\n", b"\r\n")):
            raise DataError(f"has no end of the line after {what}, so that bytes are missing or too many; copy it again")
        return values

    def _tokens(self, count: int, what: str) -> list[bytes]:
        tokens: list[bytes] = []
        while len(tokens) < count:
            if self.at >= len(self.content):
                raise DataError(f"is cut short: {what} need {count} numbers, {len(tokens)} are there; copy it again")
            tokens += self.raw_line().split()
        if len(tokens) > count:
            raise DataError(f"has {len(tokens)} numbers of {what} where {count} are announced, so it is damaged")
        return tokens


def _sections(cursor: _Cursor) -> tuple[np.ndarray, Columns]:
    position: np.ndarray | None = None
    columns: Columns = {}
    count, in_points = 0, False
    while line := cursor.line():
        word, *rest = line.split()
        word = word.upper()
        if word == "DATASET":
            if rest[0].upper() not in DATASETS:
                raise DataError(f"holds a {rest[0]}; only {' and '.join(DATASETS)} are particles")
        elif word == "POINTS":
            if position is not None:
                raise DataError("has POINTS twice, so its data cannot be told apart; write one set of particles a file")
            position = cursor.array(rest[1], 3 * int(rest[0]), "points").reshape(-1, 3)
        elif word in CELLS:
            _skip_cells(cursor, word, int(rest[0]), int(rest[1]))
        elif word == "CELL_TYPES":
            cursor.array("int", int(rest[0]), "cell types")
        elif word in ("POINT_DATA", "CELL_DATA"):
            in_points, count = word == "POINT_DATA", int(rest[0])
            if in_points and position is not None and count != len(position):
                raise DataError(f"has data of {count} points, but {len(position)} points; write it again")
        elif word == "METADATA":
            cursor.skip_metadata()
        else:
            arrays = _attributes(cursor, word, rest, count)
            for name, values in arrays.items() if in_points else ():
                if position is not None and len(values) != len(position):
                    cursor.left_out.append(name)
                else:
                    enter(columns, name, values)
    if position is None:
        raise DataError("holds no POINTS; it is cut short, or not a particle file")
    return position, columns


def _attributes(cursor: _Cursor, word: str, rest: list[str], count: int) -> Columns:
    """The arrays of one attribute section of a point or cell data block."""
    if word == "FIELD":
        arrays: Columns = {}
        for _ in range(int(rest[1])):
            line = cursor.line()
            if line == "METADATA":
                cursor.skip_metadata()
                line = cursor.line()
            name, *shape, kind = line.split()
            columns, rows = map(int, shape)
            if kind.lower() == "string" and cursor.is_ascii:  # one a line
                for _ in range(min(rows * columns, cursor.content.count(b"\n", cursor.at))):
                    cursor.raw_line()
                cursor.left_out.append(name)
                continue
            enter(arrays, name, cursor.array(kind, columns * rows, f"`{name}`").reshape(rows, columns))
        return arrays
    if word == "SCALARS":
        width = int(rest[2]) if len(rest) > 2 else 1
        before = cursor.at
        if not cursor.line().upper().startswith("LOOKUP_TABLE"):
            cursor.at = before
        return {rest[0]: cursor.array(rest[1], width * count, f"`{rest[0]}`").reshape(count, width)}
    if word in WIDTHS:
        return {rest[0]: cursor.array(rest[1], WIDTHS[word] * count, f"`{rest[0]}`").reshape(count, WIDTHS[word])}
    color_type = "float" if cursor.is_ascii else "unsigned_char"
    if word == "COLOR_SCALARS":
        cursor.array(color_type, int(rest[1]) * count, "colours")
    elif word == "LOOKUP_TABLE":
        cursor.array(color_type, 4 * int(rest[1]), "a lookup table")
    elif word == "TEXTURE_COORDINATES":
        cursor.array(rest[2], int(rest[1]) * count, "texture coordinates")
    else:
        raise DataError(f"has a section {word[:40]!r} which is not known; it is damaged, or not a particle file")
    return {}


def _skip_cells(cursor: _Cursor, word: str, first: int, second: int) -> None:
    before = cursor.at
    header = cursor.line().split()
    if header[:1] != ["OFFSETS"]:  # before version 5: one list of counts and indices
        cursor.at = before
        cursor.array("int", second, word)
        return
    cursor.array(header[1], first, f"{word} offsets")
    connectivity = cursor.line().split()
    if connectivity[:1] != ["CONNECTIVITY"]:
        raise DataError(f"has no CONNECTIVITY after the offsets of {word}; it is cut short or damaged")
    cursor.array(connectivity[1], second, f"{word} connectivity")
