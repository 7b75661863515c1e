r"""Snapshots of ChaNGa, Gasoline and PKDGRAV, as Tipsy files or as NChilada folders: one kind of particles is read.

A Tipsy file has a header (time, numbers of bodies, dimensions, gas, dark matter, stars), then records of gas, dark matter and
stars, all of four bytes a number but for positions, or positions and velocities, that may have eight, which the size of the file
tells; big-endian as the standard has it, or in the order of the machine that wrote it. Arrays beside
the file, `FILE.smoothlength` and `FILE.den`, may hold smoothing lengths and densities.

An NChilada snapshot is a folder with a folder a kind of particles, and in that a file a column. Every file is big-endian (XDR): a
magic number, time, number of particles in two halves, dimensions and a type code, then least and largest value of each dimension,
then the values.

Types are numbered as in Gadget files: 0 gas, 1 dark matter, 4 stars. The length `hsmooth` of gas records is a softening in some
codes and a smoothing length in others. Lengths are half of the support where a sample of neighbours shows that (`supports`), else
supports are found from neighbours. Units are those of a file of parameters beside the snapshot (`units`). Source: the
documentation of TIPSY, and the field header of the NChilada library, University of Washington N-Body Shop.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Literal

import numpy as np

from jaxsph.io.damage import DataError, explained
from jaxsph.io.file_units import units_beside
from jaxsph.io.parsing import Columns, choose_type, numbers, others_held, refuse_leftover
from jaxsph.io.settle.supports import with_stored_lengths
from jaxsph.io.table import ParticleTable, native

SOURCE, FOLDER_SOURCE = "Tipsy", "NChilada"
KERNEL = "kernel = cubic_spline (ChaNGa's and Gasoline's unless compiled otherwise; the file does not say)"
SMOOTHING = "smoothlength", "smoothing_length", "hsmooth"
Order = Literal["<", ">"]
ORDERS: tuple[Order, Order] = (">", "<")
HEADER = np.dtype([("time", "f8"), ("bodies", "i4"), ("dimensions", "i4"), ("gas", "i4"), ("dark", "i4"), ("stars", "i4")])
PLACE = ("mass", "x", "y", "z", "vx", "vy", "vz")
RECORDS = {
    0: ("gas", (*PLACE, "rho", "temp", "hsmooth", "metals", "phi")),
    1: ("dark", (*PLACE, "eps", "phi")),
    4: ("stars", (*PLACE, "metals", "tform", "eps", "phi")),
}  # number of a type -> its count in the header, and the numbers of a record
ALIKE = 100  # ratio to masses up to which what stands in the padding may be one, of records that bytes too many have shifted
KINDS = ("f4", "f4"), ("f8", "f4"), ("f8", "f8")  # of positions and velocities
NEEDED = *SMOOTHING, "mass", "den", "density", "GasDensity"  # columns whose absence would change supports or volumes
NAMES = "smoothlength", "den"  # suffixes of arrays beside a file that are looked for, and names of their columns
MAX_DIGITS = 64  # bytes of a number as text
FOLDERS = {0: ("gas",), 1: ("dark",), 4: ("star", "stars")}
MAGIC = 1062053
FIELD = np.dtype([("magic", "i4"), ("time", "f8"), ("high", "u4"), ("low", "u4"), ("dimensions", "i4"), ("code", "i4")])
FIELD = FIELD.newbyteorder(">")
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "i8", 8: "u8", 9: "f4", 10: "f8"}
POSITIONS = "pos", "position", "positions", "coordinates"


def looks_like(start: bytes) -> bool:
    """Whether a file that begins with `start` begins with a Tipsy header: three dimensions, and numbers that add up."""
    return _header(start) is not None


def is_snapshot(folder: Path) -> bool:
    """Whether a folder has positions of any kind of particles, as NChilada stores them."""
    return any(_is_field(file) for number in FOLDERS for file in [_positions(folder, number)] if file is not None)


def read(path: Path, *, part_type: int | str | None = None) -> ParticleTable:
    """Read the particles of one type of a file or of a folder: gas if there is any, else the first that there is."""
    source = FOLDER_SOURCE if path.is_dir() else SOURCE
    with explained(path, source):
        chosen, position, columns, said, time = (_of_folder if path.is_dir() else _of_file)(path, part_type)
        units, told = units_beside(path, columns, time)
        more: dict[str, Any] = {"conventions": (*said, *told, KERNEL), "units": units, "time": time, "part_type": chosen}
        table = ParticleTable(position, columns, source=source, kernel="cubic_spline", **more)
        return with_stored_lengths(table, *SMOOTHING)


Found = tuple[int, np.ndarray, Columns, list[str], float]
"""Type, positions and columns of its particles, sentences on them, and the time."""


def _of_file(path: Path, part_type: int | str | None) -> Found:
    with path.open("rb") as file:
        start = _header(file.read(HEADER.itemsize))
        if start is None:
            raise DataError("does not begin with a Tipsy header of three dimensions; it is another format, or damaged")
        order, header = start
        counts = {number: int(header[name]) for number, (name, _) in RECORDS.items()}
        for kinds in KINDS:
            dtypes = {number: _record(fields, order, *kinds) for number, (_, fields) in RECORDS.items()}
            begin = os.path.getsize(path) - sum(counts[number] * dtypes[number].itemsize for number in RECORDS)
            if begin in (HEADER.itemsize, HEADER.itemsize + 4):
                break
        else:
            stated = ", ".join(f"{counts[number]} {name}" for number, (name, _) in RECORDS.items())
            raise DataError(f"is damaged or cut short: its header states {stated}, but its size is another; copy it again")
        padding = file.read(begin - HEADER.itemsize)
        present = [number for number in RECORDS if counts[number]]
        chosen = choose_type(present, part_type)
        file.seek(begin + sum(counts[number] * dtypes[number].itemsize for number in RECORDS if number < chosen))
        values = np.frombuffer(file.read(counts[chosen] * dtypes[chosen].itemsize), dtypes[chosen])
    mass, padded = values["mass"], np.frombuffer(padding, f"{order}f4")
    alike = (mass.min(initial=np.inf) / ALIKE <= padded) & (padded <= mass.max(initial=0) * ALIKE)
    if order == ">" and (alike.any() or not (mass >= 0).all()):  # codes leave what they have there: but is it the first mass?
        refuse_leftover(len(padding.strip(b"\0")), "its header and its records")
    rows = slice(first := sum(counts[number] for number in RECORDS if number < chosen), first + counts[chosen])
    beside, said = arrays_beside(path, sum(counts.values()), counts[0], rows)
    columns = {name: native(values[name]) for name in RECORDS[chosen][1] if name not in PLACE[1:]}
    position, velocity = (native(np.stack([values[name] for name in names], 1)) for names in (PLACE[1:4], PLACE[4:]))
    columns |= {"velocity": velocity, **beside}
    said = [f"particles of type {chosen} ({RECORDS[chosen][0]})", *others_held(counts, chosen), *said]
    return chosen, position, columns, said, float(header["time"])


def _record(fields: tuple[str, ...], order: Order, position: str, velocity: str) -> np.dtype:
    wide = dict.fromkeys(PLACE[1:4], position) | dict.fromkeys(PLACE[4:], velocity)
    return np.dtype([(name, order + wide.get(name, "f4")) for name in fields])


def _of_folder(path: Path, part_type: int | str | None) -> Found:
    held = {n: _count(_field_header(file)) for n in FOLDERS if (file := _positions(path, n)) is not None}
    present = [number for number, count in held.items() if count]
    chosen = choose_type(present, part_type if present else part_type or 0)
    where = _positions(path, chosen)
    assert where is not None
    position, time = _field(where)
    columns, left_out = {}, []
    for file in sorted(where.parent.iterdir()):
        if file != where and _is_field(file):
            try:
                values = _field(file)[0]
                if len(values) != len(position):
                    stated = f"{len(values)} values, but there are {len(position)} positions"
                    raise DataError(f"{where.parent.name}/{file.name} has {stated}; it is damaged or of another snapshot")
                columns[file.name] = values
            except DataError as error:
                if file.name in NEEDED:
                    raise
                left_out.append(f"left out {file.name}: {error}")
    said = [f"particles of type {chosen} ({where.parent.name})", *others_held(held, chosen), *left_out]
    return chosen, position, columns, said, time


def _header(start: bytes) -> tuple[Order, np.void] | None:
    """The header and its byte order, where it has three dimensions and numbers that add up in either."""
    for order in ORDERS if len(start) >= HEADER.itemsize else ():
        header = np.frombuffer(start[: HEADER.itemsize], HEADER.newbyteorder(order))[0]
        counts = [int(header[name]) for name in ("gas", "dark", "stars")]
        if int(header["dimensions"]) == 3 and min(counts) >= 0 and sum(counts) == int(header["bodies"]) > 0:
            return order, header
    return None


def arrays_beside(path: Path, bodies: int, gas: int, rows: slice) -> tuple[Columns, list[str]]:
    """Columns of the particles in `rows`, of so many bodies of which the first are gas; and sentences on what is not used.

    A file has a number for each particle of the snapshot, or for gas alone: as text, their count in the first line and then one
    a line; as bytes, the count in four and then floats of four, in either order of bytes.
    """
    columns, said = {}, []
    for name in NAMES:
        file = path.with_name(f"{path.name}.{name}")
        if not file.is_file():
            continue
        values, trouble = _values(file, {bodies, gas})
        if values is not None and len(values) < rows.stop:
            values, trouble = None, "holds gas alone"
        if values is None:
            said.append(f"{file.name} is not used: it {trouble}")
        else:
            columns[name] = values[rows]
            said.append(f"column `{name}` is of {file.name}")
    return columns, said


def _values(file: Path, counts: set[int]) -> tuple[np.ndarray | None, str]:
    """The numbers of a file of one of these lengths, or what is wrong with it."""
    try:
        size = os.path.getsize(file)
        if size > max(counts) * MAX_DIGITS + MAX_DIGITS:
            return None, f"has {size} bytes, too many for {max(counts)} numbers"
        stored = file.read_bytes()
    except OSError as error:
        return None, f"cannot be read ({error.strerror})"
    for order in (">", "<"):
        count = int(np.frombuffer(stored[:4], f"{order}i4")[0]) if size >= 4 else -1
        if count in counts and size == 4 + 4 * count:
            return np.frombuffer(stored[4:], f"{order}f4").astype(np.float32), ""
    try:
        first, *rest = stored.split()
        values = numbers(rest, np.dtype(np.float64))
        count = int(first)
    except ValueError:
        return None, "is neither text of numbers nor floats of four bytes"
    if count not in counts or len(values) != count:
        return None, f"states {count} numbers and has {len(values)}, but there are {max(counts)} particles"
    return values, ""


def _positions(folder: Path, number: int) -> Path | None:
    """The file of positions of a type, where there is one."""
    files = (folder / name / called for name in FOLDERS[number] for called in POSITIONS)
    return next((file for file in files if file.is_file()), None)


def _is_field(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        start = opened.read(FIELD.itemsize)
    return len(start) == FIELD.itemsize and int(np.frombuffer(start, FIELD)[0]["magic"]) == MAGIC


def _field_header(file: Path) -> np.void:
    if not _is_field(file):
        raise DataError(f"{file.parent.name}/{file.name} does not begin as NChilada's files do; it is damaged")
    return np.fromfile(file, FIELD, 1)[0]  # type: ignore[no-any-return]


def _count(header: np.void) -> int:
    return (int(header["high"]) << 32) + int(header["low"])


def _field(file: Path) -> tuple[np.ndarray, float]:
    """Values of a file, (N,) or (N, dimensions), and its time."""
    header = _field_header(file)
    count, dimensions, code = _count(header), int(header["dimensions"]), int(header["code"])
    if code not in TYPES or not 0 < dimensions <= 1 << 10:
        raise DataError(f"{file.parent.name}/{file.name} has type code {code} and {dimensions} dimensions; it is damaged")
    kind = np.dtype(TYPES[code])
    wanted = FIELD.itemsize + (count + 2) * dimensions * kind.itemsize
    if os.path.getsize(file) != wanted:
        stated = f"{count} values of {dimensions} x {kind.itemsize} bytes, {wanted} bytes in all"
        raise DataError(f"{file.parent.name}/{file.name} is cut short or damaged: its header states {stated}")
    values = np.fromfile(file, kind.newbyteorder(">"), offset=FIELD.itemsize + 2 * dimensions * kind.itemsize)
    values = values.astype(kind).reshape(count, dimensions)
    return values[:, 0] if dimensions == 1 else values, float(header["time"])
