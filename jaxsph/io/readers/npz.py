"""NumPy archives: `position` and any other array of N rows.

| key | meaning |
|---|---|
| `position` (N, 3), or `x`, `y`, `z` or `x`, `y` of N | required |
| `support_radius` or `support`, `volume` | one number, or (N,) |
| `particle_mass` or `mass`, `density` | one number, or (N,) |
| any other array of N rows | a column |
| `time` or `t` | one number: when |

Other single numbers (a rest density) are not particle data and are left out.
"""

from __future__ import annotations

import dataclasses
import math
import os
import zipfile
from pathlib import Path

import numpy as np

from jaxsph.io.damage import DataError, explained, naming
from jaxsph.io.parsing import COORDINATES, DEFLATE_RATIO, array_header, enter, gather_vectors, read_up_to
from jaxsph.io.table import (
    MAX_COMPONENTS,
    POSITION_NAMES,
    ROLES,
    SUPPORT_NAMES,
    VOLUME_NAMES,
    ParticleTable,
    called,
    scalar_of_width_one,
    single_number,
    table_from_columns,
)

SOURCE = "NumPy archive"
SUFFIX = ".npy"
BROADCAST_NAMES = (*SUPPORT_NAMES, *VOLUME_NAMES, *ROLES["mass"], *ROLES["density"])
NUMBERS = "fiub"
TIME_NAMES = ("time", "t")
OF_PYSPH = (
    "is an archive of PySPH, whose particles are Python objects, which are not loaded as they may run programs: write HDF5 "
    "instead, by `from pysph.solver.utils import load, dump; dump('a.hdf5', list(load('a.npz')['arrays'].values()), {})`"
)
Header = tuple[tuple[int, ...], np.dtype, zipfile.ZipInfo]  # of an array: shape, numbers, and the entry that holds it


def read(path: Path) -> ParticleTable:
    """Read an `.npz` file; `ValueError` when it is damaged or holds no positions. Pickled objects are not loaded."""
    with explained(path, SOURCE):
        if not zipfile.is_zipfile(path):
            raise DataError("is not a complete .npz archive (a zip file); copy it again, or write it with numpy.savez")
        with zipfile.ZipFile(path) as archive:
            arrays = _arrays(archive, os.path.getsize(path))
            rows = [name for name, (shape, *_) in arrays.items() if shape[1:] == (3,)]  # `r` may be these, or a radius
            stored = called(arrays, POSITION_NAMES) or called(rows, ("r",))
            first = stored or called(arrays, COORDINATES)
            if first is None and {"particles", "solver_data"} & arrays.keys():
                raise DataError(OF_PYSPH)
            if first is None:
                wrong = f"holds no `position`, only {', '.join(arrays) or 'nothing'};"
                raise DataError(f"{wrong} name the (N, 3) array so, or three of N numbers x, y and z")
            shape, dtype, entry = arrays[first]
            if dtype.kind not in "fiu":
                raise DataError(f"`{first}` must hold numbers, got dtype {dtype}")
            if stored is None:
                columns, said = _columns(archive, arrays, math.prod(shape[:1]))
                position, columns = gather_vectors(
                    {name: scalar_of_width_one(each) for name, each in columns.items()}, others=arrays
                )
            else:
                if len(shape) != 2 or shape[1] != 3:
                    raise DataError(f"positions must have shape (N, 3), got {shape}; three coordinates a particle")
                del arrays[stored]
                position, (columns, said) = _loaded(archive, entry), _columns(archive, arrays, shape[0])
            table = table_from_columns(position, columns, source=SOURCE, conventions=said)
            moment = arrays.get(called(arrays, TIME_NAMES) or "")
            is_one = moment is not None and moment[0] in ((), (1,)) and moment[1].kind in NUMBERS
            return dataclasses.replace(table, time=single_number(_loaded(archive, moment[2])) if moment and is_one else None)


def _loaded(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(entry) as stream:
        shape, is_fortran, dtype = array_header(stream)
        content = read_up_to(stream, entry.file_size)
    return np.frombuffer(content, dtype).reshape(shape, order="F" if is_fortran else "C")


def _columns(archive: zipfile.ZipFile, arrays: dict[str, Header], count: int) -> tuple[dict[str, np.ndarray], list[str]]:
    """What belongs to `count` particles, and a sentence on what does not hold numbers; all else stays packed."""
    columns, words = {}, [name for name, (_, dtype, _) in arrays.items() if dtype.kind not in NUMBERS]
    for name, (shape, dtype, entry) in arrays.items():
        stands_for_all = called([name], BROADCAST_NAMES) is not None
        if dtype.kind not in NUMBERS:
            continue
        if shape in ((), (1,)) and stands_for_all:
            columns[name] = np.full(count, _loaded(archive, entry).reshape(()))
        elif len(shape) in (1, 2) and shape[0] == count and 0 < math.prod(shape[1:]) <= MAX_COMPONENTS:
            columns[name] = _loaded(archive, entry)
        elif shape and stands_for_all:
            raise DataError(f"`{name}` has shape {shape}, but there are {count} particles; give 1 or N")
    return columns, [f"left out {', '.join(words)}: not numbers"] if words else []


def _arrays(archive: zipfile.ZipFile, file_bytes: int) -> dict[str, Header]:
    """The headers of all arrays by name; refused where sizes cannot be those of a file of `file_bytes`."""
    arrays: dict[str, Header] = {}
    for entry in archive.infolist():
        name = entry.filename.removesuffix(SUFFIX)
        if not entry.filename.endswith(SUFFIX):
            continue
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise DataError(f"`{name}` is packed by a method that numpy.savez does not use; write it with numpy.savez")
        enter(arrays, name, _array(archive, entry, name))
        file_bytes -= entry.compress_size
    if file_bytes < 0:
        raise DataError("has entries that overlap, so it is damaged; write it again with numpy.savez")
    return arrays


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, name: str) -> Header:
    most = entry.compress_size * (1 if entry.compress_type == zipfile.ZIP_STORED else DEFLATE_RATIO)
    if entry.file_size > most:
        wrong = f"`{name}` is announced to unpack from {entry.compress_size} to {entry.file_size} bytes, more than they can;"
        raise DataError(f"{wrong} it is damaged: copy it again")
    with archive.open(entry) as stream, naming(f"`{name}`"):
        shape, _, dtype = array_header(stream, objects=True)
        if dtype.hasobject:
            return shape, dtype, entry
        held = entry.file_size - stream.tell()
    if math.prod(shape) * dtype.itemsize != held:
        raise DataError(f"`{name}` has shape {shape} of {dtype}, but its entry holds {held} bytes; write it again")
    return shape, dtype, entry
