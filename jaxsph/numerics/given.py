"""Numbers as users give them, with a unit, with a mask, or in another byte order: made plain, or refused by name.

Flow: user -> [given] -> checks -> model.

Units are known by the attribute `units` or `unit`, as arrays of unyt, yt, astropy, pint and pynbody have one, so that none of
these libraries is needed. Lengths are converted to the unit of positions; where that is not known, what carries a unit is
refused, as nothing could tell whether it is the right one. A number without unit is meant in the unit of positions. What is
plain already passes as it is.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

PLAIN = str, bytes, bool, int, float, complex, jax.Array
NO_UNITS = "", "1", "dimensionless", "NoUnit"
"""What units that are none call themselves."""
POSITIONS = "or in whatever unit positions are"
LIBRARIES = "such as `unyt.unyt_array(x)` or `astropy.units.Quantity(x)`"


def own(name: str, value: Any) -> Any:
    """Numbers in their own unit, if they have one; `ValueError` of a mask that hides any, and of a list of such with units."""
    _require_whole(name, value)
    return _native(value if unit_of(value) is None else _numbers(value))


def plain(name: str, value: Any, why: str = "no unit is known here to convert it to", meant: str = POSITIONS) -> Any:
    """Numbers that carry no unit, or that of a pure number, such as percent; `ValueError` of a unit, and as `own`."""
    _require_whole(name, value)
    unit = unit_of(value)
    pure = value if unit is None else _pure(value, unit)
    if unit is not None and pure is None:
        raise ValueError(f'`{name}` is in {unit}, but {why}: pass {name}.to_value("{unit}"), {meant}')
    return _native(pure)


def with_unit(name: str, value: Any) -> tuple[Any, Any]:
    """Numbers in their own unit, and that; None where they carry none. Raises as `own`."""
    _require_whole(name, value)
    unit = unit_of(value)
    pure = None if unit is None else _pure(value, unit)
    return (own(name, value), unit) if pure is None else (_native(pure), None)


def in_unit(name: str, value: Any, unit: Any, power: int = 1, of: str = "position") -> Any:
    """Numbers in a power of a unit, that of `of`; those that carry none are taken to be in it.

    Args:
        name: of the argument.
        value: numbers, with or without a unit.
        unit: of lengths, an object or its name; None where it is not known.
        power: 1 for lengths, 3 for volumes, -1 for what is given a unit of length.
        of: whose unit that is.

    Raises:
        ValueError: a unit where none is known, or one of another kind; see `own`.
    """
    given = unit_of(value)
    if given is None or _pure(value, given) is not None:
        return plain(name, value)
    if unit is None:
        return plain(name, value, f"`{of}` has no unit to convert it to")
    _require_whole(name, value)
    wanted = unit if power == 1 else f"{unit}**{power}" if isinstance(unit, str) else unit**power
    try:
        same = type(given) is type(wanted) and bool(given == wanted)
        return _native(_numbers(value) if same else _converted(value, wanted))
    except Exception as error:  # libraries of units have errors of their own
        raise ValueError(
            f"`{name}` is in {given}, which cannot be converted to {wanted}, as `{of}` is in {unit}; "
            f"give it in that, or pass {name}.to_value(UNIT) of a unit that means the same"
        ) from error


def unit_of(value: Any) -> Any:
    """The unit that numbers carry, as an object or a name; None of what carries none."""
    if value is None or isinstance(value, (*PLAIN, list, tuple)) or type(value) is np.ndarray:
        return None
    for attribute in ("units", "unit"):
        unit = getattr(value, attribute, None)
        if unit is not None and not inspect.isroutine(unit) and not hasattr(unit, "__array__"):
            return unit
    return None


def name_of(unit: Any) -> str | None:
    """What a unit is called; None of none."""
    return None if unit is None else str(unit)


def _require_whole(name: str, value: Any) -> None:
    """Raise where a mask hides entries, or where entries of a list carry units or masks, which an array of them would lose."""
    _require_unmasked(name, value)
    if not isinstance(value, list | tuple):
        return
    for part in _leaves(value):
        _require_unmasked(name, part)
        if (unit := unit_of(part)) is not None:
            raise ValueError(f"`{name}` is a list of numbers that carry units ({unit}); make it one array, {LIBRARIES}")


def _leaves(value: Any) -> Iterator[Any]:
    """What nested lists hold, but for plain numbers."""
    for part in value:
        if isinstance(part, list | tuple):
            yield from _leaves(part)
        elif not isinstance(part, PLAIN) and type(part) is not np.ndarray:
            yield part


def _require_unmasked(name: str, value: Any) -> None:
    if isinstance(value, PLAIN) or type(value) is np.ndarray:
        return
    mask = getattr(value, "mask", None)
    if mask is None or inspect.isroutine(mask):
        return
    hidden = np.asarray(mask)
    if hidden.any():
        raise ValueError(
            f"`{name}` is masked in {int(hidden.sum())} of {hidden.size} entries, and masks are not kept: leave these out of all "
            f"arrays, as by x[~mask], or give them a value, as by {name}.filled(value)"
        )


def _pure(value: Any, unit: Any) -> Any:
    """Numbers of what has no dimension; None of what has."""
    if str(unit).strip() in NO_UNITS:
        return _numbers(value)
    try:
        return None if isinstance(unit, str) else _converted(value, unit**0)
    except Exception:  # libraries of units have errors of their own
        return None


def _converted(value: Any, unit: Any) -> Any:
    """Numbers in another unit of the same kind."""
    if hasattr(value, "to_value"):
        return value.to_value(unit)
    return _numbers(value.to(unit) if hasattr(value, "to") else value.in_units(unit))


def _numbers(value: Any) -> Any:
    """Numbers in the unit that they are in."""
    if not isinstance(value, np.ndarray):
        for attribute in ("value", "magnitude"):
            found = getattr(value, attribute, None)
            if found is not None and not inspect.isroutine(found):
                return np.asarray(found)
    return np.asarray(value)


def _native(value: Any) -> Any:
    """Numbers that JAX takes: in this machine's byte order, of no more than 8 bytes, and in no array of another kind."""
    if not isinstance(value, np.ndarray | np.generic):
        return value
    if value.dtype.kind == "f" and value.dtype.itemsize > 8:
        return np.asarray(value, np.float64)
    value = np.asarray(value) if isinstance(value, np.ndarray) else value
    return value if value.dtype.isnative else value.astype(value.dtype.newbyteorder("="))
