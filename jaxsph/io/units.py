"""What 1 in a file is, as far as the file states it, and by which name people call that.

Flow: file -> `readers.stated_units` -> [units: FileUnits] of a ParticleTable -> `settle.labels` -> [units: named] -> labels.

Numbers are left as stored: where a file states powers of the scale factor a and the Hubble parameter h, units carry them, and
nothing is multiplied out. What a file does not state is in code units.

Of units that people write, names, whole or fractional powers, `*` and `/` get through: `unyt` evaluates what it is given as code.
"""

from __future__ import annotations

import dataclasses
import keyword
import re
from collections.abc import Mapping
from fractions import Fraction

from jaxsph.io.libraries import require

BASE = "cm", "g", "s", "K"
LENGTH, MASS, TIME, TEMPERATURE = (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)
VELOCITY = (1, 0, -1, 0)
LENGTHS = {"cm": 1.0, "mm": 0.1, "m": 1e2, "km": 1e5, "AU": 1.495978707e13}
LENGTHS |= {f"{prefix}pc": 3.0856775814913673e18 * size for prefix, size in (("", 1), ("k", 1e3), ("M", 1e6), ("G", 1e9))}
"""In cm."""
SAME = 3e-5
"""Relative difference of a unit to one that it may be called after: codes have constants of four or five digits."""
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
UNIT = re.compile(rf"(?:\s*1\s*/)?(?>{FACTOR.pattern})(?:[*/](?>{FACTOR.pattern}))*")
NO_NAMES = frozenset(keyword.kwlist) | {"sqrt", "Symbol", "Integer", "Float", "Rational"}


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
