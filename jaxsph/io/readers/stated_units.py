r"""Units that files state, and nothing that they do not.

Flow: attributes of HDF5, `run.param` -> [stated_units] -> FileUnits of a ParticleTable.

| file | where units stand |
|---|---|
| GADGET-4, AREPO | at each data set: `to_cgs`, `length_scaling`, ..., and powers of scale factor a and Hubble parameter h |
| SWIFT | at each data set: `U_L exponent`, ..., `Conversion factor to CGS ...`; those of time in the group `Units` |
| Phantom | `udist`, `umass`, `utime`, `umagfd` in the header, for xyz, h, vxyz, u, masses, densities, Bxyz |
| Tipsy, NChilada (ChaNGa, Gasoline) | in a file of parameters beside them, in lines `key = value` with comments from `#` on |

Gadget files without such attributes state units of length, mass and velocity alone (`UnitLength_in_cm`), and not where h is in
numbers: these are taken for the time only, of runs that are not comoving.

In a file of parameters `dKpcUnit` and `dMsolUnit` are the units of length and mass in kpc and solar masses; the gravitational
constant is 1, so that the unit of time is $\sqrt{L^3 / (G M)}$. Temperatures are in K. With `bComove` positions and velocities
are comoving, and the time of a snapshot is the scale factor. Source: the documentation of ChaNGa, University of Washington N-Body
Shop.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from jaxsph.io.table import plain
from jaxsph.io.units import LENGTH, MASS, TEMPERATURE, TIME, CodeUnit, FileUnits

GADGET_SCALINGS = "length_scaling", "mass_scaling", "velocity_scaling"
SWIFT_EXPONENTS = "U_L exponent", "U_M exponent", "U_t exponent", "U_T exponent"
SWIFT_CURRENT = "U_I exponent"
SWIFT_FACTOR = "Conversion factor to CGS (not including cosmological corrections)"
SWIFT_OLD_FACTOR = "Conversion factor to cgs (not including cosmological corrections)"
NO_COSMOLOGY = 1e-6
KPC = 3.0856775814913673e21
SOLAR_GRAVITY = 1.3271244e26  # G times the mass of the Sun, cm^3 s^-2, which is known better than either
SOLAR_MASS = SOLAR_GRAVITY / 6.6743e-8
MIN_UNIT, MAX_UNIT = 1e-40, 1e40  # kpc and solar masses of a unit: beyond, densities leave the range of numbers
MAX_BYTES = 2**20
MAX_FILES = 256
LENGTHS = "hsmooth", "eps", "soft", "softening", "smoothlength"
DENSITIES = "rho", "den", "density", "gasdensity"
VELOCITIES = "velocity", "vel"
TEMPERATURES = "temp", "temperature"
POTENTIALS = "phi", "pot"


def units_beside(path: Path, columns: Iterable[str], time: float) -> tuple[FileUnits, list[str]]:
    """Units of a snapshot's positions and columns as the file of parameters beside it has them, and sentences on that.

    The file is the one whose `achOutName` is the name of the snapshot, or the only one in the folder. Where there is none, or
    its units are no positive numbers, there are no units.
    """
    file, said = _chosen(path)
    if file is None:
        return FileUnits(), said
    keys = _keys(file)
    if keys is None:
        return FileUnits(), [f"units are not known: {file.name} cannot be read"]
    kpc, solar = (_stated(keys.get(name)) for name in ("dKpcUnit", "dMsolUnit"))
    for name, value in (("dKpcUnit", kpc), ("dMsolUnit", solar)):
        if value is None or not MIN_UNIT <= value <= MAX_UNIT:
            stated = "is missing" if name not in keys else f"is {keys[name][:40]!r}"
            wanted = f"a number in {MIN_UNIT:g} .. {MAX_UNIT:g}"
            return FileUnits(), [f"units are not known: {name} of {file.name} {stated}, and must be {wanted}"]
    assert kpc is not None and solar is not None
    comoving = (_stated(keys.get("bComove")) or 0) != 0
    said = [f"units of {file.name}: dKpcUnit = {kpc:g}, dMsolUnit = {solar:g}{', comoving' * comoving}"]
    if (_stated(keys.get("bPeriodic")) or 0) != 0:
        period = keys.get("dPeriod", "1")[:40]
        said.append(f"{file.name} has bPeriodic, with a period of {period}: it is not used; pass `box=` for supports across it")
    return _units(kpc, solar, comoving, columns, time), said


def _units(kpc: float, solar: float, comoving: bool, columns: Iterable[str], time: float) -> FileUnits:
    length, mass = CodeUnit(kpc * KPC, LENGTH, float(comoving)), CodeUnit(solar * SOLAR_MASS, MASS)
    second = CodeUnit(math.sqrt((kpc * KPC) ** 3 / (solar * SOLAR_GRAVITY)), TIME)
    velocity = length.over(second)
    of = dict.fromkeys(LENGTHS, length) | dict.fromkeys(DENSITIES, mass.over(length, 3)) | dict.fromkeys(VELOCITIES, velocity)
    of |= dict.fromkeys(TEMPERATURES, CodeUnit(1.0, TEMPERATURE)) | {"mass": mass}
    if not comoving:
        of |= dict.fromkeys(POTENTIALS, velocity.over(velocity, -1)) | {"tform": second}
    found = {name: of[plain(name)] for name in columns if plain(name) in of}
    if not comoving:
        return FileUnits(length, found, time if math.isfinite(time) else None, second)
    redshift = 1 / time - 1 if time > 0 else math.nan
    return FileUnits(length, found, redshift=redshift if math.isfinite(redshift) else None)


def _chosen(path: Path) -> tuple[Path | None, list[str]]:
    """The file of parameters of a snapshot, or why there is none."""
    path = path.absolute()
    try:
        files = sorted(file for file in path.parent.glob("*.param") if file.is_file())
    except OSError:
        return None, []
    if len(files) <= 1:
        return (files[0] if files else None), []
    outputs = {file: PurePosixPath((_keys(file) or {}).get("achOutName", "").strip("\"'")).name for file in files[:MAX_FILES]}
    own = [file for file, name in outputs.items() if name and (path.name == name or path.name.startswith(name + "."))]
    if len(own) == 1:
        return own[0], []
    which = "none" if not own else f"{len(own)}"
    return None, [f"units are not known: there are {len(files)} .param files beside it, and {which} of them has it as achOutName"]


def _stated(text: str | None) -> float | None:
    """A finite number as text, or `None`."""
    with contextlib.suppress(ValueError):
        value = float(text or "")
        return value if math.isfinite(value) else None
    return None


def _keys(file: Path) -> dict[str, str] | None:
    """Keys and values as they stand there; `None` where the file cannot be read, or is no file of parameters by its size."""
    with contextlib.suppress(OSError):
        if file.stat().st_size > MAX_BYTES:
            return None
        lines = file.read_bytes().decode("utf-8", "replace").splitlines()
        pairs = (line.split("#")[0].partition("=") for line in lines)
        return {key.strip(): value.strip() for key, equals, value in pairs if equals}
    return None


def of_gadget(file: Any, group: Any, is_swift: bool) -> FileUnits:
    """Those of an open snapshot of GADGET, AREPO, GIZMO or SWIFT, and of the data sets of one type of particles."""
    read = _swift_unit if is_swift else _gadget_unit
    columns = {}
    for name, dataset in group.items():
        if hasattr(dataset, "shape") and (unit := read(dataset.attrs)) is not None:
            bare = plain(name) in TEMPERATURES and not any(unit.powers)  # in kelvin: attributes of GADGET-4 have no power of one
            columns[name] = dataclasses.replace(unit, powers=TEMPERATURE) if bare else unit
    parts = {name: file[name].attrs for name in ("Header", "Parameters", "Units", "Cosmology") if name in file}
    header, parameters = parts.get("Header", {}), parts.get("Parameters", {})
    time, redshift = number_of(header, "Time"), number_of(header, "Redshift")
    told = number_of(parameters, "ComovingIntegrationOn"), number_of(parts.get("Cosmology", {}), "Cosmological run")
    comoving = any(told) or (redshift or 0) > NO_COSMOLOGY
    if is_swift:
        second = number_of(parts.get("Units", {}), "Unit time in cgs (U_t)")
        unit = CodeUnit(second, TIME) if second is not None and second > 0 else None
    else:
        unit = None if comoving else _gadget_time([header, parameters, parts.get("Units", {})])
        time = None if comoving else time  # the scale factor in comoving runs
    return FileUnits(columns.pop("Coordinates", None), columns, time, unit, redshift if comoving else None)


def of_phantom(header: Any, columns: Mapping[str, Any]) -> FileUnits:
    """Those of an open dump, `header` its group."""
    found = {name: _dataset(header, name) for name in ("udist", "umass", "utime")}
    time = _dataset(header, "time")
    if any(value is None or not value > 0 for value in found.values()):
        return FileUnits(time=time)
    units = zip(found.values(), (LENGTH, MASS, TIME), strict=True)
    length, mass, second = (CodeUnit(float(value or 1), power) for value, power in units)
    velocity = length.over(second)
    known = {"h": length, "vxyz": velocity, "u": velocity.over(velocity, -1), "mass": mass, "density": mass.over(length, 3)}
    field = _dataset(header, "umagfd")
    if field is not None and field > 0:
        known["Bxyz"] = CodeUnit(field, (-0.5, 0.5, -1, 0))
    return FileUnits(length, {name: unit for name, unit in known.items() if name in columns}, time, second)


def _gadget_unit(attributes: Any) -> CodeUnit | None:
    scalings = [number_of(attributes, name) for name in (*GADGET_SCALINGS, "to_cgs", "a_scaling", "h_scaling")]
    if any(value is None for value in scalings):
        return None
    length, mass, velocity, cgs, a, h = (float(value or 0) for value in scalings)
    return CodeUnit(cgs, (length + velocity, mass, -velocity, 0.0), a, h) if cgs > 0 else None


def _swift_unit(attributes: Any) -> CodeUnit | None:
    cgs = number_of(attributes, SWIFT_FACTOR)
    cgs = number_of(attributes, SWIFT_OLD_FACTOR) if cgs is None else cgs
    powers = [number_of(attributes, name) for name in SWIFT_EXPONENTS]
    if cgs is None or not cgs > 0 or any(power is None for power in powers) or number_of(attributes, SWIFT_CURRENT):
        return None
    length, mass, time, temperature = (float(power or 0) for power in powers)
    a, h = (number_of(attributes, name) or 0.0 for name in ("a-scale exponent", "h-scale exponent"))
    return CodeUnit(cgs, (length, mass, time, temperature), a, h)


def _gadget_time(holders: list[Any]) -> CodeUnit | None:
    """Of length over velocity, where no Hubble parameter can be in it."""
    length, velocity, hubble = (
        next((value for value in (number_of(holder, name) for holder in holders) if value is not None), None)
        for name in ("UnitLength_in_cm", "UnitVelocity_in_cm_per_s", "HubbleParam")
    )
    if length is None or velocity is None or not (length > 0 and velocity > 0) or hubble not in (None, 0.0, 1.0):
        return None
    return CodeUnit(length / velocity, TIME)


def number_of(attributes: Any, name: str) -> float | None:
    """An attribute that is one number, or an array of one."""
    stored = numbers_of(attributes, name)
    return float(stored[0]) if len(stored) and np.isfinite(stored[0]) else None


def numbers_of(attributes: Any, name: str) -> np.ndarray:
    """An attribute as an array of its numbers; of what is none, as HDF5's `Empty`, an empty one."""
    stored = np.ravel(np.asarray(attributes.get(name, ())))
    return stored if stored.dtype.kind in "iufb" else np.zeros(0)


def _dataset(group: Any, name: str) -> float | None:
    return number_of({name: group[name][()]}, name) if name in group and hasattr(group[name], "shape") else None
