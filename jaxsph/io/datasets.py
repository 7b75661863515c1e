"""HDF5 data sets, read where their data is there: what was announced but never written would come as zeros.

Flow: HDF5 file -> [datasets] -> its code's reader -> ParticleTable.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .damage import DataError
from .hdf5_links import members
from .hdf5_storage import refuse_unwritten, shape_of


def read_dataset(dataset: Any, rows: slice | None = None) -> np.ndarray:
    """All of an `h5py.Dataset`, or some of its rows.

    Raises:
        ValueError: it is a group, or data of it was never written; a shape that its bytes cannot hold.
    """
    if shape_of(dataset) is None:
        raise DataError(f"`{dataset.name}` holds no data; write the file again with a data set there")
    refuse_unwritten(dataset)
    return np.asarray(dataset[() if rows is None else rows])


def read_positions(dataset: Any, rows: slice | None = None) -> np.ndarray:
    """The positions (N, 3) of an `h5py.Dataset`, or some of them; other shapes are refused before they are read."""
    position_shape(dataset)
    return read_dataset(dataset, rows)


def position_shape(dataset: Any) -> tuple[int, int]:
    """The shape of positions, (N, 3); `ValueError` for any other."""
    shape = shape_of(dataset)
    if shape is None or len(shape) != 2 or shape[1] != 3 or dataset.dtype.kind not in "fiu":
        raise DataError(f"`{dataset.name}` must hold numbers of shape (N, 3), got {shape}; write three coordinates a particle")
    return shape[0], 3


def columns_of(group: Any) -> dict[str, Any]:
    """The data sets of `group` with one or two axes, not read.

    Raises:
        ValueError: a link that cannot be followed, a view of files that are missing or may not be opened.
    """
    return {name: found for name, found in members(group).items() if len(shape_of(found) or ()) in (1, 2)}


def numeric_datasets(group: Any, count: int, skip: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """The data sets of `group` with `count` rows of one or more numbers."""
    return {
        name: read_dataset(dataset)
        for name, dataset in columns_of(group).items()
        if name not in skip and dataset.shape[0] == count and dataset.dtype.kind in "fiub"
    }
