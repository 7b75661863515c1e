r"""Units that files state: what 1 in a file is in CGS, and numbers without the scale factor and the Hubble parameter.

Flow: attributes of HDF5, a file of parameters -> [file_units: of_gadget, of_phantom, units_beside] -> FileUnits of a table;
[without_cosmology] -> a table of physical numbers.

Numbers are left as stored: where a file states powers of the scale factor a and the Hubble parameter h, units carry them, and
nothing is multiplied out, unless physical numbers are asked for. What a file does not state is in code units.

| file | where units stand |
|---|---|
| GADGET-4, AREPO | at each data set: `to_cgs`, `length_scaling`, ..., and powers of scale factor a and Hubble parameter h |
| SWIFT | at each data set: `U_L exponent`, ..., `Conversion factor to CGS ...`; those of time in the group `Units` |
| Phantom | `udist`, `umass`, `utime`, `umagfd` in the header, for xyz, h, vxyz, u, masses, densities, Bxyz |
| Tipsy, NChilada (ChaNGa, Gasoline) | in a file of parameters beside them, in lines `key = value` with comments from `#` on |

Where SWIFT says `Value stored as physical`, or a run that it is not comoving, no power of a is in numbers, whatever is stated.

Gadget files without such attributes state units of length, mass and velocity alone (`UnitLength_in_cm`): their usual columns have
those that follow, with the usual powers of a and h; the time has one where no h can be in it, of runs that are not comoving.

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

from jaxsph.io.damage import DataError
from jaxsph.io.table import LENGTH, MASS, TEMPERATURE, TIME, VELOCITY, CodeUnit, FileUnits, ParticleTable, plain, single_number
from jaxsph.io.units import LENGTHS, SAME, powers_left

GADGET_SCALINGS = "length_scaling", "mass_scaling", "velocity_scaling"
SWIFT_EXPONENTS = "U_L exponent", "U_M exponent", "U_t exponent", "U_T exponent"
SWIFT_CURRENT = "U_I exponent"
SWIFT_PHYSICAL, SWIFT_CONVERTIBLE = "Value stored as physical", "Property can be converted to comoving"
SWIFT_FACTOR = "Conversion factor to CGS (not including cosmological corrections)"
SWIFT_OLD_FACTOR = "Conversion factor to cgs (not including cosmological corrections)"
NO_COSMOLOGY = 1e-6
NOT_COSMOLOGICAL = "physical: nothing changes, as the file states no redshift of a cosmological run"
USUAL = {
    "coordinates smoothinglength hsml": (1, -1),
    "masses mass": (0, -1),
    "density rho": (-3, 2),
    "velocities velocity": (0.5, 0),
}
USUALLY = {name: powers for names, powers in USUAL.items() for name in names.split()}
GADGET = {name: CodeUnit(1.0, (0, 0, 0, 0), *powers) for name, powers in USUALLY.items()}
"""Powers of a and h that numbers of the Gadget family have where a file states none (Springel 2005, users' guide of GADGET-2)."""
KPC = LENGTHS["kpc"]
OF_SPEED = "UnitVelocity_in_cm_per_s", "UnitVelocity_In_CGS"
SOLAR_GRAVITY = 1.3271244e26  # G times the mass of the Sun, cm^3 s^-2, which is known better than either
SOLAR_MASS = SOLAR_GRAVITY / 6.6743e-8
MIN_UNIT, MAX_UNIT = 1e-40, 1e40  # kpc and solar masses of a unit: beyond, densities leave the range of numbers
MAX_BYTES = 2**20
MAX_FILES = 256
OF_GAS = {
    "gamma": ("Adiabatic index", "GAMMA", "Gamma", "gamma", "AdiabaticIndex"),
    "hydrogen": ("Hydrogen mass fraction", "HydrogenMassFraction", "HYDROGEN_MASSFRAC"),
    "mu": ("gmw",),
}
"""By which names files state the adiabatic index, the mass fraction of hydrogen, and the mean molecular weight."""
OF_LENGTH = "hsmooth", "eps", "soft", "softening", "smoothlength"
OF_DENSITY = "rho", "den", "density", "gasdensity"
OF_VELOCITY = "velocity", "vel"
OF_TEMPERATURE = "temp", "temperature"
OF_POTENTIAL = "phi", "pot"


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
    of = dict.fromkeys(OF_LENGTH, length) | dict.fromkeys(OF_DENSITY, mass.over(length, 3)) | dict.fromkeys(OF_VELOCITY, velocity)
    of |= dict.fromkeys(OF_TEMPERATURE, CodeUnit(1.0, TEMPERATURE)) | {"mass": mass}
    if not comoving:
        of |= dict.fromkeys(OF_POTENTIAL, velocity.over(velocity, -1)) | {"tform": second}
    known = {name: of[plain(name)] for name in columns if plain(name) in of}
    if not comoving:
        return FileUnits(length, known, time if math.isfinite(time) else None, second)
    redshift = 1 / time - 1 if time > 0 else math.nan
    return FileUnits(length, known, redshift=redshift if math.isfinite(redshift) else None)


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
            bare = plain(name) in OF_TEMPERATURE and not any(unit.powers)  # in kelvin, of which GADGET-4 states no power
            columns[name] = dataclasses.replace(unit, powers=TEMPERATURE) if bare else unit
    holders = [attributes_of(file, name) for name in ("Header", "Parameters", "Units", "Cosmology", "HydroScheme", "Config")]
    header, parameters, base, cosmology, *_ = holders
    time, redshift = number_of(header, "Time"), number_of(header, "Redshift")
    stated = number_of(cosmology, "h"), *(number_of(part, "HubbleParam") for part in (header, parameters))
    hubble = next(filter(None, stated), None)
    runs = [number_of(part, "ComovingIntegrationOn") for part in (header, parameters)]
    runs.append(number_of(cosmology, "Cosmological run"))
    # where no run is stated, one of today is known by its matter, its Hubble parameter, and a time that is a scale factor
    matter = number_of(header, "Omega0") or number_of(header, "Omega_Matter")
    is_today = redshift is not None and abs((time or 0) - 1) <= NO_COSMOLOGY and bool(matter) and hubble not in (None, 1)
    comoving = any(runs) or (redshift or 0) > NO_COSMOLOGY or (runs == [None] * 3 and is_today)
    if is_swift:
        second = number_of(base, "Unit time in cgs (U_t)")
        unit = CodeUnit(second, TIME) if second is not None and second > 0 else None
    else:
        usual, unit = _gadget_units(holders[:3], (*group, "Masses"), comoving)
        time, columns = None if comoving else time, usual | columns  # the scale factor in comoving runs
    if not comoving and 0 in runs:
        columns = {name: dataclasses.replace(one, a=0.0) for name, one in columns.items()}
    gas = {of: value for of, names in OF_GAS.items() for name in names if (value := first_of(holders, name)) is not None}
    return FileUnits(columns.pop("Coordinates", None), columns, time, unit, redshift if comoving else None, hubble, gas)


def first_of(holders: Iterable[Any], name: str) -> float | None:
    """A number > 0 that the first of some groups of attributes states."""
    return next((value for holder in holders if (value := number_of(holder, name)) is not None and value > 0), None)


def without_cosmology(table: ParticleTable) -> ParticleTable:
    """A table without the scale factor a and the Hubble parameter h in its numbers, by the powers that its file states.

    Where a file of the Gadget family states none of a column, those of its convention are taken: positions and supports a / h,
    masses 1 / h, densities h^2 / a^3, velocities sqrt(a). What was done is said.
    """
    units, a = table.units, 1 / (1 + (table.units.redshift or 0))
    if units.redshift is None:
        return table.with_notes(NOT_COSMOLOGICAL)
    usual = GADGET if table.source.startswith("Gadget") else {}
    known = {name: unit for name in table.columns if (unit := units.columns.get(name) or usual.get(plain(name)))}
    length = units.length or usual.get("hsml") or CodeUnit(1.0, LENGTH)
    changed = {name: unit for name, unit in ({"positions": length} | known).items() if unit.a or unit.h}
    if units.hubble is None and any(unit.h for unit in changed.values()):
        raise DataError("has powers of the Hubble parameter in its numbers, but does not state it; leave out `physical`")

    factors = {name: a**unit.a * (units.hubble or 1) ** unit.h for name, unit in changed.items()}
    columns = {name: column * factors.get(name, 1) for name, column in table.columns.items()}
    scale = factors.get("positions", 1)
    lengths = {
        "position": table.position * scale,
        "support": None if table.support is None else table.support * scale,
        "volume": None if table.volume is None else table.volume * scale**3,
        "box_size": None if table.box_size is None else tuple(side * scale for side in table.box_size),
    }
    bare = {name: dataclasses.replace(unit, a=0.0, h=0.0) for name, unit in units.columns.items()}
    own = dataclasses.replace(units, columns=bare, length=units.length and dataclasses.replace(units.length, a=0.0, h=0.0))
    of_h = f" and h = {units.hubble:g}" if any(unit.h for unit in changed.values()) else ""
    told = ", ".join(f"{name} ({powers_left(unit)})" for name, unit in changed.items())
    left = ", ".join(name for name, column in columns.items() if name not in known and column.dtype.kind == "f")
    said = f"physical: a = {a:.6g}{of_h} taken out of {told}" + (f"; left as stored: {left}" if left else "")
    return dataclasses.replace(table, **lengths, columns=columns, units=own, conventions=(*table.conventions, said))


def between(unit: CodeUnit | None, other: CodeUnit | None, units: FileUnits) -> float:
    """What a file's numbers in one unit are multiplied by to be in another of the same dimension; 1 where either is not known."""
    if unit is None or other is None or unit.powers != other.powers:
        return 1.0
    factor = units.physical(unit.over(other))
    return factor if abs(factor - 1) > SAME else 1.0


def of_phantom(header: Any, columns: Mapping[str, Any]) -> FileUnits:
    """Those of an open dump, `header` its group."""
    stated = {name: number_of(header, name) for name in ("udist", "umass", "utime")}
    time = number_of(header, "time")
    gas = {of: value for of, name in (("gamma", "gamma"), ("mu", "gmw")) if (value := first_of([header], name)) is not None}
    if any(value is None or not value > 0 for value in stated.values()):
        return FileUnits(time=time, gas=gas)
    units = zip(stated.values(), (LENGTH, MASS, TIME), strict=True)
    length, mass, second = (CodeUnit(float(value or 1), power) for value, power in units)
    velocity = length.over(second)
    known = {"h": length, "vxyz": velocity, "u": velocity.over(velocity, -1), "mass": mass, "density": mass.over(length, 3)}
    field = number_of(header, "umagfd")
    if field is not None and field > 0:
        known["Bxyz"] = CodeUnit(field, (-0.5, 0.5, -1, 0))
    return FileUnits(length, {name: unit for name, unit in known.items() if name in columns}, time, second, gas=gas)


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
    if number_of(attributes, SWIFT_PHYSICAL) or number_of(attributes, SWIFT_CONVERTIBLE) == 0:
        a = h = 0.0  # the exponents say how comoving numbers are made of these
    return CodeUnit(cgs, (length, mass, time, temperature), a, h)


def _gadget_units(holders: list[Any], names: Iterable[str], comoving: bool) -> tuple[dict[str, CodeUnit], CodeUnit | None]:
    """Of columns by their names, where base units are stated, but not those of each column: as the Gadget family has them; and of
    times, where no Hubble parameter can be in them.
    """
    bases = ("UnitLength_in_cm", "UnitLength_In_CGS"), ("UnitMass_in_g", "UnitMass_In_CGS"), OF_SPEED
    stated = [[number_of(holder, name) for holder in holders for name in base] for base in bases]
    length, mass, speed = (next(filter(None, found), 0.0) for found in stated)
    is_scaled = any(number_of(holder, "HubbleParam") not in (None, 0.0, 1.0) for holder in holders)
    second = CodeUnit(length / speed, TIME) if min(length, speed) > 0 and not (comoving or is_scaled) else None
    if not min(length, mass, speed) > 0:
        return {}, second
    squared: Any = tuple(2 * power for power in VELOCITY)
    of = dict.fromkeys(("coordinates", "smoothinglength", "hsml"), (length, LENGTH)) | {"masses": (mass, MASS)}
    of |= {"velocities": (speed, VELOCITY), "internalenergy": (speed**2, squared)}
    known = {name: CodeUnit(*unit, *USUALLY.get(name, (0.0, 0.0))) for name, unit in of.items()}
    known["density"] = known["masses"].over(known["coordinates"], 3)
    found = {name: known[plain(name)] for name in names if plain(name) in known}
    return {name: CodeUnit(one.cgs, one.powers, one.a * comoving, one.h * is_scaled) for name, one in found.items()}, second


def attributes_of(file: Any, name: str) -> Any:
    """The attributes of a group at the top of an open file; none of one that is not there."""
    return file[name].attrs if name in file else {}


def number_of(attributes: Any, name: str) -> float | None:
    """An attribute, or a data set of a group, that is one number, or an array of one."""
    return single_number(attributes.get(name, ()))


def numbers_of(attributes: Any, name: str) -> np.ndarray:
    """An attribute as an array of its numbers; of what is none, as HDF5's `Empty`, an empty one."""
    stored = np.ravel(np.asarray(attributes.get(name, ())))
    return stored if stored.dtype.kind in "iufb" else np.zeros(0)
