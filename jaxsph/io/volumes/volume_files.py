"""Read and write volumes: which format a file is of, which of its quantities is wanted, and where it lies.

Flow: file -> reader -> VolumeTable -> [volume_files] -> Volume -> write_volume -> file.
"""

from __future__ import annotations

import dataclasses
import importlib
import os
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError, naming, regular_file
from jaxsph.io.replace import written_whole
from jaxsph.io.volumes.volume_table import VolumeTable
from jaxsph.model.volume import Volume

READERS = {".vti": "vti", ".nrrd": "nrrd", ".nhdr": "nrrd", ".nii": "nifti", ".nii.gz": "nifti", ".npy": "npy"}
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
    return dataclasses.replace(_module(suffix).read(regular_file(file)), path=str(path))  # type: ignore[no-any-return]


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


def write_volume(path: str | os.PathLike[str], volume: Volume) -> None:
    """Write a volume, whole or not at all: `.vti` with its place, or `.npy`, which holds the values alone.

    Raises `ValueError`: another suffix, or a place that cannot be written to.
    """
    file, suffix = Path(path), _suffix(path)
    if suffix not in WRITERS:
        raise ValueError(f"{path}: volumes are written as {' or '.join(WRITERS)}, not as {file.suffix!r}")
    with written_whole(file) as temporary:
        _module(suffix).write(temporary, np.asarray(volume.values), volume.bounds()[0], np.asarray(volume.spacing), NAME)


def _module(suffix: str) -> ModuleType:
    return importlib.import_module(f".{READERS[suffix]}", __package__)


def _suffix(path: str | os.PathLike[str]) -> str | None:
    """The known suffix that a name ends in."""
    return next((suffix for suffix in READERS if os.fspath(path).lower().endswith(suffix)), None)
