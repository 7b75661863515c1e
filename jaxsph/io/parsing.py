"""What parsers of several formats share: words to numbers, scalars to vectors, packed data to no more of it than is needed.

Flow: file -> reader, with [parsing] -> ParticleTable or VolumeTable.

A kilobyte may unpack to a megabyte, or say that it does. Bytes behind the data that a header announces say that data or header
are damaged.
"""

from __future__ import annotations

import functools
import lzma
import math
import re
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import IO, Any

import numpy as np

from jaxsph.io.damage import DataError, NoParticlesError
from jaxsph.numerics.names import did_you_mean

TRIPLES = (("x", "y", "z"), ("X", "Y", "Z"), ("0", "1", "2"))
SEPARATORS = " :._-["
POSITION_BASES = ("", "position", "pos", "points", "point", "coordinates", "coords", "coord", "p", "r")
COORDINATES = tuple(base + first for first in "x0" for base in POSITION_BASES if base + first != "0")
"""Names of the first of three columns of positions."""
TYPE_NAMES = {0: "gas", 1: "dark matter", 4: "stars", 5: "black holes"}
"""What codes of the Gadget family agree on; 2 and 3 are disks, bulges, or coarse dark matter."""
LUMINOUS = 2, 4, 3  # of these the first that there is
TYPE_NUMBERS = {"gas": 0, "dm": 1, "halo": 1, "disk": 2, "bulge": 3, "stars": 4, "bh": 5, "sinks": 5}
"""By what a type is called where it is asked for."""
DEFLATE_RATIO = 1032  # the most that a byte of deflate (zlib, gzip, zip) unpacks to: 258 bytes of a match take two bits
LZMA_RATIO = 2**13  # the same of LZMA: zeros, by far the best case, shrink 7000 times
LZMA_MEMORY = 2**27  # bytes that a stream may ask for its dictionary: twice those of the strongest preset
CHUNK_BYTES = 2**18
Columns = dict[str, np.ndarray]  # by name, a row a particle
Decompressor = Callable[[], Any]  # makes what unpacks one stream
INFLATING: Decompressor = zlib.decompressobj
UNLZMA: Decompressor = functools.partial(lzma.LZMADecompressor, memlimit=LZMA_MEMORY)


def numbers(tokens: Sequence[bytes] | Sequence[str], dtype: np.dtype) -> np.ndarray:
    """One number a token, in the native order of `dtype`; integers keep all their digits.

    Each is converted on its own, as an array of words would be as wide as the longest of them.

    Raises `ValueError` for what is no number, as Python's `1_000` is none, and `OverflowError` for what `dtype` cannot hold.
    """
    native, mark = dtype.newbyteorder("="), b"_" if tokens and isinstance(tokens[0], bytes) else "_"
    wrong = next((token for token in tokens if mark in token), None)  # type: ignore[operator]
    if wrong is not None:
        raise DataError(f"has {wrong[:40]!r} where a number should be; it is damaged: copy it again")
    return np.fromiter(map(int if native.kind in "iu" else float, tokens), native, len(tokens))


def gather_vectors(
    fields: Mapping[str, np.ndarray], position: np.ndarray | None = None, others: Iterable[str] = ()
) -> tuple[np.ndarray, Columns]:
    """Positions (N, 3) and the other columns, with `a_x, a_y, a_z` or `a:0, a:1, a:2` joined to the vector `a`.

    Units in brackets (`x [m]`, `rho (kg/m3)`) are cut off names. Where there is a scalar `a` too, the vector is `a_xyz`. Where
    there is no z, nor among the `others` that a file has, vectors of x and y have zeros for it. A known `position` is
    returned as it is.
    """
    columns: Columns = {}
    for full_name, values in fields.items():
        name = full_name.partition(" [")[0].partition(" (")[0].strip()
        if position is not None and (name in columns or name in fields):
            name = full_name
        if name in columns:
            raise DataError(f"has the column `{name}` twice, but for its unit; give them two names")
        columns[name] = values
    positions: Columns = {}
    for name in list(columns):
        for first, second, third in TRIPLES if position is None else TRIPLES[:2]:
            base, bracket = (name[:-2], "]") if name.endswith(f"{first}]") else (name[:-1], "")
            members = [base + suffix + bracket for suffix in (first, second, third)]
            if name == members[0] and all(np.ndim(columns.get(member, 0)) == 1 for member in members):
                if position is not None and is_of_positions(base):
                    break
                vector = np.stack([columns.pop(member) for member in members], axis=1)
                label = base.rstrip(SEPARATORS)
                if label.lower() in positions:
                    raise DataError(f"has positions twice, once more as {', '.join(members)}; leave one of them out")
                if label.lower() in POSITION_BASES:
                    positions[label.lower()] = vector
                else:
                    enter(columns, f"{label}_xyz" if label in columns else label, vector, "vector")
                break
    if position is not None:
        return position, columns
    for base in POSITION_BASES:
        if base in positions:
            position = positions.pop(base)
            return position, {**columns, **positions}
    flat = [name[:-1] for name in fields if name[-1:] == "x" and f"{name[:-1]}y" in fields]
    planes = {f"{base}z": np.zeros_like(fields[f"{base}x"]) for base in flat}
    are_flat = any(map(is_of_positions, flat))
    if are_flat and planes.keys().isdisjoint([*fields, *others]):
        return gather_vectors({**fields, **planes})
    raise DataError(f"holds no positions: there are {', '.join(fields) or 'no columns'}; name three of them x, y and z")


def is_of_positions(base: str) -> bool:
    """Whether coordinates are called so, but for the letter of the axis."""
    return base.rstrip(SEPARATORS).lower() in POSITION_BASES


def enter(columns: dict[str, Any], name: str, values: Any, what: str = "array") -> None:
    """Add a column by a name that none has yet, else `ValueError`."""
    if name in columns:
        raise DataError(f"has the {what} `{name}` twice, so its data cannot be told apart; give each its own name")
    columns[name] = values


def array_header(stream: IO[bytes], objects: bool = False) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Of `.npy`: shape, whether the first index runs fastest, and dtype; the stream stands at the data then.

    Arrays of Python objects are refused, unless `objects` says that they are left out.
    """
    read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(stream)
    if version not in read_header:
        raise DataError(f"holds an array of `.npy` version {version}; write it again with numpy.save or numpy.savez")
    shape, is_fortran, dtype = read_header[version](stream)
    if dtype.hasobject and not objects:
        raise DataError("holds Python objects, which are not loaded; write it as numbers, or leave it out")
    if min(shape, default=0) < 0:
        raise DataError(f"announces an array of shape {shape}, so it is damaged; write it again")
    return shape, is_fortran, dtype


def unpack_blocks(blocks: Iterable[bytes | memoryview], decompressor: Decompressor, need: int, what: str) -> bytes:
    """All blocks unpacked, each a whole stream; unpacking stops where there is more than the `need` bytes of `what`."""
    parts, left = [], need
    for block in blocks:
        stream = decompressor()
        part = stream.decompress(block, left + 1)  # one more than may come: at exactly `left` its end would not be seen
        if len(part) > left:
            raise DataError(f"unpacks to more than the {need} bytes that {what} need, so it is damaged; write it again")
        if not stream.eof:
            raise DataError(f"is cut short inside {what}: a compressed block does not end; copy it again")
        refuse_leftover(len(stream.unused_data), what)
        parts.append(part)
        left -= len(part)
    return b"".join(parts)


def read_up_to(stream: IO[bytes], size: int, begin: bytes = b"") -> bytearray:
    """`begin` and what follows it, `size` bytes or all there are: memory is taken as bytes come, not as announced."""
    content = bytearray(begin)
    while len(content) < size and (part := stream.read(min(size - len(content), CHUNK_BYTES))):
        content += part
    return content


def count_rest(stream: IO[bytes], most: float) -> int:
    """How many bytes follow in a stream, or more than `most`; none is kept. At its end, gzip compares its check sum."""
    left = 0
    while left <= most and (part := stream.read(CHUNK_BYTES)):
        left += len(part)
    return left


def refuse_missing(count: int, available: int, what: str) -> None:
    """Refuse a file that has fewer points than its header says."""
    if available < count:
        raise DataError(f"is cut short: {count} {what} are announced, {available} are there; copy it again")


def refuse_leftover(left: int, what: str, unit: str = "bytes") -> None:
    """Refuse a file that goes on for `left` > 0 `unit` behind `what`, where its header lets nothing follow."""
    if left > 0:
        wrong = f"has {left} more {unit} than {what} and what its header announces: one of them is damaged,"
        raise DataError(f"{wrong} so that what is read may be shifted; copy it again, or write it again from its source")


def type_number(part_type: int | str | None, numbers: Mapping[str, int] = TYPE_NUMBERS) -> int | None:
    """The number of a type that may be asked for by name. Raises `ValueError`: no such name."""
    if not isinstance(part_type, str):
        return part_type
    if re.fullmatch(r"-?\d+", part_type):
        return int(part_type)
    if part_type not in numbers:
        if "," in part_type or ":" in part_type:
            raise DataError(
                f"is read here for one type of particles, without a look, got `part_type` = {part_type!r}; choose one"
            )
        wrong = f"has no type of particles called {part_type!r}; `part_type` is a number or one of {', '.join(numbers)}"
        raise DataError(wrong + did_you_mean(part_type, numbers))
    return numbers[part_type]


def choose_type(present: Sequence[int], part_type: int | str | None, mass: Mapping[int, float] = MappingProxyType({})) -> int:
    """The type of particles that is read: the one asked for, else gas (0) if there is any, else what shines, else the first.

    Disks and bulges (2, 3) shine where one of them has no more `mass` than one of the halo (1): coarse dark matter has more. So
    do stars (4), unless one is known to have more.
    """
    part_type = type_number(part_type)
    if part_type is not None and part_type not in present:
        there = ", ".join(map(str, present)) or "none: it has none at all"
        raise NoParticlesError(f"has no particles of type {part_type}; `part_type` can be {there}")
    if part_type is not None or 0 in present:
        return part_type or 0
    for kind in filter(present.__contains__, LUMINOUS):
        unknown = (0.0, math.inf) if kind == 4 or 1 not in present else (math.inf, 0.0)
        if mass.get(kind, unknown[0]) <= mass.get(1, unknown[1]):
            return kind
    return next(iter(present), 0)


def others_held(counts: Mapping[int, int | None], chosen: int) -> list[str]:
    """A sentence on the other types of particles that a snapshot holds, by number; `None` where it does not say how many."""
    others = []
    for number, count in sorted(counts.items()):
        if number != chosen and count != 0:
            named = f"type {number} ({TYPE_NAMES[number]})" if number in TYPE_NAMES else f"type {number}"
            others.append(named if count is None else f"{count:,} of {named}")
    return [f"also holds {', '.join(others)}: `part_type=` or --part-type reads another"] if others else []
