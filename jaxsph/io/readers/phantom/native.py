"""Dumps in Phantom's own format, full (`FT:`) and small (`ST:`), of either byte order and any default kinds.

Flow: file -> records -> header, blocks of arrays -> [native] -> Dump -> ParticleTable.

A dump is a sequence of Fortran records: the length of the data as int32, the data, the length again; what is longer than 2 GiB is
several of them, with a minus at each first length that another follows and at each second that another precedes.

| record | holds |
|---|---|
| 1 | 60769, the real number 60878, 60878, a version, 690706: byte order and default kinds follow from it |
| 2 | text: `F` or `S` (full, small), `T` (tagged), the code and its version |
| header | for each of eight kinds of numbers: how many; where there are any, their tags of 16 letters, and their values |
| blocks | how many; for each the number of rows (int64) and of arrays of each kind; then for each array its tag and its values |

The blocks are of the particles, the sinks, and two more with columns of the particles (radiation, magnetic fields). A tag that
comes again, as `massoftype` does in the header, is another number of the same list.
Source: Phantom's documentation, "Phantom dump file format"; Price et al. 2018, PASA 35, e031.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsph.io.damage import DataError, explained
from jaxsph.io.parsing import gather_vectors, refuse_leftover
from jaxsph.io.readers.phantom.dumps import GAS, SINKS, Dump, refuse_no_sinks, sinks_table
from jaxsph.io.table import ParticleTable, native

SOURCE = "Phantom dump"
KINDS_BY_LENGTH = {20: (4, 4), 24: (4, 8), 36: (8, 4), 40: (8, 8)}
"""Bytes of default integers and reals by the length of the first record: four integers and a real."""
TAG_BYTES = 16
OF_PARTICLES, OF_SINKS = 0, 1  # places of blocks


class Layout(NamedTuple):
    """How numbers lie in a dump: byte order, and the dtypes of its eight kinds."""

    order: str
    dtypes: tuple[np.dtype, ...]


class Block(NamedTuple):
    """Arrays of one length by tag."""

    rows: int
    arrays: dict[str, np.ndarray]


class Records:
    """The records of a dump, one after the other."""

    def __init__(self, content: np.ndarray, order: str):
        self.content, self.order, self.at = content, order, 0

    def next(self, what: str, length: int | None = None) -> np.ndarray:
        """The bytes of the next record.

        Raises `ValueError`: cut short, two lengths that differ, or another length than the one asked for.
        """
        begin, more = self.at, True
        parts: list[np.ndarray] = []
        while more:
            head = self._length_at(self.at, what)
            stop = self.at + 4 + abs(head)
            tail = self._length_at(stop, what)
            if tail != (-abs(head) if parts else abs(head)):
                wrong = f"is damaged: the record of {what} at byte {self.at} begins with length {head} and ends with {tail};"
                raise DataError(f"{wrong} copy it again")
            parts.append(self.content[self.at + 4 : stop])
            self.at, more = stop + 4, head < 0
        found = parts[0] if len(parts) == 1 else np.concatenate(parts)
        if length is not None and len(found) != length:
            raise DataError(
                f"is damaged: {what} take {length} bytes, and the record at byte {begin} has {len(found)}; copy it again"
            )
        return found

    def count(self, what: str) -> int:
        """The next record as one integer that counts something."""
        found = self.next(what)
        if len(found) not in (4, 8):
            raise DataError(f"is damaged: the number of {what} takes 4 or 8 bytes, not {len(found)}; copy it again")
        number = int(found.view(f"{self.order}i{len(found)}")[0])
        if number < 0:
            raise DataError(f"is damaged: it announces {number} {what}; copy it again")
        return number

    def _length_at(self, at: int, what: str) -> int:
        if at + 4 > len(self.content):
            raise DataError(f"is cut short: the record of {what} at byte {self.at} is not complete; copy it again")
        return int(self.content[at : at + 4].view(f"{self.order}i4")[0])


def read(path: Path, *, part_type: int | None = None) -> ParticleTable:
    """Read the living particles of one type (1 is gas), or the sinks (-1); by default gas, or the lowest other type there is.

    Raises `ValueError`: damaged, cut short, without tags, without `h`, `hfact` or `massoftype`, or no such type.
    """
    with explained(path, SOURCE):
        content = np.fromfile(path, dtype=np.uint8)
        layout = _layout(content[:44].tobytes())
        if layout is None:
            raise DataError("does not begin with the record of numbers by which dumps of Phantom are known; it is another format")
        records = Records(content, layout.order)
        records.next("kinds of numbers")
        written_by = records.next("the name of the code").tobytes().decode("ascii", "replace").strip()
        if written_by[1:2] != "T":
            raise DataError(f"is a dump without tags, by {written_by[:40]!r}; write it again with a newer Phantom")
        header = _header(records, layout)
        blocks = _blocks(records, layout, header)
        refuse_leftover(len(content) - records.at, "its arrays")
        sinks = blocks[OF_SINKS] if len(blocks) > OF_SINKS and "x" in blocks[OF_SINKS].arrays else Block(0, {})
        if part_type == SINKS:
            refuse_no_sinks(sinks.rows)
            return sinks_table(SOURCE, header, *_vectors(sinks.arrays))
        return _dump(header, blocks, sinks.rows).table(part_type)


def looks_like(start: bytes) -> bool:
    """Whether a file that begins with `start` begins with the first record of a dump."""
    return _layout(start) is not None


def _layout(start: bytes) -> Layout | None:
    for order in "<>":
        length = int(np.frombuffer(start[:4], f"{order}i4")[0]) if len(start) >= 4 else 0
        if length in KINDS_BY_LENGTH and len(start) >= 4 + length:
            integer, real = KINDS_BY_LENGTH[length]
            whole, fraction = np.dtype(f"{order}i{integer}"), np.dtype(f"{order}f{real}")
            found = np.frombuffer(
                start[4 : 4 + length], [("i1", whole), ("r", fraction), ("i2", whole), ("v", whole), ("i3", whole)]
            )
            if found["i1"] == 60769 and found["r"] == 60878 and found["i2"] == 60878 and found["i3"] == 690706:
                others = (np.dtype(f"{order}{kind}") for kind in ("i1", "i2", "i4", "i8"))
                return Layout(order, (whole, *others, fraction, np.dtype(f"{order}f4"), np.dtype(f"{order}f8")))
    return None


def _header(records: Records, layout: Layout) -> dict[str, np.ndarray]:
    """Numbers by tag: one, or the list of those with the same tag; of two kinds the first counts, as for Phantom."""
    header: dict[str, np.ndarray] = {}
    for dtype in layout.dtypes:
        number = records.count("values of the header")
        if number:
            tags = records.next("tags of the header", TAG_BYTES * number).reshape(number, TAG_BYTES)
            values = records.next("values of the header", dtype.itemsize * number).view(dtype)
            found: dict[str, list] = {}
            for row, value in zip(tags, values, strict=True):
                found.setdefault(_tag(row), []).append(value)
            header = {tag: np.squeeze(np.asarray(each)) for tag, each in found.items()} | header
    return header


def _blocks(records: Records, layout: Layout, header: dict[str, np.ndarray]) -> list[Block]:
    """The blocks; those of several processes, which follow each other, are joined."""
    processes = int(np.ravel(header.get("nblocks", 1))[0])
    number = records.count("blocks of arrays")
    if not 1 <= processes <= number or number % processes:
        raise DataError(f"is damaged: it announces {number} blocks of arrays of {processes} processes; copy it again")
    pieces = [_blocks_of_process(records, layout, number // processes) for _ in range(processes)]
    if processes == 1:
        return pieces[0]
    joined = []
    for each in zip(*pieces, strict=True):
        names = each[0].arrays.keys()
        if any(block.arrays.keys() != names for block in each):
            raise DataError("is damaged: its processes wrote other arrays than each other; dump it again")
        arrays = {name: np.concatenate([block.arrays[name] for block in each]) for name in names}
        joined.append(Block(sum(block.rows for block in each), arrays))
    return joined


def _blocks_of_process(records: Records, layout: Layout, number: int) -> list[Block]:
    announced = []
    for _ in range(number):
        found = records.next("numbers of rows and arrays")
        size, left = divmod(len(found) - 8, len(layout.dtypes))
        if size not in (4, 8) or left:
            raise DataError(f"is damaged: the numbers of rows and arrays of a block take {len(found)} bytes; copy it again")
        rows, arrays = int(found[:8].view(f"{layout.order}i8")[0]), found[8:].view(f"{layout.order}i{size}").tolist()
        if rows < 0 or min(arrays) < 0:
            raise DataError(f"is damaged: it announces a block of {rows} rows and {arrays} arrays; copy it again")
        announced.append((rows, arrays))
    return [Block(rows, _arrays(records, layout, rows, arrays)) for rows, arrays in announced]


def _arrays(records: Records, layout: Layout, rows: int, numbers: list[int]) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for dtype, number in zip(layout.dtypes, numbers, strict=True):
        for _ in range(number):
            tag = name = _tag(records.next("the tag of an array", TAG_BYTES))
            again = 1
            while name in found:
                again += 1
                name = f"{tag}_{again}"
            found[name] = records.next(f"array `{name}`", dtype.itemsize * rows).view(dtype)
    return found


def _dump(header: dict[str, np.ndarray], blocks: list[Block], sinks: int) -> Dump:
    rows, arrays = blocks[OF_PARTICLES]
    for block in blocks[OF_SINKS + 1 :]:
        arrays = {name: array for name, array in block.arrays.items() if block.rows == rows} | arrays
    for name, holder in (("hfact", header), ("massoftype", header), ("h", arrays)):
        if name not in holder:
            raise DataError(f"has no `{name}`, so supports and masses are unknown; dump it again")
    if header["hfact"].ndim:
        raise DataError(f"has {header['hfact'].size} values of `hfact`, and must have one; dump it again")
    position, columns = _vectors(arrays)
    h, kind = native(arrays["h"]).astype(np.float64), _kinds(header, arrays, rows)
    return Dump(SOURCE, header, position, columns, h, kind, float(header["hfact"]), np.ravel(header["massoftype"]), sinks)


def _kinds(header: dict[str, np.ndarray], arrays: dict[str, np.ndarray], rows: int) -> np.ndarray:
    """Types as stored; else as many of each type, one behind the other, as the header says, where that is all of them."""
    if "itype" in arrays:
        return np.abs(native(arrays["itype"]).astype(np.int64))
    numbers = [int(number) for number in np.ravel(header.get("npartoftype", 0))]
    if min(numbers) < 0 or sum(numbers) != rows:
        return np.full(rows, GAS)
    return np.repeat(np.arange(GAS, GAS + len(numbers)), numbers)


def _vectors(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Positions, and columns with the names that they have in Phantom's HDF5: `vx vy vz` is `vxyz`."""
    position, columns = gather_vectors({name: native(array) for name, array in arrays.items()})
    return position, {f"{name}xyz" if f"{name}x" in arrays else name: column for name, column in columns.items()}


def _tag(letters: np.ndarray) -> str:
    return letters.tobytes().decode("ascii", "replace").strip()
