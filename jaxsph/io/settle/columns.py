"""Particles of columns that another library holds: dictionaries, tables, structured arrays, snapshots.

Flow: names and columns -> [columns] -> ParticleTable -> assemble -> Particles, Report.

| given | as |
|---|---|
| positions | `position`, `pos`, `coordinates`, ... (N, 3), or `x`, `y`, `z` |
| supports | `support`, `support_radius`; or `h`, `hsml`, `smoothing_length`, ... and how many of these a support is |
| masses, densities, volumes | `mass`, `density`, `rho`, `volume`, ... as in files |
| anything else | a column that may be the quantity |

Whatever has its columns by `[name]` or as attributes is read: what lists its names is read whole (dictionaries, pandas and
sarracen by `columns`, NumPy by `dtype.names`, astropy by `keys()`), what does not, or loads when it is asked (pynbody,
swiftsimio), is asked for the names that are known here and those that are wanted.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError
from jaxsph.io.parsing import gather_vectors
from jaxsph.io.settle.assemble import Report, particles_from_table
from jaxsph.io.settle.quantities import LOG_PREFIX
from jaxsph.io.table import POSITION_NAMES, ROLES, SMOOTHING_NAMES, SUPPORT_NAMES, VOLUME_NAMES, ParticleTable, called
from jaxsph.model.particles.particles import Particles
from jaxsph.numerics.checks import in_unit, name_of, own, unit_of, with_unit

H_NAMES = (*SMOOTHING_NAMES, "smoothing_lengths", "smooth")
LENGTHS = ("x", "y", "z", *SUPPORT_NAMES, *H_NAMES)
KNOWN = (*POSITION_NAMES, *LENGTHS, *VOLUME_NAMES, *(name for names in ROLES.values() for name in names))
OWN = "quantity"  # what a quantity is called that is given as numbers


def particles_from_columns(
    columns: Any,
    *,
    quantity: Any = None,
    support: Any = None,
    support_in_h: float | None = None,
    box: Any = None,
    opacity_by: str | None = None,
    **more: Any,
) -> tuple[Particles, Report]:
    """Particles of named columns, and the report on what was settled; see `jaxsph.Particles.from_columns`."""
    named = [name.removeprefix(LOG_PREFIX) for name in (quantity, opacity_by, support) if isinstance(name, str)]
    fields = _fields(columns, [word for name in named for word in (name, *re.findall(r"[^\W\d]\w*", name))])
    position, rest, unit = _position(fields)
    if quantity is not None and not isinstance(quantity, str):
        rest[OWN], quantity = quantity, OWN
    said: list[str] = []
    support = _support(rest, support, support_in_h, unit, said)
    volume = called(rest, VOLUME_NAMES)
    volumes = None if volume is None else _rows(volume, in_unit(volume, rest.pop(volume), unit, 3), len(position))
    held = {name: _rows(name, own(name, value), len(position)) for name, value in rest.items()}
    held = {name: column for name, column in held.items() if name.lower() not in ("x", "y", "z")}  # positions, once more
    numbers = {name: column for name, column in held.items() if column.dtype.kind in "fiub" and column.ndim < 3}
    _, numbers = gather_vectors(numbers | dict(zip("xyz", position.T, strict=True)))  # joins vx, vy, vz
    given = np.ndim(support) == 0
    told: dict[str, Any] = {"source": type(columns).__name__, "conventions": tuple(said)}
    table = ParticleTable(position, numbers, None if given else support, volumes, **told)
    period = None if box is None else np.broadcast_to(in_unit("box", box, unit), 3).tolist()
    more |= {"support": support if given else None, "box": period, "opacity_by": opacity_by}
    particles, report = particles_from_table(table, quantity, **more)
    return dataclasses.replace(particles, length_unit=name_of(unit)), report


def _fields(columns: Any, wanted: list[str]) -> dict[str, Any]:
    """All columns of what lists them, of anything else those that are known or wanted."""
    listed = _listed(columns)
    names = dict.fromkeys([*(KNOWN if listed is None else listed), *wanted])
    found = {name: _column(columns, name, listed is None) for name in names}
    fields = {name: column for name, column in found.items() if column is not None}
    if not fields:
        raise ValueError(
            "`columns` must have columns by name, as dictionaries, data frames, structured arrays and snapshots do, got "
            f"{type(columns).__name__} without any of {', '.join(KNOWN[:3])}, ...; give a dictionary of arrays"
        )
    return fields


def _listed(columns: Any) -> list[str] | None:
    """The names that there are, also of columns that are loaded when they are asked for; None of what does not list them."""
    if isinstance(columns, np.ndarray):
        return list(columns.dtype.names or ())
    listed: list[Any] = []
    for way in ("keys", "loadable_keys"):
        if callable(names := getattr(columns, way, None)):
            listed.extend(names())
    return [name for name in listed if isinstance(name, str)] or None


def _column(columns: Any, name: str, by_attribute: bool) -> Any:
    """A column of that name; None where there is none."""
    try:
        found = columns[name]
    except Exception:  # libraries have errors of their own for names that they do not know
        found = getattr(columns, name, None) if by_attribute else None
    if callable(found):
        return None
    return found.to_numpy() if unit_of(found) is None and hasattr(found, "to_numpy") else found


def _position(fields: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any], Any]:
    """Positions, the other columns, and the unit that positions carry."""
    rest = dict(fields)
    name = called(rest, POSITION_NAMES)
    if name is not None:
        position, unit = with_unit(name, rest.pop(name))
        position = np.asarray(position)
        if position.ndim != 2 or position.shape[1] != 3:
            raise ValueError(f"`{name}` must have shape (N, 3), got {position.shape}; give three coordinates a particle")
        return position, rest, unit
    triple = [name for name in (called(rest, axis) for axis in "xyz") if name is not None]
    if len(triple) < 3:
        known = f"{', '.join(POSITION_NAMES)}, nor x, y and z"
        raise ValueError(f"`columns` must hold positions, but there is no {known}; there are {', '.join(map(str, rest))}")
    first, unit = with_unit("x", rest.pop(triple[0]))
    given = [np.atleast_1d(one) for one in (first, *(in_unit(one, rest.pop(one), unit, of="x") for one in triple[1:]))]
    lengths = {len(one) for one in given}
    if len(lengths) > 1:
        raise ValueError(f"`x`, `y` and `z` must have one length, got {', '.join(map(str, sorted(lengths)))}")
    return np.stack(given, axis=1), rest, unit


def _support(rest: dict[str, Any], given: Any, in_h: float | None, unit: Any, said: list[str]) -> Any:
    """Supports as given, as a column has them, or as smoothing lengths; None where nothing tells."""
    if given is not None and not isinstance(given, str):
        if in_h is None:
            return in_unit("support", given, unit)
        what = "is for a column of smoothing lengths; give `support` its name, or leave it out"
        raise ValueError(f"`support_in_h` = {in_h} {what}")
    name = called(rest, (SUPPORT_NAMES if in_h is None else H_NAMES) if given is None else (given,))
    if name is None and given is not None:
        raise ValueError(f"`support` must be numbers, or the name of a column, got {given!r}; there are {', '.join(rest)}")
    if name is None:
        if in_h is not None:
            what = "needs a column of smoothing lengths, such as `h`; give its name by `support`"
            raise ValueError(f"`support_in_h` = {in_h} {what}")
        if (length := called(rest, H_NAMES)) is not None:
            raise ValueError(
                f"column `{length}` is a smoothing length, and codes differ in how many of these a support radius is: give "
                f"`support_in_h=2` where the kernel ends at two of them (Phantom, pynbody), 1 where it ends at one (Gadget), "
                f"or supports themselves by `support=`"
            )
        return None
    said.append(f"support = {'' if in_h is None else f'{in_h:g} x '}column `{name}`")
    radii = np.asarray(in_unit(name, rest.pop(name), unit))
    return radii if in_h is None else radii * float(in_h)


def _rows(name: str, value: Any, count: int) -> np.ndarray:
    """A column, of one number for all where that is what there is."""
    column = np.asarray(value)
    if column.ndim == 0:
        return np.full(count, column)
    if len(column) != count:
        raise DataError(f"column `{name}` has {len(column)} rows, but there are {count} particles; give one number a particle")
    return column
