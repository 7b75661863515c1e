"""Houdini classic geometry (`.bgeo`, version 5, as Partio and SPlisHSPlasH write it): big-endian, often gzipped.

Layout: `Bgeo` `V`, nine int32 (version, points, primitives, point groups, primitive groups, attributes of points,
vertices, primitives, detail); for each point attribute its name (int16 length), int16 width, int32 type and defaults;
then for each point x y z w and its attributes, 4 bytes an entry. Primitives and what follows are not read.
Source: the Houdini 11 GEO/BGEO format, as implemented by Disney's Partio.
"""

from __future__ import annotations

import gzip
import math
import struct
from pathlib import Path
from typing import IO, cast

import numpy as np

from jaxsph.io.damage import DataError, explained
from jaxsph.io.parsing import count_rest, enter, read_up_to, refuse_leftover, refuse_missing
from jaxsph.io.table import ParticleTable, table_from_columns

SOURCE = "Houdini bgeo"
GZIP_MAGIC = b"\x1f\x8b"
END = b"\x00\xff"  # what follows where there are neither primitives nor groups
MAX_HEADER_BYTES = 2**24  # more than names and strings of any header: what is unpacked before the number of points is known
FLOAT, INTEGER, STRING, MIXED, INDEX, VECTOR = range(6)
SMALLEST_NORMAL = np.finfo(np.float32).smallest_normal


def read(path: Path) -> ParticleTable:
    """Read positions and point attributes; weights `w` are ignored, string indices stay integers."""
    with explained(path, SOURCE), _opened(path) as stream:
        begin = bytes(read_up_to(stream, MAX_HEADER_BYTES))
        count, layout, start, is_alone = _header(begin)
        record = np.dtype(layout)
        stop = start + count * record.itemsize
        content = read_up_to(stream, count * record.itemsize, begin[start:stop])
        refuse_missing(count, len(content) // record.itemsize, "points")
        rest = max(len(begin) - stop, 0) + count_rest(stream, len(END) if is_alone else math.inf)
        if is_alone:
            refuse_leftover(rest - len(END), f"{count} points")
        points = np.frombuffer(content, dtype=record, count=count)
        columns = {name: np.ascontiguousarray(points[name]) for name, *_ in layout[1:]}
        position = np.ascontiguousarray(points["\0position"][:, :3])
        _refuse_overwritten(position, columns)
        return table_from_columns(position.astype(np.float32), columns, source=SOURCE)


def _opened(path: Path) -> IO[bytes]:
    with path.open("rb") as file:
        zipped = file.read(2) == GZIP_MAGIC
    return cast(IO[bytes], gzip.open(path)) if zipped else path.open("rb")


def _header(content: bytes) -> tuple[int, list[tuple[str, str, tuple[int, ...]]], int, bool]:
    """Number of points, record layout (position first), the offset of the first record, and whether nothing else follows."""
    if content[:5] != b"BgeoV":
        wrong = "is not a classic bgeo file (it does not begin with `BgeoV`);"
        raise DataError(f"{wrong} newer Houdini files must be saved as `.bgeo` version 5 (classic)")
    version, count, *others, num_attributes, _, _, num_details = struct.unpack_from(">9i", content, 5)
    if version != 5:
        raise DataError(f"has bgeo version {version}; only version 5 is known: save it as classic bgeo")
    if count < 0 or not 0 <= num_attributes < 2**15:
        raise DataError(f"announces {count} points with {num_attributes} attributes, so its header is damaged")
    at = 5 + 9 * 4
    layout: dict[str, tuple[str, int]] = {"\0position": (">f4", 4)}  # a name no attribute can have
    for _ in range(num_attributes):
        (length,) = struct.unpack_from(">H", content, at)
        name = content[at + 2 : at + 2 + length].decode("utf-8")
        width, kind = struct.unpack_from(">Hi", content, at + 2 + length)
        at = _skip_defaults(content, at + 8 + length, name, width, kind)
        if width == 0 or not name:
            raise DataError(f"has attribute `{name}` of width {width}, so its header is damaged; export it again")
        enter(layout, name, (">f4" if kind in (FLOAT, VECTOR) else ">i4", width), "attribute")
    is_alone = not any(others) and not num_details
    return count, [(name, kind, (width,)) for name, (kind, width) in layout.items()], at, is_alone


def _skip_defaults(content: bytes, at: int, name: str, width: int, kind: int) -> int:
    """Where the next attribute begins: past the defaults, or past the strings that indices are for."""
    if kind in (FLOAT, INTEGER, VECTOR):
        return at + 4 * width
    if kind != INDEX:
        raise DataError(f"has attribute `{name}` of type {kind}, which is not supported; save it without")
    (num_strings,) = struct.unpack_from(">i", content, at)
    at += 4
    if not 0 <= num_strings <= (len(content) - at) // 2:  # a string takes two bytes for its length
        raise DataError(f"has attribute `{name}` with {num_strings} strings, for which its header has no room; export it again")
    for _ in range(num_strings):
        at += 2 + struct.unpack_from(">H", content, at)[0]
    return at


def _refuse_overwritten(position: np.ndarray, columns: dict[str, np.ndarray]) -> None:
    """Refuse positions that hold the bits of integers.

    A simulator that is asked for `id` twice writes the second one over x. Two signs: a coordinate has the same bits
    as an integer attribute in every particle; or most coordinates of an axis are so small (below 1.2e-38, other than
    0) that only integers below 2^23 read as floats look like that.
    """
    if len(position) == 0:
        return
    for axis, coordinate in zip("xyz", position.T, strict=True):
        bits = np.ascontiguousarray(coordinate).view(">i4")
        integers = {name: column for name, column in columns.items() if column.dtype.kind == "i" and bits.any()}
        twin = next((name for name, column in integers.items() if (bits == column.T).all(-1).any()), None)
        subnormal = (coordinate != 0) & (np.abs(coordinate) < SMALLEST_NORMAL)
        if twin is not None or subnormal.mean() > 0.5:
            same = f"the attribute `{twin}`" if twin is not None else "integers"
            wrong = f"its {axis} coordinates were overwritten by {same}, and cannot be recovered (a simulator does so when"
            raise DataError(f"{wrong} an attribute, such as `id`, is requested twice): request it once and export again")
