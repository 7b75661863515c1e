r"""Phantom HDF5 dumps.

The support is $H = 2 h$ (cubic spline; Phantom's default). Densities and masses are not stored: a particle of type $t$
has the mass `massoftype[t]` and the density $\rho = m (h_{fact} / h)^3$, so its volume is $(h / h_{fact})^3$. Particles
with $h \le 0$ are dead or accreted. Sinks are not read.
Source: Price et al. 2018, PASA 35, e031, equation 4 and section 2.1.5.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsph.io.damage import DataError
from jaxsph.io.readers.hdf5_storage import columns_of, numeric_datasets, read_dataset, read_positions
from jaxsph.io.readers.stated_units import of_phantom
from jaxsph.io.table import ParticleTable, scalar_of_width_one, time_of

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
    for each in (header, group):
        columns_of(each)
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
    unknown = np.isnan(h)  # only `h <= 0` marks the dead; what is no number was damaged, or written so by a run that failed
    if unknown.any():
        raise DataError(
            f"smoothing lengths `h` must be numbers, but {int(unknown.sum())} of {len(h)} are NaN, the first at index "
            f"{int(np.argmax(unknown))}; remove these particles, or dump it again"
        )
    said, alive = [], h > 0
    if not alive.all():
        said.append(f"dropped {int((~alive).sum())} dead or accreted particles (h <= 0)")
    part_type = _choose(np.unique(kind[alive]), part_type)
    keep = alive & (kind == part_type)
    others = int((alive & ~keep).sum())
    if others:
        said.append(f"particles of itype {part_type}; left out {others} of other types")
    masses = np.ravel(read_dataset(header["massoftype"]))
    if not 1 <= part_type <= len(masses):
        raise DataError(f"has no mass for particles of type {part_type}; there are {len(masses)} types")
    hfact, mass = float(read_dataset(header["hfact"])), float(masses[part_type - 1])
    if not 0 < hfact < np.inf:
        raise DataError(f"has `hfact` {hfact:g} in its header, which must be positive: volumes follow from it; dump it again")
    columns = {name: column[keep] for name, column in numeric_datasets(group, count, skip=("xyz",)).items()}
    h = h[keep]
    columns |= {"mass": np.full(len(h), mass), "density": mass * (hfact / h) ** 3}
    said += [
        "support = 2 x smoothing length h (Phantom convention)",
        "kernel = cubic_spline (Phantom's unless it is compiled with another, which a dump does not say)",
        f"density = mass (hfact / h)^3 and volume = (h / hfact)^3, hfact = {hfact:g} (Phantom convention)",
    ]
    if "sinks" in file and len(file["sinks"]):
        said.append("sink particles are left out")
    volume, time = (h / hfact) ** 3, time_of(read_dataset(header["time"])) if "time" in header else None
    more: dict[str, Any] = {"conventions": tuple(said), "units": of_phantom(header, columns), "time": time}
    return ParticleTable(position[keep], columns, SUPPORT_OVER_H * h, volume, source=SOURCE, kernel="cubic_spline", **more)


def _choose(kinds: np.ndarray, part_type: int | None) -> int:
    if part_type is None:
        return GAS if GAS in kinds or not len(kinds) else int(kinds[0])
    if len(kinds) and part_type not in kinds:
        raise DataError(f"has no particles of type {part_type}; `part_type` can be {', '.join(map(str, kinds))}")
    return part_type
