r"""Units that files state, and nothing that they do not.

Flow: HDF5 attributes -> [units] -> FileUnits of a ParticleTable -> `unit_names` -> labels.

| file | where units stand |
|---|---|
| GADGET-4, AREPO | at each data set: `to_cgs`, `length_scaling`, ..., and powers of scale factor a and Hubble parameter h |
| SWIFT | at each data set: `U_L exponent`, ..., `Conversion factor to CGS ...`; those of time in the group `Units` |
| Tipsy, NChilada | in a file of parameters beside them (`param_files`) |
| Phantom | `udist`, `umass`, `utime`, `umagfd` in the header, for xyz, h, vxyz, u, masses, densities, Bxyz |

Numbers are left as stored: where a file states powers of a and h, units carry them, and nothing is multiplied out. Gadget files
without such attributes state units of length, mass and velocity alone (`UnitLength_in_cm`), and not where h is in numbers: these
are taken for the time only, of runs that are not comoving.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

BASE = "cm", "g", "s", "K"
LENGTH, VELOCITY, TIME = (1, 0, 0, 0), (1, 0, -1, 0), (0, 0, 1, 0)
GADGET_SCALINGS = "length_scaling", "mass_scaling", "velocity_scaling"
SWIFT_EXPONENTS = "U_L exponent", "U_M exponent", "U_t exponent", "U_T exponent"
SWIFT_CURRENT = "U_I exponent"
SWIFT_FACTOR = "Conversion factor to CGS (not including cosmological corrections)"
SWIFT_OLD_FACTOR = "Conversion factor to cgs (not including cosmological corrections)"
NO_COSMOLOGY = 1e-6


@dataclasses.dataclass(frozen=True)
class CodeUnit:
    """What 1 in a file is in CGS units: `cgs` times cm, g, s and K to these powers, times powers of a and h that are left in.

    Attributes:
        cgs: > 0.
        powers: of cm, g, s and K.
        a, h: of the scale factor and the Hubble parameter, by which numbers are to be multiplied to become physical.
    """

    cgs: float
    powers: tuple[float, float, float, float]
    a: float = 0.0
    h: float = 0.0

    def over(self, other: CodeUnit, times: float = 1) -> CodeUnit:
        """This one, divided by another to a power."""
        powers = tuple(own - times * its for own, its in zip(self.powers, other.powers, strict=True))
        return CodeUnit(self.cgs / other.cgs**times, powers, self.a - times * other.a, self.h - times * other.h)  # type: ignore[arg-type]


@dataclasses.dataclass(frozen=True)
class FileUnits:
    """Units of a file, as far as it states them, and its moment.

    Attributes:
        length: of positions.
        columns: by the columns' names.
        time: the moment, as stored; `None` where the file has none.
        time_unit: of `time`.
        redshift: of a cosmological run.
    """

    length: CodeUnit | None = None
    columns: Mapping[str, CodeUnit] = dataclasses.field(default_factory=dict)
    time: float | None = None
    time_unit: CodeUnit | None = None
    redshift: float | None = None


NO_UNITS = FileUnits()


def of_gadget(file: Any, group: Any, is_swift: bool) -> FileUnits:
    """Those of an open snapshot of GADGET, AREPO, GIZMO or SWIFT, and of the data sets of one type of particles."""
    read = _swift_unit if is_swift else _gadget_unit
    found = {name: read(dataset.attrs) for name, dataset in group.items() if hasattr(dataset, "shape")}
    columns = {name: unit for name, unit in found.items() if unit is not None}
    parts = {name: file[name].attrs for name in ("Header", "Parameters", "Units", "Cosmology") if name in file}
    header, parameters = parts.get("Header", {}), parts.get("Parameters", {})
    time, redshift = _number(header, "Time"), _number(header, "Redshift")
    comoving = bool(_number(parameters, "ComovingIntegrationOn")) or bool(_number(parts.get("Cosmology", {}), "Cosmological run"))
    comoving = comoving or (redshift or 0) > NO_COSMOLOGY
    unit = _swift_time(parts.get("Units", {})) if is_swift else _gadget_time([header, parameters, parts.get("Units", {})])
    cosmic_time = is_swift  # GADGET's time is the scale factor in comoving runs
    return FileUnits(
        columns.pop("Coordinates", None),
        columns,
        time if cosmic_time or not comoving else None,
        unit if cosmic_time or not comoving else None,
        redshift if comoving else None,
    )


def of_phantom(header: Any, columns: Mapping[str, Any]) -> FileUnits:
    """Those of an open dump, `header` its group."""
    names = "udist", "umass", "utime"
    found = [_dataset(header, name) for name in names]
    time = _dataset(header, "time")
    if any(value is None or not value > 0 for value in found):
        return FileUnits(time=time)
    powers = LENGTH, (0, 1, 0, 0), TIME
    length, mass, second = (CodeUnit(float(value or 1), power) for value, power in zip(found, powers, strict=True))
    velocity = length.over(second)
    known = {"h": length, "vxyz": velocity, "u": velocity.over(velocity, -1), "mass": mass, "density": mass.over(length, 3)}
    field = _dataset(header, "umagfd")
    if field is not None and field > 0:
        known["Bxyz"] = CodeUnit(field, (-0.5, 0.5, -1, 0))
    return FileUnits(length, {name: unit for name, unit in known.items() if name in columns}, time, second)


def _gadget_unit(attributes: Any) -> CodeUnit | None:
    scalings = [_number(attributes, name) for name in (*GADGET_SCALINGS, "to_cgs", "a_scaling", "h_scaling")]
    if any(value is None for value in scalings):
        return None
    length, mass, velocity, cgs, a, h = (float(value or 0) for value in scalings)
    return CodeUnit(cgs, (length + velocity, mass, -velocity, 0.0), a, h) if cgs > 0 else None


def _swift_unit(attributes: Any) -> CodeUnit | None:
    cgs = _number(attributes, SWIFT_FACTOR)
    cgs = _number(attributes, SWIFT_OLD_FACTOR) if cgs is None else cgs
    powers = [_number(attributes, name) for name in SWIFT_EXPONENTS]
    if cgs is None or not cgs > 0 or any(power is None for power in powers) or _number(attributes, SWIFT_CURRENT):
        return None
    length, mass, time, temperature = (float(power or 0) for power in powers)
    a, h = (_number(attributes, name) or 0.0 for name in ("a-scale exponent", "h-scale exponent"))
    return CodeUnit(cgs, (length, mass, time, temperature), a, h)


def _swift_time(units: Any) -> CodeUnit | None:
    cgs = _number(units, "Unit time in cgs (U_t)")
    return None if cgs is None or not cgs > 0 else CodeUnit(cgs, TIME)


def _gadget_time(holders: list[Any]) -> CodeUnit | None:
    """Of length over velocity, where no Hubble parameter can be in it."""
    length, velocity, hubble = (
        next((value for value in (_number(holder, name) for holder in holders) if value is not None), None)
        for name in ("UnitLength_in_cm", "UnitVelocity_in_cm_per_s", "HubbleParam")
    )
    if length is None or velocity is None or not (length > 0 and velocity > 0) or hubble not in (None, 0.0, 1.0):
        return None
    return CodeUnit(length / velocity, TIME)


def _number(attributes: Any, name: str) -> float | None:
    """An attribute that is one number, or an array of one."""
    if name not in attributes:
        return None
    stored = np.ravel(np.asarray(attributes[name]))
    if len(stored) < 1 or stored.dtype.kind not in "iufb" or not np.isfinite(stored[0]):
        return None
    return float(stored[0])


def _dataset(group: Any, name: str) -> float | None:
    return _number({name: group[name][()]}, name) if name in group and hasattr(group[name], "shape") else None
