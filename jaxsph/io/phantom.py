r"""Phantom HDF5 dumps.

The support is $H = 2 h$ (cubic spline; Phantom's default). Densities and masses are not stored: a particle of type $t$
has the mass `massoftype[t]` and the density $\rho = m (h_{fact} / h)^3$, so its volume is $(h / h_{fact})^3$. Particles
with $h \le 0$ are dead or accreted. Sinks are not read.
Source: Price et al. 2018, PASA 35, e031, equation 4 and section 2.1.5.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .damage import DataError
from .table import ParticleTable, scalar_of_width_one

SOURCE = "Phantom HDF5"
GAS = 1
SUPPORT_OVER_H = 2.0


def from_hdf5(file: Any, part_type: int | None) -> ParticleTable:
    """The living particles of one type (`itype`; 1 is gas) of an open `h5py.File`.

    Without `part_type` that is gas, or the lowest other type there is.

    Raises:
        ValueError: missing data sets, no particles of that type, data sets of other lengths.
    """
    header, group = file["header"], file["particles"]
    for name, holder in (("hfact", header), ("massoftype", header), ("h", group)):
        if name not in holder:
            raise DataError(f"has no `{name}` in `{holder.name}`, so supports and masses are unknown; dump it again")
    position, h = group["xyz"][()], scalar_of_width_one(group["h"][()]).astype(np.float64)
    count = len(position)
    if len(h) != count:
        raise DataError(f"has {count} positions but {len(h)} smoothing lengths; dump it again")
    kind = np.full(count, GAS)
    if "itype" in group:
        kind = np.abs(scalar_of_width_one(group["itype"][()]).astype(np.int64))
    said, alive = [], h > 0
    if not alive.all():
        said.append(f"dropped {int((~alive).sum())} dead or accreted particles (h <= 0)")
    kinds = np.unique(kind[alive])
    if part_type is None:
        part_type = GAS if GAS in kinds or not len(kinds) else int(kinds[0])
    if len(kinds) and part_type not in kinds:
        raise DataError(f"has no particles of type {part_type}; `part_type` can be {', '.join(map(str, kinds))}")
    keep = alive & (kind == part_type)
    others = int((alive & ~keep).sum())
    if others:
        said.append(f"particles of itype {part_type}; left out {others} of other types")
    masses = np.ravel(header["massoftype"][()])
    if not 1 <= part_type <= len(masses):
        raise DataError(f"has no mass for particles of type {part_type}; there are {len(masses)} types")
    hfact, mass = float(header["hfact"][()]), float(masses[part_type - 1])
    columns = {
        name: dataset[()][keep]
        for name, dataset in group.items()
        if name != "xyz" and dataset.ndim in (1, 2) and len(dataset) == count and dataset.dtype.kind in "fiub"
    }
    h = h[keep]
    columns |= {"mass": np.full(len(h), mass), "density": mass * (hfact / h) ** 3}
    said += [
        "support = 2 x smoothing length h (Phantom convention)",
        f"density = mass (hfact / h)^3 and volume = (h / hfact)^3, hfact = {hfact:g} (Phantom convention)",
    ]
    if "sinks" in file and len(file["sinks"]):
        said.append("sink particles are left out")
    return ParticleTable(position[keep], columns, SUPPORT_OVER_H * h, (h / hfact) ** 3, source=SOURCE, conventions=tuple(said))
