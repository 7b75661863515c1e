"""NChilada snapshots, of ChaNGa: a folder with a folder a kind of particles, and in that a file a column.

Every file is big-endian (XDR): a magic number, time, number of particles in two halves, dimensions and a type code, then least
and largest value of each dimension, then the values. Types are numbered as in Gadget files: 0 gas, 1 dark matter, 4 stars.
The column `smoothlength` is half of the support where a sample of neighbours shows that (`stored`), else supports are found from
neighbours. Units are those of a file of parameters beside the folder (`param_files`). Source: the field header of the NChilada
library, University of Washington N-Body Shop.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from .damage import DataError, NoParticlesError, explained
from .param_files import units_beside
from .stored import with_stored_lengths
from .table import ParticleTable

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

    Raises:
        ValueError: damaged; files of different numbers of particles; no particles of that type.
    """
    with explained(path, SOURCE):
        present = [number for number in FOLDERS if (file := _positions(path, number)) is not None and _count(file)]
        chosen = part_type if part_type is not None else (present or [0])[0]
        if chosen not in present:
            there = ", ".join(map(str, present)) or "none: it has none at all"
            raise NoParticlesError(f"has no particles of type {chosen}; `part_type` can be {there}")
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
        units, said = units_beside(path, columns, time)
        said = [f"particles of type {chosen} ({where.parent.name})", *said]
        said.append("kernel = cubic_spline (ChaNGa's and Gasoline's unless compiled otherwise; the file does not say)")
        more: dict[str, Any] = {"conventions": tuple(said), "units": units, "time": time, "part_type": chosen}
        more["kernel"] = "cubic_spline"
        return with_stored_lengths(ParticleTable(position, columns, source=SOURCE, **more), *SMOOTHING)


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


def _count(file: Path) -> int:
    if not _is_field(file):
        raise DataError(f"{file.parent.name}/{file.name} does not begin as NChilada's files do; it is damaged")
    with file.open("rb") as opened:
        header = np.frombuffer(opened.read(HEADER.itemsize), HEADER)[0]
    return (int(header["high"]) << 32) + int(header["low"])


def _field(file: Path) -> tuple[np.ndarray, float]:
    """Values of a file, (N,) or (N, dimensions), and its time."""
    with file.open("rb") as opened:
        header = np.frombuffer(opened.read(HEADER.itemsize), HEADER)[0]
        count, dimensions, code = _count(file), int(header["dimensions"]), int(header["code"])
        if code not in TYPES or not 0 < dimensions <= 1 << 10:
            raise DataError(f"{file.parent.name}/{file.name} has type code {code} and {dimensions} dimensions; it is damaged")
        kind = np.dtype(TYPES[code])
        wanted = HEADER.itemsize + (count + 2) * dimensions * kind.itemsize
        if os.path.getsize(file) != wanted:
            stated = f"{count} values of {dimensions} x {kind.itemsize} bytes, {wanted} bytes in all"
            raise DataError(f"{file.parent.name}/{file.name} is cut short or damaged: its header states {stated}")
        opened.seek(2 * dimensions * kind.itemsize, os.SEEK_CUR)
        values = np.frombuffer(opened.read(), kind.newbyteorder(">")).astype(kind).reshape(count, dimensions)
    return values[:, 0] if dimensions == 1 else values, float(header["time"])
