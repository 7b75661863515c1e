r"""Units by name: how people write them, how they are written and said, and what a picture's key says of them.

Flow: FileUnits of a ParticleTable -> [units: labels_of, named] -> colour bar, scale bar and time of a figure.

Units are read as people write them, `1e10 Msun pc^-2`, `solMass/pc2`, `km s-1`, `cm⁻³`; names, whole or fractional powers, `*`
and `/` of these get through: `unyt` evaluates what it is given as code.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import keyword
import math
import re
from fractions import Fraction
from typing import Any

from jaxsph.io.damage import require
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
    parts = []
    for over, name, power in WORD.findall(re.sub(r"\((\w+)\)", r"\1", unit)):  # a name alone needs no parentheses
        if name != "1":
            parts.append((name, (power or "1") if not over else power[1:] if power.startswith("-") else f"-{power or 1}"))
    return parts


def read_unit(text: str) -> CodeUnit | None:
    """The unit of a text that `written` made, or that names units; `None` where it is none, empty, or unyt is not there."""
    if not text or not can_name():
        return None
    scale, text = respelled(text)
    parts = factors(text)
    a, h = (sum(float(Fraction(power)) for name, power in parts if name == left) for left in "ah")
    number = [name for name, _ in parts if name[0].isdigit()]
    names = "*".join(f"{name}**({power})" for name, power in parts if name not in ("a", "h", *number))
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
    left_in = powers_left(unit)
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
    return f"{name} {powers_left(unit)}".strip()


def spoken(unit: CodeUnit | None) -> str:
    """A unit of a file for people, such as `2.09 g cm^-2 h a^-2`."""
    return CODE_UNITS if unit is None else written(unit).replace("**", "^").replace("*", " ") or "1"


def stated_length(name: str) -> CodeUnit:
    """The unit of lengths that has this name. Raises `ValueError`: it is none."""
    return CodeUnit(1 / named(CodeUnit(1.0, LENGTH), 1.0, name)[0], LENGTH)


def _powers(unit: CodeUnit, times: str, power: str, exact: bool = False) -> str:
    return _product(list(zip(BASE, unit.powers, strict=True)), times, power, exact)


def powers_left(unit: CodeUnit) -> str:
    """Powers of the scale factor a and the Hubble parameter h that are left in numbers of a unit, as text."""
    return _product([("a", unit.a), ("h", unit.h)], " ", "^")


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
    match, number = NUMBER.match(text), 1.0
    if match and (given := 10.0 ** int(match[1]) if match[1] else float(match[2])) > 0:
        number, text = given, text[match.end() :]
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
