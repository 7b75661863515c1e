"""PLY point sets, ASCII and binary of both byte orders: the `vertex` element; others, as faces, are skipped by their sizes.

Source: G. Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import functools
import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.damage import UNENDED_NOTE, DataError, explained
from jaxsph.io.parsing import gather_vectors, refuse_leftover, refuse_missing
from jaxsph.io.table import ParticleTable, table_from_columns

SOURCE = "PLY"
VERTEX = "vertex"
INDICES = "vertex_indices", "vertex_index"
Element = tuple[str, int, list[list[str]]]
"""Name, rows, and the words of each property, as `float x` or `list uchar int vertex_indices`."""
TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
END_OF_HEADER = re.compile(rb"\nend_header[ \t]*\r?\n")  # a line of its own: a comment may hold the word, too


def read(path: Path) -> ParticleTable:
    """Read the vertices; `nx ny nz` and other triples become vector columns, the rest scalar columns."""
    with explained(path, SOURCE):
        content = path.read_bytes()
        encoding, elements, start = _header(content)
        place = [name for name, *_ in elements].index(VERTEX)
        (_, count, properties), order = elements[place], BYTE_ORDERS[encoding]
        record = np.dtype([(name, order + TYPES[kind]) for kind, name in properties])
        if encoding == "ascii":
            points = _ascii_points(content[start:], elements, place, record)
        else:
            ends = list(itertools.accumulate(elements, functools.partial(_end, content, order, count), initial=start))
            refuse_leftover(len(content) - ends[-1], f"{count} vertices")
            points = np.frombuffer(content, record, count, ends[place])
        position, columns = gather_vectors({name: np.ascontiguousarray(points[name]) for name in record.names or ()})
        said = [UNENDED_NOTE] if encoding == "ascii" and not content.endswith(b"\n") else []
        return table_from_columns(position, columns, source=SOURCE, conventions=said)


def _end(content: bytes, order: str, vertices: int, at: int, element: Element) -> int:
    """Where an element ends that begins at a byte; rows whose lists are as long as in the first of them are taken at once.

    Lists that begin at a wrong byte may end at the right one: so faces are of vertices that there are.
    """
    called, count, properties = element
    left = count if properties else 0
    run = 1 if any(kind == "list" for kind, *_ in properties) else left
    while left:
        fields: list[Any] = []
        lengths: dict[str, int] = {}
        for number, (kind, *words) in enumerate(properties):
            fields.append((f"{number}", order + TYPES[words[0] if kind == "list" else kind]))
            if kind == "list":
                lengths[f"{number}"] = length = int(np.frombuffer(content, fields, 1, at)[f"{number}"][0])
                fields.append((f"of {number}", order + TYPES[words[1]], (length,)))
        row = np.dtype(fields)
        rows = np.frombuffer(content, row, min(left, run, (len(content) - at) // row.itemsize), at)
        if not len(rows):
            refuse_missing(count, count - left, "vertices" if called == VERTEX else f"rows of {called}")
        other = np.any([rows[name] != length for name, length in lengths.items()], axis=0) if lengths else np.zeros(1, bool)
        taken = int(other.argmax()) if other.any() else len(rows)
        for name in lengths if called == "face" else ():
            corners = rows[f"of {name}"][:taken]
            if properties[int(name)][-1] in INDICES and ((corners < 0) | (corners >= vertices)).any():
                raise DataError(f"has faces of other than its {vertices} vertices, so its data is shifted; copy it again")
        at, left, run = at + taken * row.itemsize, left - taken, 2 * run if taken == run else 1
    return at


def _ascii_points(content: bytes, elements: list[Element], place: int, record: np.dtype) -> np.ndarray:
    """The lines of an element that are not blank, each number read as its own type: an id has more digits than float64."""
    filled = [row for row in content.split(b"\n") if row.strip()]
    counts = [rows if properties else 0 for _, rows, properties in elements]
    before, count, lines = sum(counts[:place]), counts[place], sum(counts)
    rows = filled[before : before + count]
    refuse_missing(count, len(rows), "vertices")
    refuse_missing(lines, len(filled), "lines behind the header")
    refuse_leftover(len(filled) - lines, f"{count} vertices", "lines")
    if not rows:
        return np.zeros(0, record)
    width, num_properties = len(rows[0].split()), len(record.names or ())
    if width != num_properties:
        raise DataError(f"has {width} numbers a vertex, but {num_properties} properties are announced; write it again")
    kinds = {name: record[name] for name in record.names or ()}
    wide = np.dtype([(name, kind if kind.kind == "f" else f"{kind.kind}8") for name, kind in kinds.items()])
    points = np.loadtxt([row.decode("ascii") for row in rows], dtype=wide, ndmin=1, comments=None)
    for name in record.names or ():  # NumPy before 2.3 wraps what a narrow type cannot hold
        kept = points[name].astype(record[name])
        if record[name].kind != "f" and (kept != points[name]).any():
            value = points[name][kept != points[name]][0]
            raise DataError(f"has {value} as {name!r}, which its type {record[name]} cannot hold; write it as a wider one")
    return points.astype(record)


def _header(content: bytes) -> tuple[str, list[Element], int]:
    """Encoding, elements in their order, and the offset of the first."""
    if not content.startswith(b"ply"):
        raise DataError("does not begin with `ply`, so it is no PLY file")
    end = END_OF_HEADER.search(content)
    if end is None:
        raise DataError("is cut short: its header does not end; copy it again")
    lines = [line.split() for line in content[: end.start()].decode("ascii", errors="replace").splitlines()]
    formats = [words[1] for words in lines if words[:1] == ["format"]]
    if not formats or formats[0] not in BYTE_ORDERS:
        raise DataError(f"has the PLY format {formats}, expected one of {', '.join(BYTE_ORDERS)}")
    elements: list[Element] = []
    for words in lines:
        if words[:1] == ["element"]:
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[1:])
    vertices = [properties for name, _, properties in elements if name == VERTEX]
    if len(vertices) != 1 or min(rows for _, rows, _ in elements) < 0:
        told = ", ".join(f"{rows} {name}" for name, rows, _ in elements) or "nothing"
        raise DataError(f"announces {told}, and must have one element `{VERTEX}` of particles; write it again")
    kinds = [words[0] for words in vertices[0]]
    if any(kind not in TYPES for kind in kinds):
        raise DataError("has vertex properties that are lists or of unknown type; save the vertices without them")
    if not kinds:
        raise DataError("has vertices without properties, so there are no positions; write it again with x, y and z")
    return formats[0], elements, end.end()
