r"""Dumps of Phantom, full (`FT:`) and small (`ST:`), in its own format and in HDF5, as phantom2hdf5 makes them.

Flow: file -> records -> header, blocks of arrays -> [phantom: living, sinks] -> ParticleTable of one type, or of the sinks.

A dump is a sequence of Fortran records, of either byte order and any default kinds: the length as int32, the data, the
length again; what is longer than 2 GiB is several of them, with a minus at each first length that another follows and at each
second that another precedes.

| record | holds |
|---|---|
| 1 | 60769, the real number 60878, 60878, a version, 690706: byte order and default kinds follow from it |
| 2 | text: `F` or `S` (full, small), `T` (tagged), the code and its version |
| header | for each of eight kinds of numbers: how many; where there are any, their tags of 16 letters, and their values |
| blocks | how many; for each the number of rows (int64) and of arrays of each kind; then for each array its tag and its values |

The blocks are of the particles, the sinks, and two more with columns of the particles (radiation, magnetic fields). A tag that
comes again, as `massoftype` does in the header, is another number of the same list.

The support is $H = 2 h$ (cubic spline; Phantom's default). Densities and masses are not stored: a particle of type $t$
has the mass `massoftype[t]` and the density $\rho = m (h_{fact} / h)^3$, so its volume is $(h / h_{fact})^3$. Particles
with $h \le 0$ are dead or accreted. Sinks are particles of a type of their own here, `SINKS`, without supports: their `h` is the
radius within which they accrete.
Source: Phantom's documentation, "Phantom dump file format"; Price et al. 2018, PASA 35, e031, equation 4 and sections 2.1.5, 2.8.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError, NoParticlesError, explained
from jaxsph.io.file_units import of_phantom
from jaxsph.io.parsing import Columns, gather_vectors, refuse_leftover, type_number
from jaxsph.io.readers.hdf5_guards import columns_beside, holds, member, members, read_dataset, read_positions
from jaxsph.io.table import ParticleTable, native, scalar_of_width_one

SOURCE, HDF5_SOURCE = "Phantom dump", "Phantom HDF5"
GAS = 1
SINKS = -1  # the number by which sinks are asked for: no type of Phantom's has it
TYPE_NUMBERS = {"gas": GAS, "boundary": 3, "stars": 4, "dm": 5, "bulge": 6, "dust": 7, "sinks": SINKS}
SUPPORT_OVER_H = 2.0
KINDS_BY_LENGTH = {20: (4, 4), 24: (4, 8), 36: (8, 4), 40: (8, 8)}
"""Bytes of default integers and reals by the length of the first record: four integers and a real."""
TAG_BYTES = 16
OF_PARTICLES, OF_SINKS = 0, 1  # places of blocks
Block = tuple[int, Columns]  # rows, and arrays of so many by tag


def read(path: Path, *, part_type: int | str | None = None) -> ParticleTable:
    """Read the living particles of one type (1 is gas), or the sinks (-1); by default gas, or the lowest other type there is."""
    with explained(path, SOURCE):
        content = np.fromfile(path, dtype=np.uint8)
        dtypes = _dtypes(content[:44].tobytes())
        if dtypes is None:
            raise DataError("does not begin with the record of numbers by which dumps of Phantom are known; it is another format")
        records = Records(content, dtypes)
        records.next("kinds of numbers")
        written_by = records.next("the name of the code").tobytes().decode("ascii", "replace").strip()
        if written_by[1:2] != "T":
            raise DataError(f"is a dump without tags, by {written_by[:40]!r}; write it again with a newer Phantom")
        header = _header(records)
        blocks = _blocks(records, header)
        refuse_leftover(len(content) - records.at, "its arrays")
        num_sinks, of_sinks = blocks[OF_SINKS] if len(blocks) > OF_SINKS and "x" in blocks[OF_SINKS][1] else (0, {})
        part_type = type_number(part_type, TYPE_NUMBERS)
        if part_type == SINKS:
            return _sinks(SOURCE, header, *(_vectors(of_sinks) if num_sinks else (np.zeros((0, 3)), {})))
        rows, arrays = blocks[OF_PARTICLES]
        for count, others in blocks[OF_SINKS + 1 :]:
            arrays = (others if count == rows else {}) | arrays
        _require({"h": arrays})
        position, columns = _vectors(arrays)
        h, kind = native(arrays["h"]).astype(np.float64), _kinds(header, arrays, rows)
        return _living(SOURCE, header, position, columns, h, kind, part_type, num_sinks)


def from_hdf5(file: Any, part_type: int | str | None) -> ParticleTable:
    """The living particles of one type (`itype`; 1 is gas), or the sinks (-1), of an open `h5py.File`; else as `read`."""
    group = file["particles"]
    header = members(file["header"])
    sinks = file.get("sinks", {})
    shape = getattr(sinks["xyz"], "shape", None) if "xyz" in sinks else None
    num_sinks = int(shape[0]) if shape else 0
    part_type = type_number(part_type, TYPE_NUMBERS)
    if part_type == SINKS:
        position = read_positions(sinks["xyz"]) if num_sinks else np.zeros((0, 3))
        return _sinks(HDF5_SOURCE, header, position, *(columns_beside("xyz", sinks, num_sinks) if num_sinks else ({}, [])))
    _require({"hfact": header, "massoftype": header, "h": group})
    header |= {name: read_dataset(header[name]) for name in ("hfact", "massoftype")}
    position, h = read_positions(group["xyz"]), scalar_of_width_one(read_dataset(member(group, "h"))).astype(np.float64)
    count = len(position)
    kind = np.full(count, GAS)
    if holds(group, "itype"):
        kind = np.abs(scalar_of_width_one(read_dataset(member(group, "itype"))).astype(np.int64))
    for name, values in (("h", h), ("itype", kind)):
        if values.shape != (count,):
            raise DataError(f"has {count} positions, but `{name}` has the shape {values.shape}; dump it again")
    columns, said = columns_beside("xyz", group, count, ("h", "itype", "aprlevel"))
    return _living(HDF5_SOURCE, header, position, columns, h, kind, part_type, num_sinks, said)


def _require(holders: Mapping[str, Any]) -> None:
    """Refuse a dump without what supports and volumes follow from."""
    for name, holder in holders.items():
        if name not in holder:
            raise DataError(f"has no `{name}`, so supports and masses are unknown; dump it again")


def _living(
    source: str,
    header: Mapping[str, Any],
    position: np.ndarray,
    columns: Columns,
    h: np.ndarray,
    kind: np.ndarray,
    part_type: int | None,
    num_sinks: int,
    left_out: Sequence[str] = (),
) -> ParticleTable:
    """The living particles of one type; without `part_type` gas, or the lowest other type there is.

    `header` has numbers by tag, as arrays or data sets. Positions and columns are of all particles but sinks, `kind` is from 1.
    """
    _require({"hfact": header, "massoftype": header})
    unknown = np.isnan(h)  # only `h <= 0` marks the dead; what is no number was damaged, or written so by a run that failed
    if unknown.any():
        wrong = f"smoothing lengths `h` must be numbers, but {int(unknown.sum())} of {len(h)} are NaN,"
        raise DataError(f"{wrong} the first at index {int(np.argmax(unknown))}; remove these particles, or dump it again")
    said, alive = [*left_out], h > 0
    if not alive.all():
        said.append(f"dropped {int((~alive).sum())} dead or accreted particles (h <= 0)")
    part_type = _choose(np.unique(kind[alive]), part_type, num_sinks)
    keep = alive & (kind == part_type)
    if others := int((alive & ~keep).sum()):
        said.append(f"particles of itype {part_type}; left out {others} of other types")
    masses, factors = np.ravel(header["massoftype"]), np.ravel(header["hfact"])
    if not 1 <= part_type <= len(masses):
        raise DataError(f"has no mass for particles of type {part_type}; there are {len(masses)} types")
    if len(factors) != 1:
        raise DataError(f"has {len(factors)} values of `hfact`, and must have one; dump it again")
    hfact = float(factors[0])
    if not 0 < hfact < np.inf:
        raise DataError(f"has `hfact` {hfact:g} in its header, which must be positive: volumes follow from it; dump it again")
    columns, h = {name: column[keep] for name, column in columns.items()}, h[keep]
    mass, refined = np.full(len(h), float(masses[part_type - 1])), columns.get("apr_level")
    if refined is not None:  # adaptive particle refinement: each level halves the mass
        mass *= 0.5 ** (refined.astype(np.float64) - 1)
        said.append("mass = massoftype / 2^(apr_level - 1) (Phantom's refinement of particles)")
    columns |= {"mass": mass, "density": mass * (hfact / h) ** 3}
    said += [
        "support = 2 x smoothing length h (Phantom convention)",
        "kernel = cubic_spline (Phantom's unless it is compiled with another, which a dump does not say)",
        f"density = mass (hfact / h)^3 and volume = (h / hfact)^3, hfact = {hfact:g} (Phantom convention)",
    ]
    if num_sinks:
        said.append(f"{num_sinks} sink particles are left out: they are part_type {SINKS}")
    more = _of_header(header, columns) | {"part_type": part_type, "source": source, "kernel": "cubic_spline"}
    volume = (h / hfact) ** 3
    return ParticleTable(position[keep], columns, SUPPORT_OVER_H * h, volume, conventions=tuple(said), **more)


def _sinks(
    source: str, header: Mapping[str, Any], position: np.ndarray, columns: Columns, left_out: Sequence[str] = ()
) -> ParticleTable:
    """The sinks of a dump, `m` among their columns; those of negative mass were merged with another and are left out."""
    if not len(position):
        raise NoParticlesError(f"has no sink particles (type {SINKS})")
    columns = {"mass" if name == "m" else name: column for name, column in columns.items()}
    said = ["sink particles; h is their accretion radius, and no support", *left_out]
    if "mass" in columns:
        there = ~(columns["mass"] < 0)
        if not there.all():
            said.append(f"dropped {int((~there).sum())} sinks that were merged with others (mass < 0)")
        position, columns = position[there], {name: column[there] for name, column in columns.items()}
    more = _of_header(header, columns) | {"part_type": SINKS, "source": source, "conventions": tuple(said)}
    return ParticleTable(position, columns, **more)


def _of_header(header: Mapping[str, Any], columns: Mapping[str, Any]) -> dict[str, Any]:
    units = of_phantom(header, columns)
    return {"units": units, "time": units.time}


def _choose(kinds: np.ndarray, part_type: int | None, sinks: int) -> int:
    if part_type is None:
        return GAS if GAS in kinds or not len(kinds) else int(kinds[0])
    if len(kinds) and part_type not in kinds:
        there = [*map(str, kinds), *([f"{SINKS} (sinks)"] if sinks else [])]
        raise NoParticlesError(f"has no particles of type {part_type}; `part_type` can be {', '.join(there)}")
    return part_type


class Records:
    """The records of a dump, one after the other, and the dtypes of its eight kinds of numbers."""

    def __init__(self, content: np.ndarray, dtypes: tuple[np.dtype, ...]):
        self.content, self.dtypes, self.order, self.at = content, dtypes, dtypes[0].str[0], 0

    def next(self, what: str, length: int | None = None) -> np.ndarray:
        """The bytes of the next record."""
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
            wrong = f"{what} take {length} bytes, and the record at byte {begin} has {len(found)}"
            raise DataError(f"is damaged: {wrong}; copy it again")
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


def looks_like(start: bytes) -> bool:
    """Whether a file that begins with `start` begins with the first record of a dump."""
    return _dtypes(start) is not None


def _dtypes(start: bytes) -> tuple[np.dtype, ...] | None:
    """The dtypes of default integers, four other kinds, default reals and two other kinds; None of another format."""
    for order in "<>":
        length = int(np.frombuffer(start[:4], f"{order}i4")[0]) if len(start) >= 4 else 0
        if length in KINDS_BY_LENGTH and len(start) >= 4 + length:
            integer, real = KINDS_BY_LENGTH[length]
            whole, fraction = np.dtype(f"{order}i{integer}"), np.dtype(f"{order}f{real}")
            kinds = [("i1", whole), ("r", fraction), ("i2", whole), ("v", whole), ("i3", whole)]
            found = np.frombuffer(start[4 : 4 + length], kinds)
            if found["i1"] == 60769 and found["r"] == 60878 and found["i2"] == 60878 and found["i3"] == 690706:
                others = (np.dtype(f"{order}{kind}") for kind in ("i1", "i2", "i4", "i8"))
                return whole, *others, fraction, np.dtype(f"{order}f4"), np.dtype(f"{order}f8")
    return None


def _header(records: Records) -> Columns:
    """Numbers by tag: one, or the list of those with the same tag; of two kinds the first counts, as for Phantom."""
    header: Columns = {}
    for dtype in records.dtypes:
        number = records.count("values of the header")
        if number:
            tags = records.next("tags of the header", TAG_BYTES * number).reshape(number, TAG_BYTES)
            values = records.next("values of the header", dtype.itemsize * number).view(dtype)
            found: dict[str, list] = {}
            for row, value in zip(tags, values, strict=True):
                found.setdefault(_tag(row), []).append(value)
            header = {tag: np.squeeze(np.asarray(each)) for tag, each in found.items()} | header
    return header


def _blocks(records: Records, header: Columns) -> list[Block]:
    """The blocks; those of several processes, which follow each other, are joined."""
    processes = int(np.ravel(header.get("nblocks", 1))[0])
    number = records.count("blocks of arrays")
    if not 1 <= processes <= number or number % processes:
        raise DataError(f"is damaged: it announces {number} blocks of arrays of {processes} processes; copy it again")
    pieces = [_blocks_of_process(records, number // processes) for _ in range(processes)]
    if processes == 1:
        return pieces[0]
    joined = []
    for each in zip(*pieces, strict=True):
        names = each[0][1].keys()
        if any(arrays.keys() != names for _, arrays in each):
            raise DataError("is damaged: its processes wrote other arrays than each other; dump it again")
        whole = {name: np.concatenate([arrays[name] for _, arrays in each]) for name in names}
        joined.append((sum(rows for rows, _ in each), whole))
    return joined


def _blocks_of_process(records: Records, number: int) -> list[Block]:
    announced = []
    for _ in range(number):
        found = records.next("numbers of rows and arrays")
        size, left = divmod(len(found) - 8, len(records.dtypes))
        if size not in (4, 8) or left:
            raise DataError(f"is damaged: the numbers of rows and arrays of a block take {len(found)} bytes; copy it again")
        rows, arrays = int(found[:8].view(f"{records.order}i8")[0]), found[8:].view(f"{records.order}i{size}").tolist()
        if rows < 0 or min(arrays) < 0:
            raise DataError(f"is damaged: it announces a block of {rows} rows and {arrays} arrays; copy it again")
        announced.append((rows, arrays))
    return [(rows, _arrays(records, rows, arrays)) for rows, arrays in announced]


def _arrays(records: Records, rows: int, numbers: list[int]) -> Columns:
    found: Columns = {}
    for dtype, number in zip(records.dtypes, numbers, strict=True):
        for _ in range(number):
            tag = name = _tag(records.next("the tag of an array", TAG_BYTES))
            again = 1
            while name in found:
                again += 1
                name = f"{tag}_{again}"
            found[name] = records.next(f"array `{name}`", dtype.itemsize * rows).view(dtype)
    return found


def _kinds(header: Columns, arrays: Columns, rows: int) -> np.ndarray:
    """Types as stored; else as many of each type, one behind the other, as the header says, where that is all of them."""
    if "itype" in arrays:
        return np.abs(native(arrays["itype"]).astype(np.int64))
    numbers = [int(number) for number in np.ravel(header.get("npartoftype", 0))]
    if min(numbers) < 0 or sum(numbers) != rows:
        return np.full(rows, GAS)
    return np.repeat(np.arange(GAS, GAS + len(numbers)), numbers)


def _vectors(arrays: Columns) -> tuple[np.ndarray, Columns]:
    """Positions, and columns with the names that they have in Phantom's HDF5: `vx vy vz` is `vxyz`."""
    position, columns = gather_vectors({name: native(array) for name, array in arrays.items()})
    return position, {f"{name}xyz" if f"{name}x" in arrays else name: column for name, column in columns.items()}


def _tag(letters: np.ndarray) -> str:
    return letters.tobytes().decode("ascii", "replace").strip()
