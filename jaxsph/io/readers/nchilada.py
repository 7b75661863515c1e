"""NChilada snapshots, of ChaNGa: a folder with a folder a kind of particles, and in that a file a column.

Every file is big-endian (XDR): a magic number, time, number of particles in two halves, dimensions and a type code, then least
and largest value of each dimension, then the values. Types are numbered as in Gadget files: 0 gas, 1 dark matter, 4 stars.
The column `smoothlength` is half of the support where a sample of neighbours shows that (`stored`), else supports are found from
neighbours. Units are those of a file of parameters beside the folder (`stated_units`). Source: the field header of the NChilada
library, University of Washington N-Body Shop.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from jaxsph.io.damage import DataError, explained
from jaxsph.io.parsing import choose_type, others_held
from jaxsph.io.readers.tipsy import table_of_changa
from jaxsph.io.table import ParticleTable

SOURCE = "NChilada"
SMOOTHING = "smoothlength", "smoothing_length", "hsmooth"
FOLDERS = {0: ("gas",), 1: ("dark",), 4: ("star", "stars")}
MAGIC = 1062053
HEADER = np.dtype([("magic", "i4"), ("time", "f8"), ("high", "u4"), ("low", "u4"), ("dimensions", "i4"), ("code", "i4")])
HEADER = HEADER.newbyteorder(">")
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "i8", 8: "u8", 9: "f4", 10: "f8"}
POSITIONS = "pos", "position", "positions", "coordinates"


def looks_like(folder: Path) -> bool:
    """Whether a folder has positions of any kind of particles, as NChilada stores them."""
    return any(_is_field(file) for number in FOLDERS for file in [_positions(folder, number)] if file is not None)


def read(path: Path, *, part_type: int | None = None) -> ParticleTable:
    """Read the particles of one type: gas if there is any, else the first that there is.

    Raises `ValueError`: damaged; files of different numbers of particles; no particles of that type.
    """
    with explained(path, SOURCE):
        held = {n: _count(_header(file)) for n in FOLDERS if (file := _positions(path, n)) is not None}
        present = [number for number, count in held.items() if count]
        chosen = choose_type(present, part_type if present else part_type or 0)
        where = _positions(path, chosen)
        assert where is not None
        position, time = _field(where)
        columns = {}
        for file in sorted(where.parent.iterdir()):
            if file != where and _is_field(file):
                columns[file.name] = _field(file)[0]
                if len(columns[file.name]) != len(position):
                    stated = f"{len(columns[file.name])} values, but there are {len(position)} positions"
                    raise DataError(f"{where.parent.name}/{file.name} has {stated}; it is damaged or of another snapshot")
        said = [f"particles of type {chosen} ({where.parent.name})", *others_held(held, chosen)]
        return table_of_changa(path, position, columns, chosen, said, time, SOURCE, SMOOTHING)


def _positions(folder: Path, number: int) -> Path | None:
    """The file of positions of a type, where there is one."""
    files = (folder / name / called for name in FOLDERS[number] for called in POSITIONS)
    return next((file for file in files if file.is_file()), None)


def _is_field(file: Path) -> bool:
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        start = opened.read(HEADER.itemsize)
    return len(start) == HEADER.itemsize and int(np.frombuffer(start, HEADER)[0]["magic"]) == MAGIC


def _header(file: Path) -> np.void:
    if not _is_field(file):
        raise DataError(f"{file.parent.name}/{file.name} does not begin as NChilada's files do; it is damaged")
    return np.fromfile(file, HEADER, 1)[0]  # type: ignore[no-any-return]


def _count(header: np.void) -> int:
    return (int(header["high"]) << 32) + int(header["low"])


def _field(file: Path) -> tuple[np.ndarray, float]:
    """Values of a file, (N,) or (N, dimensions), and its time."""
    header = _header(file)
    count, dimensions, code = _count(header), int(header["dimensions"]), int(header["code"])
    if code not in TYPES or not 0 < dimensions <= 1 << 10:
        raise DataError(f"{file.parent.name}/{file.name} has type code {code} and {dimensions} dimensions; it is damaged")
    kind = np.dtype(TYPES[code])
    wanted = HEADER.itemsize + (count + 2) * dimensions * kind.itemsize
    if os.path.getsize(file) != wanted:
        stated = f"{count} values of {dimensions} x {kind.itemsize} bytes, {wanted} bytes in all"
        raise DataError(f"{file.parent.name}/{file.name} is cut short or damaged: its header states {stated}")
    values = np.fromfile(file, kind.newbyteorder(">"), offset=HEADER.itemsize + 2 * dimensions * kind.itemsize)
    values = values.astype(kind).reshape(count, dimensions)
    return values[:, 0] if dimensions == 1 else values, float(header["time"])
