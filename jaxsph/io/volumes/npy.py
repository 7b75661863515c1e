"""NumPy arrays (`.npy`): (nx, ny, nz), or (nx, ny, nz, components); a lower corner of 0 and a spacing of 1."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np

from jaxsph.io.damage import DataError, explained
from jaxsph.io.parsing import array_header, refuse_leftover
from jaxsph.io.volumes.volume_table import VolumeTable

SOURCE = "NumPy array"


def read(path: Path) -> VolumeTable:
    """Read an array; pickled objects are not loaded.

    It is read into memory: a file that another program writes again would kill whoever had mapped it.

    Raises `ValueError`: damaged, cut short, longer than its header says, not of numbers, or another number of axes.
    """
    with explained(path, SOURCE), path.open("rb") as file:
        shape, is_fortran, dtype = array_header(file)
        if dtype.hasobject:
            raise DataError("holds Python objects, which are not loaded; write it as numbers")
        if len(shape) not in (3, 4) or min(shape) < 0:
            raise DataError(f"must hold an array of 3 axes, got {shape}; reshape it")
        count, held = math.prod(shape), os.fstat(file.fileno()).st_size - file.tell()
        refuse_leftover(held - count * dtype.itemsize, f"{shape} of {dtype}")
        values = np.fromfile(file, dtype, count) if held >= count * dtype.itemsize else np.zeros(0, dtype)
        if len(values) < count:
            raise DataError(
                f"is cut short: {shape} of {dtype} need {count * dtype.itemsize} bytes, {held} are there; copy it again"
            )
        return VolumeTable({"values": values.reshape(shape, order="F" if is_fortran else "C")}, np.zeros(3), np.ones(3), SOURCE)


def write(path: Path, values: np.ndarray, lower: np.ndarray, spacing: np.ndarray, name: str) -> None:
    """Write the values alone: the format knows no place."""
    with path.open("wb") as file:
        np.save(file, values, allow_pickle=False)
