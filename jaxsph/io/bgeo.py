"""Houdini classic geometry (`.bgeo`, version 5, as Partio and SPlisHSPlasH write it): big-endian, often gzipped.

Layout: `Bgeo` `V`, nine int32 (version, points, primitives, point groups, primitive groups, attributes of points,
vertices, primitives, detail); for each point attribute its name (int16 length), int16 width, int32 type and defaults;
then for each point x y z w and its attributes, 4 bytes an entry. Primitives and what follows are not read.
Source: the Houdini 11 GEO/BGEO format, as implemented by Disney's Partio.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np

from .damage import DataError, explained
from .table import ParticleTable, table_from_columns

SOURCE = "Houdini bgeo"
GZIP_MAGIC = b"\x1f\x8b"
FLOAT, INTEGER, STRING, MIXED, INDEX, VECTOR = range(6)
SMALLEST_NORMAL = np.finfo(np.float32).smallest_normal


def read(path: Path) -> ParticleTable:
    """Read positions and point attributes; weights `w` are ignored, string indices stay integers.

    Raises:
        ValueError: damaged or of another version; positions that are integers written over floats.
    """
    with explained(path, SOURCE):
        content = path.read_bytes()
        if content[:2] == GZIP_MAGIC:
            content = gzip.decompress(content)
        count, layout, start = _header(content)
        record = np.dtype(layout)
        available = (len(content) - start) // record.itemsize
        if available < count:
            raise DataError(f"is cut short: {count} points are announced, {available} are there; copy it again")
        points = np.frombuffer(content, dtype=record, count=count, offset=start)
        columns = {name: np.ascontiguousarray(points[name]) for name, *_ in layout[1:]}
        position = np.ascontiguousarray(points["\0position"][:, :3])
        _refuse_overwritten(position, columns)
        return table_from_columns(position.astype(np.float32), columns, source=SOURCE)


def _header(content: bytes) -> tuple[int, list[tuple[str, str, tuple[int, ...]]], int]:
    """Number of points, record layout (position first), and the offset of the first record."""
    if content[:5] != b"BgeoV":
        raise DataError(
            "is not a classic bgeo file (it does not begin with `BgeoV`); newer Houdini files must be saved as "
            "`.bgeo` version 5 (classic)"
        )
    version, count, _, _, _, num_attributes, *_ = struct.unpack_from(">9i", content, 5)
    if version != 5:
        raise DataError(f"has bgeo version {version}; only version 5 is known: save it as classic bgeo")
    if count < 0 or not 0 <= num_attributes < 2**15:
        raise DataError(f"announces {count} points with {num_attributes} attributes, so its header is damaged")
    at = 5 + 9 * 4
    layout: list[tuple[str, str, tuple[int, ...]]] = [("\0position", ">f4", (4,))]  # a name no attribute can have
    for _ in range(num_attributes):
        (length,) = struct.unpack_from(">H", content, at)
        name = content[at + 2 : at + 2 + length].decode("utf-8")
        width, kind = struct.unpack_from(">Hi", content, at + 2 + length)
        at += 8 + length
        if kind in (FLOAT, INTEGER, VECTOR):
            at += 4 * width
        elif kind == INDEX:
            (num_strings,) = struct.unpack_from(">i", content, at)
            at += 4
            for _ in range(num_strings):
                at += 2 + struct.unpack_from(">H", content, at)[0]
        else:
            raise DataError(f"has attribute `{name}` of type {kind}, which is not supported; save it without")
        if name in (known for known, *_ in layout):
            raise DataError(f"has the attribute `{name}` twice, so its data cannot be told apart; export it once")
        if width == 0:
            raise DataError(f"has attribute `{name}` of width 0, so its header is damaged; export it again")
        layout.append((name, ">f4" if kind in (FLOAT, VECTOR) else ">i4", (width,)))
    return count, layout, at


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
            raise DataError(
                f"its {axis} coordinates were overwritten by {same}, and cannot be recovered (a simulator does so when "
                f"an attribute, such as `id`, is requested twice): request it once and export again"
            )
