"""Units by the names that people use, through `unyt`; what a file does not state is in code units.

Flow: ParticleTable, quantity -> CodeUnit -> [unit_names] -> factor and name for labels.
"""

from __future__ import annotations

from fractions import Fraction
from typing import Any

from .optional import require
from .quantities import LOG_PREFIX, ROLES
from .table import ParticleTable, plain
from .unit_text import checked_unit
from .units import BASE, LENGTH, TIME, VELOCITY, CodeUnit

READABLE: dict[tuple[float, ...], tuple[str, ...]] = {
    LENGTH: ("cm", "m", "km", "Rsun", "AU", "pc", "kpc", "Mpc", "Gpc"),
    TIME: ("s", "hr", "day", "yr", "kyr", "Myr", "Gyr"),
    VELOCITY: ("cm/s", "m/s", "km/s"),
    (0, 1, 0, 0): ("g", "kg", "Msun"),
    (0, 0, 0, 1): ("K",),
    (-0.5, 0.5, -1, 0): ("G",),
}
"""Names by dimension, from small to large; of other dimensions units are cm, g, s and K to powers."""


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
        return units.columns.get(next((n for n in table.vectors if plain(n) in map(plain, ROLES["velocity"])), ""))
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
        factor, name = _converted(unyt, amount, known, unit, wanted), wanted.replace("**", "^")
    else:
        factor, name = _chosen(amount, unit, abs(magnitude))
    return factor, f"{name} {left_in}".strip()


def _chosen(amount: Any, unit: CodeUnit, magnitude: float) -> tuple[float, str]:
    """The largest name of which there is at least one, else the smallest; of no names, CGS."""
    names = READABLE.get(unit.powers, ())
    if not names:
        return unit.cgs, _powers(unit, " ", "^") or ""
    factors = [(float(amount.to_value(name)), name) for name in names]
    return next(((factor, name) for factor, name in reversed(factors) if factor * magnitude >= 1), factors[0])


def _converted(unyt: Any, amount: Any, known: str, unit: CodeUnit, wanted: str) -> float:
    """Numbers in the unit `known`, which was written as `wanted`, for one of `amount`."""
    try:
        return float(amount.to_value(known))
    except unyt.exceptions.UnitConversionError as error:
        own = _powers(unit, " ", "^") or "no dimension"
        raise ValueError(f"the unit {wanted!r} does not agree with the quantity, which is in {own} (CGS) in the file") from error
    except Exception as error:  # of the library's parser, which raises many kinds
        raise ValueError(f"{wanted!r} is no unit that unyt knows: {error}; write it as 'Msun/kpc**3'") from error


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
