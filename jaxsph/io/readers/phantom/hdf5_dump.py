"""Phantom dumps in HDF5, as Phantom wrote them for some years and phantom2hdf5 does.

Flow: h5py.File -> [hdf5_dump] -> Dump -> ParticleTable.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsph.io.damage import DataError
from jaxsph.io.readers.hdf5_guards import columns_of, numeric_datasets, read_dataset, read_positions
from jaxsph.io.readers.phantom.dumps import GAS, SINKS, Dump, refuse_no_sinks, sinks_table
from jaxsph.io.table import ParticleTable, scalar_of_width_one

SOURCE = "Phantom HDF5"


def from_hdf5(file: Any, part_type: int | None) -> ParticleTable:
    """The living particles of one type (`itype`; 1 is gas), or the sinks (-1), of an open `h5py.File`.

    Without `part_type` that is gas, or the lowest other type there is.

    Raises `ValueError`: missing data sets, no particles of that type, data sets of other lengths.
    """
    header, group = file["header"], file["particles"]
    for each in (header, group):
        columns_of(each)
    sinks = file.get("sinks", {})
    if part_type == SINKS:
        return _sinks(header, sinks)
    for name, holder in (("hfact", header), ("massoftype", header), ("h", group)):
        if name not in holder:
            raise DataError(f"has no `{name}` in `{holder.name}`, so supports and masses are unknown; dump it again")
    position, h = read_positions(group["xyz"]), scalar_of_width_one(read_dataset(group["h"])).astype(np.float64)
    count = len(position)
    kind = np.full(count, GAS)
    if "itype" in group:
        kind = np.abs(scalar_of_width_one(read_dataset(group["itype"])).astype(np.int64))
    for name, values in (("h", h), ("itype", kind)):
        if values.shape != (count,):
            raise DataError(f"has {count} positions, but `{name}` has the shape {values.shape}; dump it again")
    masses, hfact = np.ravel(read_dataset(header["massoftype"])), float(read_dataset(header["hfact"]))
    columns, said = _columns(group, count)
    return Dump(SOURCE, header, position, columns, h, kind, hfact, masses, _num_sinks(sinks), said).table(part_type)


def _num_sinks(sinks: Any) -> int:
    shape = getattr(sinks["xyz"], "shape", None) if "xyz" in sinks else None
    return int(shape[0]) if shape else 0


def _sinks(header: Any, sinks: Any) -> ParticleTable:
    if not _num_sinks(sinks):
        refuse_no_sinks()
    position = read_positions(sinks["xyz"])
    return sinks_table(SOURCE, header, position, *_columns(sinks, len(position)))


def _columns(group: Any, count: int) -> tuple[dict[str, np.ndarray], list[str]]:
    """Columns but positions, and a sentence on each that is left out."""
    return numeric_datasets({name: each for name, each in columns_of(group).items() if name != "xyz"}, count)
