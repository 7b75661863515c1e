"""What volume files hold, read and written by their suffix: arrays on one grid whose axes lie along x, y and z.

Flow: file -> reader -> [VolumeTable] -> [volume_files] -> Volume -> [write_volume] -> file.

NumPy arrays (`.npy`) are read and written here: (nx, ny, nz), or (nx, ny, nz, components), with a lower corner of 0 and a spacing
of 1.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError, explained, naming, regular_file
from jaxsph.io.parsing import array_header, refuse_leftover, refuse_missing
from jaxsph.io.replace import known_suffix, written_whole
from jaxsph.io.volumes import scans, vti
from jaxsph.io.volumes.volume_table import VolumeTable
from jaxsph.model.volume import Volume

WRITERS = (".vti", ".npy")
NAME = "values"


def is_volume(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a volume by its name."""
    return _suffix(path) is not None


def read_volume_table(path: str | os.PathLike[str]) -> VolumeTable:
    """Read all that a volume file holds. Raises as `read_volume`."""
    file, suffix = Path(path), _suffix(path)
    if suffix is None:
        raise DataError(f"{path}: volumes are read from {', '.join(READERS)}, not from {file.suffix!r}; convert it")
    return dataclasses.replace(READERS[suffix](regular_file(file)), path=str(path))


def read_volume(path: str | os.PathLike[str], quantity: str | None = None, *, lower: Any = None, spacing: Any = None) -> Volume:
    """Read a volume on a regular grid: `.vti`, `.nrrd` `.nhdr`, `.nii` `.nii.gz` or `.npy`.

    Axes that a file stores in another order or direction are turned into x, y and z; bytes and 16-bit integers stay such.

    Args:
        path: the file.
        quantity: an array of the file, a component (`B.x`, `B.0`) or `B.magnitude`; `None` is the first of one number a point.
        lower, spacing: instead of the file's, in length units; `.npy` has none, and stands for 0 and 1.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another suffix, a damaged file, no such quantity, oblique axes, values that are not finite.
        ImportError: a library that the format needs is not installed; the message says how to install it.
    """
    return volume_from_table(read_volume_table(path), quantity, lower=lower, spacing=spacing)[0]


def volume_from_table(
    table: VolumeTable, quantity: str | None = None, *, lower: Any = None, spacing: Any = None
) -> tuple[Volume, str]:
    """The volume of one quantity of a table, and what that is called. Raises `ValueError` as `read_volume`."""
    lower, spacing = (given if asked is None else asked for given, asked in ((table.lower, lower), (table.spacing, spacing)))
    with naming(table.path):
        name, values = table.quantity(quantity)
        values = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("="), copy=False))
        try:
            return Volume.from_array(values, lower, spacing), name
        except ValueError as error:
            raise DataError(str(error).replace("`values`", f"the array {name}")) from error


def nothing_there(volume: Volume) -> str:
    """A sentence on the points that have no value; empty where all have one."""
    count = int(np.isnan(volume.values).sum())
    return f"{count:,} of {volume.values.size:,} points are NaN: the cells around them are empty" if count else ""


def write_volume(path: str | os.PathLike[str], volume: Volume) -> None:
    """Write a volume, whole or not at all: `.vti` with its place, or `.npy`, which holds the values alone.

    Raises `ValueError`: another suffix, or a place that cannot be written to.
    """
    suffix = known_suffix(path, WRITERS, "volumes are written as")
    with written_whole(path) as temporary:
        if suffix == ".npy":
            with temporary.open("wb") as stream:
                np.save(stream, np.asarray(volume.values), allow_pickle=False)
        else:
            place = volume.bounds()[0], np.asarray(volume.spacing)
            vti.write(temporary, np.asarray(volume.values), *place, NAME)


def _read_array(path: Path) -> VolumeTable:
    """A NumPy array, read into memory: a file that another program writes again would kill whoever had mapped it."""
    with explained(path, "NumPy array"), path.open("rb") as file:
        shape, is_fortran, dtype = array_header(file)
        if len(shape) not in (3, 4):
            raise DataError(f"must hold an array of 3 axes, got {shape}; reshape it")
        count, held = math.prod(shape), os.fstat(file.fileno()).st_size - file.tell()
        refuse_leftover(held - count * dtype.itemsize, f"{shape} of {dtype}")
        values = np.fromfile(file, dtype, count) if held >= count * dtype.itemsize else np.zeros(0, dtype)
        refuse_missing(count, len(values), f"numbers of {shape}")
        values = values.reshape(shape, order="F" if is_fortran else "C")
        return VolumeTable({NAME: values}, np.zeros(3), np.ones(3), "NumPy array")


READERS: dict[str, Callable[[Path], VolumeTable]] = {
    ".vti": vti.read,
    ".nrrd": scans.nrrd,
    ".nhdr": scans.nrrd,
    ".nii": scans.nifti,
    ".nii.gz": scans.nifti,
    ".npy": _read_array,
}


def _suffix(path: str | os.PathLike[str]) -> str | None:
    """The known suffix that a name ends in."""
    return next((suffix for suffix in READERS if os.fspath(path).lower().endswith(suffix)), None)
