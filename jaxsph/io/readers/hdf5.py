"""HDF5 files: find out by content which code wrote one, and hand it to that code's reader.

| inside | read as |
|---|---|
| `PartType0`, `PartType1`, ... | Gadget, GADGET-4, SWIFT, GIZMO, AREPO (`gadget_hdf5`) |
| `particles/xyz` and `header` | Phantom (`phantom`) |
| `Coordinates` or `position` at the top | plain points, below |
"""

from __future__ import annotations

from pathlib import Path

from jaxsph.io.damage import DataError
from jaxsph.io.readers import gadget_hdf5, phantom
from jaxsph.io.readers.hdf5_guards import columns_of, numeric_datasets, opened, read_positions
from jaxsph.io.table import SUPPORT_NAMES, VOLUME_NAMES, ParticleTable, called, plain, table_from_columns

SOURCE = "HDF5 points"
POSITION_NAMES = ("coordinates", "position", "positions", "pos", "points", "xyz")


def read(path: Path, *, part_type: int | None = None) -> ParticleTable:
    """Read an HDF5 file of any of the flavours at the top of this module.

    Raises:
        ValueError: damaged, or of none of these flavours; `part_type` for a file without types.
        ImportError: h5py is not installed.
    """
    with opened(path) as file:
        if any(name.startswith("PartType") for name in file):
            return gadget_hdf5.from_hdf5(file, part_type)
        if "header" in file and "particles" in file and "xyz" in file["particles"]:
            return phantom.from_hdf5(file, part_type)
        stored = called(file, POSITION_NAMES)
        if stored is None:
            wrong = f"is HDF5 with {', '.join(file) or 'nothing'} at its top; expected `PartType0` (Gadget,"
            raise DataError(f"{wrong} SWIFT), `particles` and `header` (Phantom), or a dataset `Coordinates`")
        if part_type is not None:
            raise DataError(f"holds plain points without particle types; leave out `part_type` (got {part_type})")
        position = read_positions(file[stored])
        datasets = {name: each for name, each in columns_of(file).items() if name != stored}
        columns, said = numeric_datasets(datasets, len(position), [*map(plain, (*SUPPORT_NAMES, *VOLUME_NAMES))])
        return table_from_columns(position, columns, source=SOURCE, conventions=said)
