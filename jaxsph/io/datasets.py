"""HDF5 data sets, read where their data is there: what was announced but never written would come as zeros.

Flow: HDF5 file -> [datasets] -> its code's reader -> ParticleTable.

A data set has a shape before it has data. Its storage is allocated when data is written: whole where it is contiguous,
chunk by chunk where it is chunked. So a run that was stopped, or a disk that was full, shows in what is allocated.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from .damage import DataError
from .unpack import DEFLATE_RATIO

DEFLATE, SHUFFLE, FLETCHER32, LZF = 1, 2, 3, 32000
BOUNDED_FILTERS = {DEFLATE, SHUFFLE, FLETCHER32, LZF}
"""Filters that shrink data at most `DEFLATE_RATIO` times; others may have no such bound."""


def read_dataset(dataset: Any, rows: slice | None = None) -> np.ndarray:
    """All of an `h5py.Dataset`, or some of its rows.

    Raises:
        ValueError: it is a group, or data of it was never written; a shape that its bytes cannot hold.
    """
    if getattr(dataset, "shape", None) is None:
        raise DataError(f"`{dataset.name}` holds no data; write the file again with a data set there")
    _refuse_unwritten(dataset)
    return np.asarray(dataset[() if rows is None else rows])


def read_positions(dataset: Any, rows: slice | None = None) -> np.ndarray:
    """The positions (N, 3) of an `h5py.Dataset`, or some of them; other shapes are refused before they are read."""
    shape = getattr(dataset, "shape", None)
    if shape is None or len(shape) != 2 or shape[1] != 3 or dataset.dtype.kind not in "fiu":
        raise DataError(f"`{dataset.name}` must hold numbers of shape (N, 3), got {shape}; write three coordinates a particle")
    return read_dataset(dataset, rows)


def numeric_datasets(group: Any, count: int, skip: tuple[str, ...] = ()) -> dict[str, np.ndarray]:
    """The data sets of `group` with `count` rows of one or more numbers."""
    return {
        name: read_dataset(dataset)
        for name, dataset in group.items()
        if name not in skip
        and getattr(dataset, "ndim", 0) in (1, 2)
        and dataset.shape[0] == count
        and dataset.dtype.kind in "fiub"
    }


def _refuse_unwritten(dataset: Any) -> None:
    needed = math.prod(dataset.shape) * dataset.dtype.itemsize
    if needed == 0 or dataset.external:
        return
    if dataset.is_virtual:
        _refuse_missing_sources(dataset)
        return
    stored = dataset.id.get_storage_size()
    if dataset.chunks is not None:
        written = dataset.id.get_num_chunks()
        chunks = math.prod(-(-size // chunk) for size, chunk in zip(dataset.shape, dataset.chunks, strict=True))
        if written < chunks:
            raise DataError(
                f"`{dataset.name}` has shape {dataset.shape}, but only {written} of its {chunks} chunks were ever written: "
                f"the others would be read as {dataset.fillvalue}; write the file again, or copy it again"
            )
    if needed > stored * _most_per_byte(dataset):
        raise DataError(
            f"`{dataset.name}` has shape {dataset.shape}, which needs {needed} bytes, but only {stored} were ever written; "
            f"write the file again, or copy it again"
        )


def _most_per_byte(dataset: Any) -> float:
    """How many bytes one stored byte can become."""
    pipeline = dataset.id.get_create_plist()
    filters = {pipeline.get_filter(index)[0] for index in range(pipeline.get_nfilters())}
    if not filters:
        return 1
    return DEFLATE_RATIO if filters <= BOUNDED_FILTERS else math.inf


def _refuse_missing_sources(dataset: Any) -> None:
    """A virtual data set is a view of others, and where one of them is not found HDF5 reads the fill value."""
    sources = dataset.virtual_sources()
    mapped = sum(source.vspace.get_select_npoints() for source in sources)
    folder = Path(dataset.file.filename).parent
    for source in sources:
        if "%" in source.file_name or "%" in source.dset_name:  # a pattern of names: how many there must be is not said
            return
        path = next((path for path in (folder / source.file_name, Path(source.file_name)) if path.is_file()), None)
        if source.file_name != "." and path is None:
            raise DataError(
                f"`{dataset.name}` is a view of `{source.file_name}`, which is not there: its part would be read as "
                f"{dataset.fillvalue}; put that file beside this one"
            )
    if mapped < math.prod(dataset.shape):
        raise DataError(
            f"`{dataset.name}` has shape {dataset.shape}, but is a view of {mapped} numbers only; write the file again"
        )
