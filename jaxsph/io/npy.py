"""NumPy arrays (`.npy`): (nx, ny, nz), or (nx, ny, nz, components); a lower corner of 0 and a spacing of 1."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .damage import DataError, explained
from .volume_table import VolumeTable

SOURCE = "NumPy array"


def read(path: Path) -> VolumeTable:
    """Read an array; pickled objects are not loaded.

    Raises:
        ValueError: damaged, cut short, not of numbers, or another number of axes.
    """
    with explained(path, SOURCE):
        values = np.load(path, mmap_mode="r", allow_pickle=False)
        if not isinstance(values, np.ndarray) or values.ndim not in (3, 4):
            raise DataError(f"must hold an array of 3 axes, got {getattr(values, 'shape', 'an archive')}; reshape it")
        return VolumeTable({"values": values}, np.zeros(3), np.ones(3), SOURCE)


def write(path: Path, values: np.ndarray, lower: np.ndarray, spacing: np.ndarray, name: str) -> None:
    """Write the values alone: the format knows no place."""
    with path.open("wb") as file:
        np.save(file, values, allow_pickle=False)
