"""PLY point sets, ASCII and binary of both byte orders: the `vertex` element; faces are not read.

Source: G. Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from jaxsph.io.damage import UNENDED_NOTE, DataError, explained
from jaxsph.io.parsing import gather_vectors, refuse_leftover, refuse_missing
from jaxsph.io.table import ParticleTable, table_from_columns

SOURCE = "PLY"
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
END_OF_HEADER = re.compile(rb"\nend_header[ \t]*\r?\n")
"""A line of its own: a comment may hold the word, too."""


def read(path: Path) -> ParticleTable:
    """Read the vertices; `nx ny nz` and other triples become vector columns, the rest scalar columns.

    Raises:
        ValueError: damaged, cut short, longer than its header says, or other elements first.
    """
    with explained(path, SOURCE):
        content = path.read_bytes()
        encoding, count, record, start, others = _header(content)
        if encoding == "ascii":
            points = _ascii_points(content[start:], count, record, others)
        else:
            refuse_missing(count, (len(content) - start) // record.itemsize, "vertices")
            if not others:
                refuse_leftover(len(content) - start - count * record.itemsize, f"{count} vertices")
            points = np.frombuffer(content, record, count, start)
        position, columns = gather_vectors({name: np.ascontiguousarray(points[name]) for name in record.names or ()})
        said = [UNENDED_NOTE] if encoding == "ascii" and not content.endswith(b"\n") else []
        return table_from_columns(position, columns, source=SOURCE, conventions=said)


def _ascii_points(content: bytes, count: int, record: np.dtype, others: int) -> np.ndarray:
    """The first `count` lines that are not blank, each number read as its own type: an id has more digits than float64."""
    filled = [row for row in content.split(b"\n") if row.strip()]
    rows = filled[:count]
    refuse_missing(count, len(rows), "vertices")
    refuse_leftover(len(filled) - count - others, f"{count} vertices", "lines")
    if not rows:
        return np.zeros(0, record)
    width, num_properties = len(rows[0].split()), len(record.names or ())
    if width != num_properties:
        raise DataError(f"has {width} numbers a vertex, but {num_properties} properties are announced; write it again")
    wide = np.dtype(
        [(name, record[name] if record[name].kind == "f" else f"{record[name].kind}8") for name in record.names or ()]
    )
    points = np.loadtxt([row.decode("ascii") for row in rows], dtype=wide, ndmin=1, comments=None)
    for name in record.names or ():  # NumPy before 2.3 wraps what a narrow type cannot hold
        kept = points[name].astype(record[name])
        if record[name].kind != "f" and (kept != points[name]).any():
            value = points[name][kept != points[name]][0]
            raise DataError(f"has {value} as {name!r}, which its type {record[name]} cannot hold; write it as a wider one")
    return points.astype(record)


def _header(content: bytes) -> tuple[str, int, np.dtype, int, int]:
    """Encoding, number of vertices, the record of one vertex, the offset of the first, and how many other entries follow."""
    if not content.startswith(b"ply"):
        raise DataError("does not begin with `ply`, so it is no PLY file")
    end = END_OF_HEADER.search(content)
    if end is None:
        raise DataError("is cut short: its header does not end; copy it again")
    lines = [line.split() for line in content[: end.start()].decode("ascii", errors="replace").splitlines()]
    formats = [words[1] for words in lines if words[:1] == ["format"]]
    if not formats or formats[0] not in BYTE_ORDERS:
        raise DataError(f"has the PLY format {formats}, expected one of {', '.join(BYTE_ORDERS)}")
    elements = [index for index, words in enumerate(lines) if words[:1] == ["element"]]
    if not elements or lines[elements[0]][1] != "vertex":
        raise DataError("does not have `vertex` as its first element; only points are read: save the vertices alone")
    stop = elements[1] if len(elements) > 1 else len(lines)
    properties = [words[1:] for words in lines[elements[0] : stop] if words[:1] == ["property"]]
    if any(words[0] not in TYPES for words in properties):
        raise DataError("has vertex properties that are lists or of unknown type; save the vertices without them")
    if not properties:
        raise DataError("has vertices without properties, so there are no positions; write it again with x, y and z")
    order = BYTE_ORDERS[formats[0]]
    record = np.dtype([(name, order + TYPES[kind]) for kind, name in properties])
    count = int(lines[elements[0]][2])
    if count < 0:
        raise DataError(f"announces {count} vertices, so its header is damaged")
    others = sum(max(int(lines[index][2]), 0) for index in elements[1:])
    return formats[0], count, record, end.end(), others
