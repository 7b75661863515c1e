r"""What the arrays of a dump of Phantom mean, however they were stored; and dumps in HDF5, as phantom2hdf5 makes them.

Flow: native, h5py.File -> [dumps: Dump] -> ParticleTable of the particles of one type, or of the sinks.

The support is $H = 2 h$ (cubic spline; Phantom's default). Densities and masses are not stored: a particle of type $t$
has the mass `massoftype[t]` and the density $\rho = m (h_{fact} / h)^3$, so its volume is $(h / h_{fact})^3$. Particles
with $h \le 0$ are dead or accreted. Sinks are particles of a type of their own here, `SINKS`, without supports: their `h` is the
radius within which they accrete.
Source: Price et al. 2018, PASA 35, e031, equation 4 and sections 2.1.5, 2.8.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError, NoParticlesError
from jaxsph.io.readers.hdf5_guards import columns_of, numeric_datasets, read_dataset, read_positions
from jaxsph.io.readers.stated_units import of_phantom
from jaxsph.io.table import ParticleTable, scalar_of_width_one, time_of

HDF5_SOURCE = "Phantom HDF5"
GAS = 1
SINKS = -1  # the number by which sinks are asked for: no type of Phantom's has it
SUPPORT_OVER_H = 2.0


@dataclasses.dataclass(frozen=True)
class Dump:
    """A dump as it is stored.

    Attributes:
        source: name of the format.
        header: numbers by tag: `hfact`, `massoftype`, `time`, `udist`, ...; whatever takes `[()]`.
        position, columns: of all particles but sinks, (N, 3) and (N, ...), `h` and `itype` among them.
        h: (N,) smoothing lengths, float64.
        kind: (N,) types of particles, from 1.
        hfact: smoothing length over mean distance of particles.
        masses: of particles of the types 1, 2, ...
        sinks: how many there are.
        left_out: a sentence on each column that is.
    """

    source: str
    header: Mapping[str, Any]
    position: np.ndarray
    columns: dict[str, np.ndarray]
    h: np.ndarray
    kind: np.ndarray
    hfact: float
    masses: np.ndarray
    sinks: int
    left_out: Sequence[str] = ()

    def table(self, part_type: int | None) -> ParticleTable:
        """The living particles of one type; without `part_type` gas, or the lowest other type there is.

        Raises:
            ValueError: smoothing lengths that are no numbers, none of that type, no mass of it, `hfact` that is not positive.
        """
        h = self.h
        unknown = np.isnan(h)  # only `h <= 0` marks the dead; what is no number was damaged, or written so by a run that failed
        if unknown.any():
            wrong = f"smoothing lengths `h` must be numbers, but {int(unknown.sum())} of {len(h)} are NaN,"
            raise DataError(f"{wrong} the first at index {int(np.argmax(unknown))}; remove these particles, or dump it again")
        said, alive = [*self.left_out], h > 0
        if not alive.all():
            said.append(f"dropped {int((~alive).sum())} dead or accreted particles (h <= 0)")
        part_type = _choose(np.unique(self.kind[alive]), part_type, self.sinks)
        keep = alive & (self.kind == part_type)
        others = int((alive & ~keep).sum())
        if others:
            said.append(f"particles of itype {part_type}; left out {others} of other types")
        if not 1 <= part_type <= len(self.masses):
            raise DataError(f"has no mass for particles of type {part_type}; there are {len(self.masses)} types")
        hfact, mass = self.hfact, float(self.masses[part_type - 1])
        if not 0 < hfact < np.inf:
            raise DataError(f"has `hfact` {hfact:g} in its header, which must be positive: volumes follow from it; dump it again")
        columns, h = {name: column[keep] for name, column in self.columns.items()}, h[keep]
        masses, refined = np.full(len(h), mass), columns.get("apr_level")
        if refined is not None:  # adaptive particle refinement: each level halves the mass
            masses *= 0.5 ** (refined.astype(np.float64) - 1)
            said.append("mass = massoftype / 2^(apr_level - 1) (Phantom's refinement of particles)")
        columns |= {"mass": masses, "density": masses * (hfact / h) ** 3}
        said += [
            "support = 2 x smoothing length h (Phantom convention)",
            "kernel = cubic_spline (Phantom's unless it is compiled with another, which a dump does not say)",
            f"density = mass (hfact / h)^3 and volume = (h / hfact)^3, hfact = {hfact:g} (Phantom convention)",
        ]
        if self.sinks:
            said.append(f"{self.sinks} sink particles are left out: they are part_type {SINKS}")
        more = _of_header(self.header, columns) | {"part_type": part_type, "source": self.source, "kernel": "cubic_spline"}
        volume = (h / hfact) ** 3
        return ParticleTable(self.position[keep], columns, SUPPORT_OVER_H * h, volume, conventions=tuple(said), **more)


def sinks_table(
    source: str, header: Mapping[str, Any], position: np.ndarray, columns: dict[str, np.ndarray], left_out: Sequence[str] = ()
) -> ParticleTable:
    """The sinks of a dump, `m` among their columns; those of negative mass were merged with another and are left out."""
    columns = {"mass" if name == "m" else name: column for name, column in columns.items()}
    said = ["sink particles; h is their accretion radius, and no support", *left_out]
    if "mass" in columns:
        there = ~(columns["mass"] < 0)
        if not there.all():
            said.append(f"dropped {int((~there).sum())} sinks that were merged with others (mass < 0)")
        position, columns = position[there], {name: column[there] for name, column in columns.items()}
    more = _of_header(header, columns) | {"part_type": SINKS, "source": source, "conventions": tuple(said)}
    return ParticleTable(position, columns, **more)


def refuse_no_sinks(number: int) -> None:
    """Refuse a dump without sinks that was asked for them."""
    if not number:
        raise NoParticlesError(f"has no sink particles (type {SINKS})")


def from_hdf5(file: Any, part_type: int | None) -> ParticleTable:
    """The living particles of one type (`itype`; 1 is gas), or the sinks (-1), of an open `h5py.File`.

    Without `part_type` that is gas, or the lowest other type there is.

    Raises `ValueError`: missing data sets, no particles of that type, data sets of other lengths.
    """
    header, group = file["header"], file["particles"]
    for each in (header, group):
        columns_of(each)
    sinks = file.get("sinks", {})
    shape = getattr(sinks["xyz"], "shape", None) if "xyz" in sinks else None
    num_sinks = int(shape[0]) if shape else 0
    if part_type == SINKS:
        refuse_no_sinks(num_sinks)
        position = read_positions(sinks["xyz"])
        return sinks_table(HDF5_SOURCE, header, position, *_columns(sinks, len(position)))
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
    return Dump(HDF5_SOURCE, header, position, columns, h, kind, hfact, masses, num_sinks, said).table(part_type)


def _columns(group: Any, count: int) -> tuple[dict[str, np.ndarray], list[str]]:
    """Columns but positions, and a sentence on each that is left out."""
    return numeric_datasets({name: each for name, each in columns_of(group).items() if name != "xyz"}, count)


def _of_header(header: Mapping[str, Any], columns: Mapping[str, Any]) -> dict[str, Any]:
    return {"units": of_phantom(header, columns), "time": time_of(header["time"][()]) if "time" in header else None}


def _choose(kinds: np.ndarray, part_type: int | None, sinks: int) -> int:
    if part_type is None:
        return GAS if GAS in kinds or not len(kinds) else int(kinds[0])
    if len(kinds) and part_type not in kinds:
        there = [*map(str, kinds), *([f"{SINKS} (sinks)"] if sinks else [])]
        raise DataError(f"has no particles of type {part_type}; `part_type` can be {', '.join(there)}")
    return part_type
