r"""Units: what 1 in a file is, as far as the file states it, by which name people call that, and what a picture's key says of it.

Flow: attributes of HDF5, `run.param` -> [units: of_gadget, of_phantom, units_beside] -> FileUnits of a ParticleTable ->
[units: labels_of, named] -> colour bar, scale bar and time of a figure.

Numbers are left as stored: where a file states powers of the scale factor a and the Hubble parameter h, units carry them, and
nothing is multiplied out, unless `physical` is asked for. What a file does not state is in code units.

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

Units are read as people write them, `1e10 Msun pc^-2`, `solMass/pc2`, `km s-1`, `cm⁻³`; names, whole or fractional powers, `*`
and `/` of these get through: `unyt` evaluates what it is given as code.
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import keyword
import math
import re
from collections.abc import Iterable, Mapping
from fractions import Fraction
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError, require
from jaxsph.io.settle.quantities import unit_of
from jaxsph.io.table import (
    LENGTH,
    MASS,
    PURE,
    TEMPERATURE,
    TIME,
    VELOCITY,
    CodeUnit,
    FileUnits,
    ParticleTable,
    plain,
    single_number,
)
from jaxsph.numerics.names import did_you_mean

CODE_UNITS = "code units"
NEEDS = 'the file states units, but naming them needs the library `unyt`: pip install "jaxsph[units]"'
BASE, DIMENSIONS = ("cm", "g", "s", "K"), ("length", "mass", "time", "temperature")
LENGTHS = {"cm": 1.0, "mm": 0.1, "m": 1e2, "km": 1e5, "AU": 1.495978707e13}
LENGTHS |= {f"{prefix}pc": 3.0856775814913673e18 * size for prefix, size in (("", 1), ("k", 1e3), ("M", 1e6), ("G", 1e9))}
"""In cm."""
SAME = 3e-5  # relative difference of a unit to one that it may be called after: codes have constants of four or five digits
READABLE: dict[tuple[float, ...], tuple[str, ...]] = {
    LENGTH: ("cm", "m", "km", "Rsun", "AU", "pc", "kpc", "Mpc", "Gpc"),
    TIME: ("s", "hr", "day", "yr", "kyr", "Myr", "Gyr"),
    VELOCITY: ("cm/s", "m/s", "km/s"),
    MASS: ("g", "kg", "Msun"),
    TEMPERATURE: ("K",),
    (-0.5, 0.5, -1, 0): ("G",),
    (-2, 0, 0, 0): ("Mpc^-2", "kpc^-2", "pc^-2", "cm^-2"),
    (2, 0, -2, 0): ("erg/g",),
}  # names by dimension, from small to large; of other dimensions units are cm, g, s and K to powers
COLUMN: tuple[float, ...] = (-2, 1, 0, 0)  # of mass
LARGE = 0.03 * LENGTHS["pc"]  # unit of lengths from which columns of mass are in solar masses
WORD = re.compile(r"(/?)\s*([^\s*/^()]+)(?:\s*(?:\*\*|\^)\s*\(?\s*([-+]?[\d./]+)\)?)?")
MAX_LENGTH = 100  # characters of a unit
MAX_POWER = 12  # of a name: no quantity has more, and larger ones overflow
NAME = r"[^\W\d_][^\W_]{0,19}(?:_[^\W_]{1,19})?"
POWER = r"(?:[-+]?\d{1,2}(?:\.\d{1,4})?|\(\s*[-+]?\d{1,2}(?:\.\d{1,4}|\s*/\s*\d{1,2})?\s*\))"
FACTOR = re.compile(rf"\s*({NAME})\s*(?:(?:\*\*|\^)\s*({POWER}))?\s*")
UNIT = re.compile(rf"(?:\s*1\s*/)?(?>{FACTOR.pattern})(?:[*/](?>{FACTOR.pattern}))*")
NUMBER = re.compile(r"\s*(?:10(?:\*\*|\^)\(?([-+]?\d{1,2})\)?|((?>\d+\.?\d*(?:[eE][-+]?\d{1,2})?)))[\s*]*(?=[^\W\d])")
SUN = re.compile(r"sol([MRL])[a-z]+|([MRL])_?(?:sun|sol|[⊙☉])")
RAISED = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺", "0123456789-+")
MEASURED = re.compile(r"(?<![\w.])((?>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?))\s*(?!(?:and|or|not)\b)([^\W\d_]\w*)")
"""A length with its unit, as `100 pc`, among others or in an expression."""
NO_NAMES = frozenset(keyword.kwlist) | {"sqrt", "Symbol", "Integer", "Float", "Rational"}
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


@dataclasses.dataclass(frozen=True)
class Labels:
    """What axes and bars of a figure are called.

    Attributes:
        quantity: full name of what is shown; `log10:NAME` is shown as NAME on a logarithmic axis.
        unit: of the quantity, with powers as in `g cm^-3`.
        factor: numbers in that unit, over those of the quantity (of `log10:NAME`, of NAME).
        length: unit of positions as the file states it; `None` is code units.
        length_unit: the name of a unit that lengths are told in; `None` chooses by their size.
        moment: the time, in words.
        opacity: full name of what extinction is looked up by, where that is another.
        weight: what a mean along rays is weighted by.
    """

    quantity: str = "quantity"
    unit: str = CODE_UNITS
    factor: float = 1.0
    length: CodeUnit | None = None
    length_unit: str | None = None
    moment: str = ""
    opacity: str = "its own quantity"
    weight: str = ""

    @classmethod
    def of(cls, given: Labels | str) -> Labels:
        """Labels, of which one may give the name of the quantity alone."""
        return given if isinstance(given, Labels) else cls(quantity=str(given))

    def length_as(self, magnitude: float) -> tuple[float, str]:
        """Factor and name of the unit that a length of this size, in code units, is told in."""
        return (1.0, CODE_UNITS) if self.length is None else named(self.length, magnitude, self.length_unit)


def labels_of(
    table: ParticleTable, quantity: str, magnitude: float = 1.0, *, unit: str | None = None, length_unit: str | None = None
) -> Labels:
    """Labels of a picture of a quantity of a file, in units as far as the file states them and `unyt` is there to name them.

    Args:
        table: what was read.
        quantity: its full name, as `particles_from_table` reports it.
        magnitude: its largest value (of `log10:NAME`, of NAME), by which a readable unit is chosen.
        unit: a unit instead, such as `"Msun/kpc**3"`.
        length_unit: a unit of lengths, such as `"kpc"`.

    Raises:
        ImportError: a unit is asked for, and unyt is not installed.
        ValueError: a unit is asked for of what has none in the file, or one that does not agree with it.
    """
    code, length = unit_of(table, quantity), table.units.length
    for what, asked, there in ((f"`{quantity}`", unit, code), ("lengths", length_unit, length)):
        if asked is not None and there is None:
            raise ValueError(f"the unit {asked!r} cannot be used, as the file does not state that of {what}; leave it out")
    if not can_name() and unit is None and length_unit is None:
        return Labels(quantity, moment=moment_of(table.units))
    factor, name = (1.0, CODE_UNITS) if code is None else named(code, magnitude, unit, length)
    if length is not None and length_unit is not None:
        named(length, 1.0, length_unit)  # refuses what does not agree before anything is drawn
    return Labels(quantity, name, factor, length, length_unit, moment_of(table.units))


def labels_said(quantity: str, unit: str, length: str, magnitude: float) -> Labels:
    """The same of values whose units are told in text, as those of a projection: as `written` has them, or as people do."""
    code, stated = read_unit(unit), read_unit(length)
    as_told = code is None or any(name[0].isalpha() and name not in (*BASE, "a", "h") for name, _ in factors(unit))
    factor, name = (1.0, unit or CODE_UNITS) if code is None or as_told else named(code, magnitude, None, stated)
    return Labels(quantity, name, factor, stated)


def moment_of(units: FileUnits) -> str:
    """The time in words: redshift of a cosmological run, else the time in a unit as far as it is known; empty without any."""
    parts = []
    if units.redshift is not None:
        parts.append(f"z = {units.redshift:.4g}")
    if units.time is not None:
        factor, name = (1.0, f"({CODE_UNITS})")
        if units.time_unit is not None and can_name():
            factor, name = named(units.time_unit, units.time)
        parts.append(f"t = {units.time * factor:.4g} {name}")
    return ", ".join(parts)


def can_name() -> bool:
    """Whether `unyt` is installed."""
    return importlib.util.find_spec("unyt") is not None


def factors(unit: str) -> list[tuple[str, str]]:
    """Names of a unit and their powers, as text: of `g*cm**-2`, `Msun/kpc^2`, `erg cm^-3` or `kpc a h^-1`."""
    found = []
    for over, name, power in WORD.findall(re.sub(r"\((\w+)\)", r"\1", unit)):  # a name alone needs no parentheses
        if name != "1":
            found.append((name, (power or "1") if not over else power[1:] if power.startswith("-") else f"-{power or 1}"))
    return found


def read_unit(text: str) -> CodeUnit | None:
    """The unit of a text that `written` made, or that names units; `None` where it is none, empty, or unyt is not there."""
    if not text or not can_name():
        return None
    scale, text = respelled(text)
    found = factors(text)
    a, h = (sum(float(Fraction(power)) for name, power in found if name == left) for left in "ah")
    number = [name for name, _ in found if name[0].isdigit()]
    names = "*".join(f"{name}**({power})" for name, power in found if name not in ("a", "h", *number))
    try:
        unyt = require("unyt", "units by name", "units")
        unit = unyt.Unit(checked_unit(names)) if names else unyt.dimensionless
        powers: Any = tuple(float(unit.dimensions.as_powers_dict()[getattr(unyt.dimensions, name)]) for name in DIMENSIONS)
        return CodeUnit(scale * float(unyt.unyt_quantity(1.0, unit).in_cgs()) * math.prod(map(float, number)), powers, a, h)
    except Exception:  # of the library's parser, which raises many kinds
        return None


def named(unit: CodeUnit, magnitude: float, wanted: str | None = None, length: CodeUnit | None = None) -> tuple[float, str]:
    """What numbers in a code's unit are to be multiplied by, and the name of the unit that they are then in.

    A name has the powers of the scale factor `a` and the Hubble parameter `h` that are left in, as in `kpc a h^-1`.

    Args:
        unit: as a file states it.
        magnitude: a typical number, by which the name is chosen: the largest unit of which there is at least one.
        wanted: the name of a unit instead, such as `"Msun/kpc**3"`; `ValueError` where it is none of the same dimension.
        length: that of positions: columns of mass of what is as large as a star cluster are in solar masses.
    """
    unyt = require("unyt", "units by name", "units")
    amount = unyt.unyt_quantity(unit.cgs, _powers(unit, "*", "**", exact=True) or "dimensionless")
    left_in = _product([("a", unit.a), ("h", unit.h)], " ", "^")
    if wanted is not None:
        number, names_of = respelled(wanted)
        known = checked_unit(names_of)
        try:
            factor = float(amount.to_value(known)) / number
            name = f"{number:g} " * (number != 1) + re.sub(
                r"(?<!\*)\*(?!\*)", " ", re.sub(r"\*\*\(?(-?[\d.]+)\)?", r"^\1", known)
            )
        except unyt.exceptions.UnitConversionError as error:
            own = f"is in {_powers(unit, ' ', '^') or 'no dimension'} (CGS) in the file"
            raise ValueError(f"the unit {wanted!r} does not agree with the quantity, which {own}") from error
        except Exception as error:  # of the library's parser, which raises many kinds
            raise ValueError(f"{wanted!r} is no unit that unyt knows; {_unlike(known, unyt)}") from error
    else:
        factor, name = unit.cgs, _powers(unit, " ", "^")
        names = READABLE.get(unit.powers, ())
        if unit.powers == COLUMN and length is not None and length.cgs > LARGE:
            names = ("Msun/pc^2",)
        for larger in names:
            value = float(amount.to_value(larger.replace("^", "**")))
            if larger == names[0] or value * abs(magnitude) >= 1:
                factor, name = value, larger
    return factor, f"{name} {left_in}".strip()


def _unlike(text: str, unyt: Any) -> str:
    """How a unit is written, and which name that there is not is most like which that there is."""
    known = {name for names in READABLE.values() for one in names for name, _ in factors(one)}
    for name in (name for name, _ in factors(text) if not hasattr(unyt, name)):
        return f"there is no {name}: write it as 'Msun/kpc**3'{did_you_mean(name, known)}"
    return "write it as 'Msun/kpc**3'"


def written(unit: CodeUnit | None) -> str:
    """A unit as text that other libraries read, with powers of a and h at its end; a length by a name; empty where none is."""
    unit = unit or PURE
    is_length = "kpc" in READABLE.get(unit.powers, ())
    called = (name for name, cgs in LENGTHS.items() if is_length and abs(unit.cgs / cgs - 1) < SAME)
    parts = ([] if unit.cgs == 1 else [f"{unit.cgs:.9g}"]) + ([_powers(unit, "*", "**")] if any(unit.powers) else [])
    name = next(called, "*".join(parts))
    return f"{name} {_product([('a', unit.a), ('h', unit.h)], ' ', '^')}".strip()


def spoken(unit: CodeUnit | None) -> str:
    """A unit of a file for people, such as `2.09 g cm^-2 h a^-2`."""
    return CODE_UNITS if unit is None else written(unit).replace("**", "^").replace("*", " ") or "1"


def stated_length(name: str) -> CodeUnit:
    """The unit of lengths that has this name. Raises `ValueError`: it is none."""
    return CodeUnit(1 / named(CodeUnit(1.0, LENGTH), 1.0, name)[0], LENGTH)


def _powers(unit: CodeUnit, times: str, power: str, exact: bool = False) -> str:
    return _product(list(zip(BASE, unit.powers, strict=True)), times, power, exact)


def _product(factors: list[tuple[str, float]], times: str, power: str, exact: bool = False) -> str:
    """Names to their powers, positive ones first; `exact` as fractions."""
    parts = []
    for name, exponent in sorted(factors, key=lambda factor: factor[1] < 0):
        if exponent == 1:
            parts.append(name)
        elif exponent:
            written = f"({Fraction(exponent).limit_denominator(60)})" if exact else f"{exponent:g}"
            parts.append(f"{name}{power}{written}")
    return times.join(parts)


def respelled(text: str) -> tuple[float, str]:
    """The number before a unit as people write it, or 1, and its names as `checked_unit` takes them."""
    text = re.sub("[⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺]+", lambda power: f"**{power[0].translate(RAISED)}", text)
    text = SUN.sub(lambda name: f"{name[1] or name[2]}sun", re.sub("[·⋅×]", "*", text))
    found, number = NUMBER.match(text), 1.0
    if found and (given := 10.0 ** int(found[1]) if found[1] else float(found[2])) > 0:
        number, text = given, text[found.end() :]
    text = re.sub(r"(?<![\w.])([^\W\d_]+)([-+]?\d+)(?![\w.])", r"\1**\2", text)
    return number, re.sub(r"(?<=[\w)])\s+(?=[^\W\d_])", "*", text.strip())


def bare(text: str, name: str, unit: CodeUnit | None) -> str:
    """A text, what `name` is, whose lengths with units are numbers in the unit that a file states for its own.

    Raises `ValueError`: a unit that is not one of length, or where the file does not state its own.
    """
    return MEASURED.sub(lambda length: repr(own_length(text, name, float(length[1]), length[2], unit)[0]), text)


def own_length(text: str, name: str, number: float, wanted: str, unit: CodeUnit | None) -> tuple[float, str]:
    """A number of `wanted` units of length in the unit of a file, and that name as it was understood; `text` is all of `name`.

    Raises `ValueError`: as `bare`.
    """
    if unit is None:
        raise ValueError(f"`{name}` = {text!r} has a unit, but the file does not state that of its lengths: give a number")
    try:
        factor, called = named(unit, 1.0, wanted)
    except ValueError as error:
        raise ValueError(f"`{name}` = {text!r} is no length: {error}") from error
    return number / factor, called


def checked_unit(text: str) -> str:
    """Names with powers, between them `*` or `/`, such as `"Msun/kpc**3"`, `"g*cm**(-1/2)"` or `"1/s"`, as `unyt` takes them."""
    if len(text) > MAX_LENGTH:
        raise ValueError(f"a unit may have {MAX_LENGTH} characters, this one has {len(text)}; write it as 'Msun/kpc**3'")
    if not UNIT.fullmatch(text) or NO_NAMES & {found[1] for found in FACTOR.finditer(text)}:
        rule = "names with whole or fractional powers, between them * or /"
        raise ValueError(f"{text!r} is no unit: it may hold {rule}; write it as 'Msun/kpc**3'")

    def in_brackets(factor: re.Match[str]) -> str:
        inside = re.sub(r"[\s()]", "", factor[2] or "1")
        over, _, under = inside.partition("/")
        if abs(float(over)) > MAX_POWER or (under and not 1 <= int(under) <= MAX_POWER):
            raise ValueError(f"{text!r} is no unit: powers lie between {-MAX_POWER} and {MAX_POWER}; write it as 'Msun/kpc**3'")
        return factor[1] + (f"**({inside})" if factor[2] else "")

    return re.sub(r"\s", "", FACTOR.sub(in_brackets, text))


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


def physical(table: ParticleTable) -> ParticleTable:
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
    told = ", ".join(f"{name} ({_product([('a', unit.a), ('h', unit.h)], ' ', '^')})" for name, unit in changed.items())
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
    found = {name: number_of(header, name) for name in ("udist", "umass", "utime")}
    time = number_of(header, "time")
    gas = {of: value for of, name in (("gamma", "gamma"), ("mu", "gmw")) if (value := first_of([header], name)) is not None}
    if any(value is None or not value > 0 for value in found.values()):
        return FileUnits(time=time, gas=gas)
    units = zip(found.values(), (LENGTH, MASS, TIME), strict=True)
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
