"""Units by the names that people use, through `unyt`; what a file does not state is in code units.

Flow: ParticleTable, quantity -> CodeUnit -> [unit_names] -> factor and name for labels.

Of units that people write, names, whole or fractional powers, `*` and `/` get through: `unyt` evaluates what it is given as code.
"""

from __future__ import annotations

import keyword
import re
from fractions import Fraction

from jaxsph.io.libraries import require
from jaxsph.io.settle.quantities import LOG_PREFIX, ROLES, velocity_name
from jaxsph.io.table import ParticleTable
from jaxsph.io.units import BASE, LENGTH, LENGTHS, MASS, SAME, TEMPERATURE, TIME, VELOCITY, CodeUnit

READABLE: dict[tuple[float, ...], tuple[str, ...]] = {
    LENGTH: ("cm", "m", "km", "Rsun", "AU", "pc", "kpc", "Mpc", "Gpc"),
    TIME: ("s", "hr", "day", "yr", "kyr", "Myr", "Gyr"),
    VELOCITY: ("cm/s", "m/s", "km/s"),
    MASS: ("g", "kg", "Msun"),
    TEMPERATURE: ("K",),
    (-0.5, 0.5, -1, 0): ("G",),
}
"""Names by dimension, from small to large; of other dimensions units are cm, g, s and K to powers."""

MAX_LENGTH = 100  # characters of a unit
MAX_POWER = 12  # of a name: no quantity has more, and larger ones overflow
NAME = r"[^\W\d_][^\W_]{0,19}(?:_[^\W_]{1,19})?"
POWER = r"(?:[-+]?\d{1,2}(?:\.\d{1,4})?|\(\s*[-+]?\d{1,2}(?:\.\d{1,4}|\s*/\s*\d{1,2})?\s*\))"
FACTOR = re.compile(rf"\s*({NAME})\s*(?:(?:\*\*|\^)\s*({POWER}))?\s*")
RECIPROCAL = re.compile(r"\s*1\s*(?=/)")
NO_NAMES = frozenset(keyword.kwlist) | {"sqrt", "Symbol", "Integer", "Float", "Rational"}


def unit_of(table: ParticleTable, quantity: str) -> CodeUnit | None:
    """Unit of a quantity by its full name, as `choose_quantity` gives it; `None` where the file does not state it.

    Of `log10:NAME` it is that of NAME. A density that is a sum over particles has that of masses over volumes.
    """
    units, name = table.units, quantity
    if name.lower().startswith(LOG_PREFIX):
        return unit_of(table, name[len(LOG_PREFIX) :])
    stored = table.named(name)
    if stored is not None and stored in units.columns:
        return units.columns[stored]
    column, _, component = name.rpartition(".")
    if component and column in units.columns and column in table.vectors:
        return units.columns[column]
    if name in ("x", "y", "z"):
        return units.length
    if name == "speed":
        return units.columns.get(velocity_name(table) or "")
    if name == "density" and stored is None and units.length is not None:
        mass = table.named(*ROLES["mass"])
        count = CodeUnit(1.0, (0, 0, 0, 0)) if mass is None else units.columns.get(mass)
        return None if count is None else count.over(units.length, 3)
    return None


def named(unit: CodeUnit, magnitude: float, wanted: str | None = None) -> tuple[float, str]:
    """What numbers in a code's unit are to be multiplied by, and the name of the unit that they are then in.

    Args:
        unit: as a file states it.
        magnitude: a typical number, by which the name is chosen: the largest unit of which there is at least one.
        wanted: the name of a unit instead, such as `"Msun/kpc**3"`.

    Returns:
        Factor, and name with powers of the scale factor `a` and the Hubble parameter `h` that are left in, as in `kpc a h^-1`.

    Raises:
        ImportError: unyt is not installed.
        ValueError: `wanted` is no unit, or not one of the same dimension.
    """
    known = None if wanted is None else checked_unit(wanted)
    unyt = require("unyt", "units by name", "units")
    amount = unyt.unyt_quantity(unit.cgs, _powers(unit, "*", "**", exact=True) or "dimensionless")
    left_in = _product([("a", unit.a), ("h", unit.h)], " ", "^")
    if wanted is not None and known is not None:
        try:
            factor, name = float(amount.to_value(known)), wanted.replace("**", "^")
        except unyt.exceptions.UnitConversionError as error:
            own = f"is in {_powers(unit, ' ', '^') or 'no dimension'} (CGS) in the file"
            raise ValueError(f"the unit {wanted!r} does not agree with the quantity, which {own}") from error
        except Exception as error:  # of the library's parser, which raises many kinds
            raise ValueError(f"{wanted!r} is no unit that unyt knows: {error}; write it as 'Msun/kpc**3'") from error
    else:
        factor, name = unit.cgs, _powers(unit, " ", "^")
        for larger in READABLE.get(unit.powers, ()):
            value = float(amount.to_value(larger))
            if larger == READABLE[unit.powers][0] or value * abs(magnitude) >= 1:
                factor, name = value, larger
    return factor, f"{name} {left_in}".strip()


def written(unit: CodeUnit) -> str:
    """A unit as text that other libraries read, with powers of a and h at its end; a length by a name, where it is one."""
    is_length = "kpc" in READABLE.get(unit.powers, ())
    called = (name for name, cgs in LENGTHS.items() if is_length and abs(unit.cgs / cgs - 1) < SAME)
    parts = ([] if unit.cgs == 1 else [f"{unit.cgs:.9g}"]) + ([_powers(unit, "*", "**")] if any(unit.powers) else [])
    name = next(called, "*".join(parts))
    return f"{name} {_product([('a', unit.a), ('h', unit.h)], ' ', '^')}".strip()


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


def checked_unit(text: str) -> str:
    """Names with powers, between them `*` or `/`, such as `"Msun/kpc**3"`, `"g*cm**(-1/2)"` or `"1/s"`, as `unyt` takes them.

    Raises `ValueError`: anything else; more than 100 characters; a power beyond 12.
    """
    if len(text) > MAX_LENGTH:
        raise ValueError(f"a unit may have {MAX_LENGTH} characters, this one has {len(text)}; write it as 'Msun/kpc**3'")
    found = RECIPROCAL.match(text)
    parts, at = (["1"], found.end()) if found else ([], 0)
    while True:
        if parts and at < len(text):
            if text[at] not in "*/":
                raise _refused(text)
            parts.append(text[at])
            at += 1
        elif parts:
            return "".join(parts)
        factor = FACTOR.match(text, at)
        if factor is None or factor[1] in NO_NAMES:
            raise _refused(text)
        parts.append(factor[1] + _power(factor[2], text))
        at = factor.end()


def _power(given: str | None, text: str) -> str:
    """Of a factor, in brackets."""
    if given is None:
        return ""
    inside = re.sub(r"[\s()]", "", given)
    over, _, under = inside.partition("/")
    if abs(float(over)) > MAX_POWER or (under and not 1 <= int(under) <= MAX_POWER):
        raise ValueError(f"{text!r} is no unit: powers lie between {-MAX_POWER} and {MAX_POWER}; write it as 'Msun/kpc**3'")
    return f"**({inside})"


def _refused(text: str) -> ValueError:
    rule = "names with whole or fractional powers, between them * or /"
    return ValueError(f"{text!r} is no unit: it may hold {rule}; write it as 'Msun/kpc**3'")
