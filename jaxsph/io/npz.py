"""NumPy archives: `position` and any other array of N rows.

| key | meaning |
|---|---|
| `position` (N, 3) | required |
| `support_radius` or `support`, `volume` | one number, or (N,) |
| `particle_mass` or `mass`, `density` | one number, or (N,) |
| any other array of N rows | a column |

Other single numbers (a time, a rest density) are not particle data and are left out.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from .damage import DataError, explained
from .quantities import ROLES
from .table import SUPPORT_NAMES, VOLUME_NAMES, ParticleTable, plain, table_from_columns

SOURCE = "NumPy archive"
POSITION_NAMES = ("position", "positions", "coordinates", "points", "xyz")
BROADCAST_NAMES = (*SUPPORT_NAMES, *VOLUME_NAMES, *ROLES["mass"], *ROLES["density"])


def read(path: Path) -> ParticleTable:
    """Read an `.npz` file; `ValueError` when it is damaged or holds no positions. Pickled objects are not loaded."""
    with explained(path, SOURCE):
        if not zipfile.is_zipfile(path):
            raise DataError("is not a complete .npz archive (a zip file); copy it again, or write it with numpy.savez")
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        stored = next((name for want in POSITION_NAMES for name in arrays if plain(name) == want), None)
        if stored is None:
            raise DataError(f"holds no `position`, only {', '.join(arrays) or 'nothing'}; name the (N, 3) array so")
        position = arrays.pop(stored)
        if position.dtype.kind not in "fiu":
            raise DataError(f"`{stored}` must hold numbers, got dtype {position.dtype}")
        count = len(position) if position.ndim else 0
        columns = {}
        for name, array in arrays.items():
            if array.dtype.kind not in "fiub":
                continue
            if array.size == 1 and array.ndim <= 1 and plain(name) in map(plain, BROADCAST_NAMES):
                columns[name] = np.full(count, array.reshape(()))
            elif array.ndim in (1, 2) and len(array) == count:
                columns[name] = array
            elif array.ndim and plain(name) in map(plain, BROADCAST_NAMES):
                raise DataError(f"`{name}` has shape {array.shape}, but there are {count} particles; give 1 or N")
        return table_from_columns(position, columns, source=SOURCE)
