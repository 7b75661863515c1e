r"""Choose, or derive, the scalar that the transfer function sees.

Flow: ParticleTable -> [quantities] -> Particles.

| name | what it gives |
|---|---|
| a scalar column | that column; case and punctuation do not matter |
| `velocity.x`, `vx`, `B.2` | a component of a vector column |
| `velocity.los`, `B.los` | a component along the line of sight, positive away; of pictures whose eye or direction is known |
| `density` | the stored density, else $\rho_i = \sum_j m_j W(\|x_i - x_j\|, H_i)$ (without masses: number density) |
| `speed` | $\|v\|$ |
| `x`, `y`, `z` | a coordinate |
| `radius`, `velocity.radial`, `.phi`, `.theta` | the distance from the centre, and components about it; `phi` about the z axis |
| `temperature`, `pressure`, ... | what `jaxsph.io.settle.derived` computes, where no column has it |
| `Masses * Density`, ... | what `jaxsph.io.settle.where` makes of any of these |
| `log10:NAME` | decimal logarithm of any of these; values $\le 0$ become the smallest positive one, which is told |
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import re
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.io.damage import DataError
from jaxsph.io.settle.around import COMPONENTS, RADIUS, away_from, center_of, component_about, names_center
from jaxsph.io.settle.derived import FORMULAS, Formula, formula_of
from jaxsph.io.settle.where import ConditionError, Expression
from jaxsph.io.table import PURE, ROLES, CodeUnit, ParticleTable, has_role, plain, refuse_rows, synonyms
from jaxsph.numerics.names import did_you_mean

LEFT_OUT = "left out "
LOG_PREFIX, SIGHT = "log10:", "los"
FRACTIONS = "fraction", "dustfrac"  # words in names of what tells more than speeds where density does not
OPERATORS = frozenset("+-*/%()<>=!&|^~@`")  # what expressions have and names do not, as a rule
DRAWS = 5  # of each name, by which units of expressions are found
DECADE, DECADE_BETWEEN = 10.0, (2, 98)  # ratio of values, between these percentiles, from which their logarithm is shown
CLUSTERED = 30.0
"""The same of a summed density from which it tells more than speeds: particles that lie evenly are below 10, spray among them."""
ROUNDING = 1e-5  # of the largest value, up to which values differ that are meant to be the same
STEADY = 0.9  # least speed over largest, from which a component of velocities tells more
LIQUID, LIQUID_BETWEEN = 1.5, (25, 95)
"""Ratio of densities that are not thin, between these percentiles, up to which speeds tell more: at free surfaces many fall."""
Gather = Callable[[], Float[np.ndarray, " particles"]]


def choose_quantity(
    table: ParticleTable, name: str | None = None, *, density: Gather | None = None, finite: bool = True
) -> tuple[Float[np.ndarray, " particles"], str]:
    """The quantity called `name`, or the most telling one when `name` is `None`.

    Without a name, the first of these that the table has and that is not the same for all particles that are not thin: a
    concentration or dye, temperature, stored density unless it hardly varies and there are velocities, internal energy, another
    fraction, summed density if none is stored and particles cluster, as stars and dark matter do, speed, or a component of
    velocities where all are as fast, height where particles lie evenly and have no velocities, summed density unless there are
    velocities and no masses, or the stored one hardly varies; so a liquid at rest is shown by its speed, as it is when it moves.
    Temperature, internal energy and density become `log10:...` where they are positive and spread over more than a decade.

    Args:
        table: the particles.
        name: see the table at the top of this module.
        density: gives the summed density when the table holds none; `None` means that it cannot be derived.
        finite: whether values that are not finite are refused.

    Returns:
        (N,) float64 values, and the full name of what they are.
    """
    if name is None:
        return _default(table, density)
    values, full_name = _named(table, name.strip(), density)
    return _finite(values, full_name) if finite else values, full_name


def available_quantities(table: ParticleTable) -> tuple[str, ...]:
    """Every name that `choose_quantity` takes for this table, `log10:` aside."""
    components = tuple(f"{name}.{c}" for name in table.vectors for c in _component_names(table, table.columns[name]))
    derived: tuple[str, ...] = () if table.of_role("density") else ("density",)
    derived += ("speed",) if velocity_name(table) else ()
    derived += tuple(name for name in FORMULAS if computed_of(table, name) is not None or _own_volume(table, name) is not None)
    return tuple(dict.fromkeys((*table.scalars, *components, *derived, "x", "y", "z")))


def is_log(name: str | None) -> bool:
    """Whether a full name is that of a logarithm."""
    return name is not None and name.lower().startswith(LOG_PREFIX)


def spreads(values: np.ndarray, over: float = DECADE) -> bool:
    """Whether those that are positive spread over more than a decade, but for the outermost."""
    usable = values[np.isfinite(values) & (values > 0)]
    low, high = np.percentile(usable, DECADE_BETWEEN) if len(usable) else (1.0, 1.0)
    return bool(high > over * low)


def passed_over(table: ParticleTable, shown: str) -> list[str]:
    """Sentences on what `_default` would have chosen in place of what is `shown`, had it told anything."""
    before, same = itertools.takewhile(lambda name: name != shown.removeprefix(LOG_PREFIX), _telling(table)), _same(table)
    return [f"{name} {same[name]}, so {shown} is shown" for name in before if name in same]


def without_logarithm(table: ParticleTable, density: Gather, kept: Any, *names: str | None) -> list[str]:
    """Sentences on values that have no logarithm, of particles that are kept, by full names of quantities: how many there are."""
    inner = dict.fromkeys(name[len(LOG_PREFIX) :] for name in names if name and is_log(name))
    counts = {name: (choose_quantity(table, name, density=density, finite=False)[0][kept] <= 0).sum() for name in inner}
    told = "are not > 0: their logarithm is taken to be that of the least which is"
    return [f"{count:,} values of {name} {told}" for name, count in counts.items() if count]


def _named(table: ParticleTable, name: str, density: Gather | None) -> tuple[np.ndarray, str]:
    if is_log(name):
        values, inner = _named(table, name[len(LOG_PREFIX) :].strip(), density)
        positive = _finite(values, inner)[values > 0]
        if len(values) and len(positive) == 0:
            raise DataError(f"`{LOG_PREFIX}{inner}` needs positive values, but the largest is {values.max()}; use `{inner}`")
        return np.log10(np.maximum(values, positive.min())) if len(values) else values, LOG_PREFIX + inner
    if name in table.columns and table.columns[name].ndim == 1:
        return _scalar(table, name), name
    failed = None
    if OPERATORS & set(name):
        try:
            expression = Expression(name, lambda part: choose_quantity(table, part, density=density, finite=False)[0])
            return np.broadcast_to(expression.numbers(), len(table)), name
        except ConditionError as error:  # unless it names a column for all that, as `rho (kg/m3)`, or `smooth-length`
            failed, dashed = error, OPERATORS & set(name) == {"-"}
            odd = {each: one for each, one in table.columns.items() if OPERATORS & set(each) or (dashed and one.ndim == 1)}
            table = dataclasses.replace(table, columns=odd)
    column = table.named(name)
    if column is not None and table.columns[column].ndim == 1:
        return _scalar(table, column), column
    component = _component(table, name)
    if component is not None:
        return component
    if failed is not None:
        raise failed
    wanted = plain(name)
    if wanted in ("x", "y", "z"):
        return table.position[:, "xyz".index(wanted)].astype(np.float64), wanted
    volume = _own_volume(table, name)
    if volume is not None:
        return volume.astype(np.float64), "volume"
    if wanted == RADIUS:
        return np.linalg.norm(away_from(table, center_of(table)[0]), axis=1), RADIUS
    velocity = velocity_name(table)
    if wanted == "speed" and velocity:
        return np.linalg.norm(table.exact(velocity), axis=1), "speed"
    stored = table.named(*synonyms(name))
    if stored is not None:
        return _scalar(table, stored), stored
    if has_role(name, "density") and density is not None:
        return density(), "density"
    why = ""
    try:
        formula = formula_of(table, name, unit_of)
    except DataError as error:
        formula, why = None, f"; {error}"
    if formula is not None:
        return _named(table, formula.text, density)[0], formula.name
    if column is not None:
        return _scalar(table, column), column
    known = available_quantities(table)
    meant = left_out(table, name) or why or did_you_mean(name, known)
    raise DataError(f"there is no quantity {name!r}; there are {', '.join(known)}, and `log10:` before any of them{meant}")


def left_out(table: ParticleTable, name: str) -> str:
    """What the reader said of columns that it left out and that may be meant; empty where there is none."""
    wanted = {plain(part) for part in ("velocity" if name == "speed" else name, name.partition(".")[0])}
    wanted |= {plain(other) for one in wanted for other in synonyms(one)}
    told = (said for said in table.conventions if said.startswith(LEFT_OUT))
    names = lambda said: map(plain, said.removeprefix(LEFT_OUT).partition(":")[0].split(","))  # noqa: E731
    return "".join(f"; {said}" for said in told if not wanted.isdisjoint(names(said)))


def unit_of(table: ParticleTable, quantity: str) -> CodeUnit | None:
    """Unit of a quantity by its full name, as `choose_quantity` gives it; `None` where the file does not state it.

    Of `log10:NAME` it is that of NAME. A density that is a sum over particles has that of masses over volumes.
    """
    units, name = table.units, quantity
    if is_log(name):
        return unit_of(table, name[len(LOG_PREFIX) :].strip())
    stored = table.named(name, *synonyms(name))
    if stored is not None and stored in units.columns:
        return units.columns[stored]
    component = _component(table, name)
    if component is not None:
        return units.columns.get(component[1].rpartition(".")[0])
    if name in ("x", "y", "z"):
        return units.length
    if name == "speed":
        return units.columns.get(velocity_name(table) or "")
    if name == "density" and stored is None and units.length is not None:
        mass = table.of_role("mass")
        count = PURE if mass is None else units.columns.get(mass)
        return None if count is None else count.over(units.length, table.dimensions)
    if name == RADIUS:
        return units.length
    if _own_volume(table, name) is not None:
        return units.length and PURE.over(units.length, -3)
    if OPERATORS & set(name):
        return _unit_by_growth(table, name)
    with contextlib.suppress(DataError):
        formula = formula_of(table, name, unit_of)
        return formula and (formula.unit or _unit_by_growth(table, formula.text))
    return None


def computed_of(table: ParticleTable, name: str) -> Formula | None:
    """The formula by which a quantity of this name is computed; None where it is stored, or there is none, or it needs more."""
    if table.named(name, *synonyms(name)) in table.scalars or _own_volume(table, name) is not None:
        return None
    with contextlib.suppress(DataError):
        return formula_of(table, name, unit_of)
    return None


def _own_volume(table: ParticleTable, name: str) -> np.ndarray | None:
    """The volumes that a file has, where a quantity of that name is asked for."""
    return table.volume if plain(name) == "volume" and table.named(name) is None else None


def formulas_said(table: ParticleTable, *texts: str | None) -> list[str]:
    """Sentences on quantities that texts name and that are computed."""
    said: dict[str, None] = {}
    for word in (word for text in texts for word in re.findall(r"[^\W\d][\w.]*", text or "")):
        formula = computed_of(table, word)
        about = names_center(word) and table.named(word) is None
        if formula is not None:
            said[formula.said] = None
        elif about and len(table):
            center, called = center_of(table)
            said[f"{word} is about {' '.join(f'{value:.6g}' for value in center)}, {called}"] = None
    return list(said)


def _unit_by_growth(table: ParticleTable, text: str) -> CodeUnit | None:
    """The unit of an expression: by how it grows with each base unit, which is as a power of it for all numbers alike."""

    def grown(name: str, way: np.ndarray) -> np.ndarray:
        unit = unit_of(table, name)
        if unit is None:
            raise DataError(f"no unit of {name} is stated")
        draws = np.random.default_rng(list(name.encode())).uniform(1, 2, DRAWS)
        return np.asarray(draws * np.exp(way @ (np.log(unit.cgs), *unit.powers, unit.a, unit.h)))

    try:
        each = (Expression(text, functools.partial(grown, way=way)).numbers() for way in (np.zeros(7), *np.eye(7)))
        samples = [np.broadcast_to(numbers, DRAWS) for numbers in each]
    except DataError:
        return None
    ratios = np.divide(samples[1:], samples[0])
    if not (ratios > 0).all() or not np.allclose(ratios, ratios[:, :1], rtol=1e-9, atol=0):
        return None
    powers = (np.log(ratios[1:, 0]).round(6) + 0.0).tolist()
    return CodeUnit(float(ratios[0, 0]), tuple(powers[:4]), *powers[4:])


def _telling(table: ParticleTable) -> list[str]:
    """Columns that tell most, the most telling first: concentrations and dyes, what is shown by decades, other fractions."""
    scaled = [table.of_role(role) for role in ("temperature", "density", "internal_energy")]
    shares = (name for name in table.scalars if any(word in plain(name) for word in FRACTIONS))
    return [*filter(_is_dye, table.scalars), *(name for name in scaled if name in table.scalars), *shares]


def _same(table: ParticleTable) -> dict[str, str]:
    """Those of `_telling` that tell nothing of what is not thin, which is all that is seen, and what is said of each."""
    telling, stored, said = _telling(table) if len(table) else [], table.of_role("density"), {}
    dense, thin = np.ones(len(table), bool), ""
    if stored is not None and stored in telling:
        dense, even = _dense(table.columns[stored])
        thin = "" if dense.all() else " that are not thin"
        said = {stored: f"is about the same for all particles{thin}"} if even and velocity_name(table) else {}
    same = {name: values[0] for name in telling if _is_constant(values := table.columns[name][dense])}
    return said | {name: f"is {value:.6g} for all particles{thin}" for name, value in same.items()}


def _dense(density: np.ndarray) -> tuple[np.ndarray, bool]:
    """Which particles are not thin, and whether these are about equally dense, as a liquid is, or a cloud before it moves."""
    high = np.percentile(density, LIQUID_BETWEEN[1])
    dense = ~(density < min(high, high / DECADE))
    even = bool(0 < high < LIQUID * np.percentile(density[dense], LIQUID_BETWEEN[0]))
    return (density > high / LIQUID) if even else dense, even


def is_gas(table: ParticleTable) -> bool:
    """Whether particles have temperatures, internal energies, or densities that differ, as those of a liquid do not."""
    density = table.of_role("density")
    uneven = density is not None and len(table) > 0 and not _dense(table.columns[density])[1]
    return uneven or any(table.of_role(role) is not None for role in ("temperature", "internal_energy"))


def _is_dye(name: str) -> bool:
    return any(word in plain(name) for word in ("concentration", "dye"))


def _is_constant(values: np.ndarray) -> bool:
    """Whether values are the same, but for rounding."""
    return len(values) > 0 and bool(np.ptp(values) <= ROUNDING * np.abs(values).max())


def _default(table: ParticleTable, density: Gather | None) -> tuple[np.ndarray, str]:
    speed = ["speed"] if velocity_name(table) else []
    stored, telling, same = table.of_role("density"), _telling(table), _same(table)
    varying = [name for name in telling if name not in same]
    summed = density is not None and stored not in varying and not (speed and table.of_role("mass") is None)
    if not varying and density is not None and len(table):
        if stored is None and spreads(density(), CLUSTERED):
            varying = ["density"]
        elif summed and not speed and _dense(density())[1]:
            differing = [name for name in telling if not _is_constant(table.columns[name])]  # if of what is thin alone
            varying = differing or ["xyz"[int(np.argmax(np.abs(table.up)))]]
    candidates = [*varying, *speed, *(["density"] if summed else []), *([] if speed else telling)] or ["z"]
    for candidate in candidates:
        shown = _of_flow(table) if candidate == "speed" else candidate
        values, full_name = choose_quantity(table, shown, density=density)
        if len(values) == 0 or not _is_constant(values):
            if candidate not in ("speed", *"xyz") and not _is_dye(candidate) and values.min(initial=1) > 0 and spreads(values):
                return choose_quantity(table, LOG_PREFIX + candidate, density=density)
            return values, full_name
    return choose_quantity(table, candidates[0], density=density)


def _of_flow(table: ParticleTable) -> str:
    """The speed, or where all are about as fast the component of velocities that spreads most."""
    name = str(velocity_name(table))
    speed, spread = choose_quantity(table, "speed")[0], np.ptp(table.columns[name], 0) if len(table) else np.zeros(1)
    steady = 0 < STEADY * speed.max(initial=0) < speed.min(initial=np.inf) and spread.max() > np.ptp(speed)
    return f"{name}.{_component_names(table, table.columns[name])[int(spread.argmax())]}" if steady else "speed"


def _scalar(table: ParticleTable, name: str) -> np.ndarray:
    column = table.columns[name]
    if column.ndim == 1:
        return column.astype(np.float64)
    choices = [f"{name}.{c}" for c in _component_names(table, column)]
    if name == velocity_name(table):
        choices.append("speed")
    raise DataError(f"{name!r} has {column.shape[1]} components; choose one: {', '.join(choices)}")


def _component(table: ParticleTable, name: str) -> tuple[np.ndarray, str] | None:
    wanted = plain(name)
    for vector in table.vectors:
        column = table.columns[vector]
        spellings = {plain(vector), *(map(plain, ROLES["velocity"]) if vector == velocity_name(table) else ())}
        if column.shape[1] == 3 and table.sight is None and wanted in (base + SIGHT for base in spellings):
            told = "is along the line of sight of the picture of one file, and there is none; name x, y or z"
            raise DataError(f"`{vector}.{SIGHT}` {told}")
        for component in COMPONENTS if column.shape[1] == 3 else ():
            ends = (component, "r") if component == COMPONENTS[0] else (component,)
            if any(wanted == base + end for base in spellings for end in ends):
                values = component_about(column.astype(np.float64), away_from(table, center_of(table)[0]), component)
                return values, f"{vector}.{component}"
        for index, component in enumerate(_component_names(table, column)):
            if any(wanted in (base + component, f"{base}{index}") for base in spellings):
                values = _along_sight(table, column) if component == SIGHT else column[:, index].astype(np.float64)
                return values, f"{vector}.{component}"
    return None


def _along_sight(table: ParticleTable, column: np.ndarray) -> np.ndarray:
    """Of the rays from the eye to where particles are, or of the one direction that all rays have."""
    assert table.sight is not None
    place, is_eye, *lower = table.sight
    position = table.position.astype(np.float64)
    if table.box_size is not None:  # where they are shown
        corner = lower[0] if lower else 0.0
        position = corner + np.mod(position - corner, table.box_size)
    rays = np.atleast_2d(position - place if is_eye else np.asarray(place, np.float64))
    away = np.linalg.norm(rays, axis=1)
    return np.asarray((column * rays).sum(1) / np.where(away > 0, away, 1))


def _component_names(table: ParticleTable, column: np.ndarray) -> tuple[str, ...]:
    width = column.shape[1]
    names = tuple("xyz"[:width]) if width <= 3 else tuple(map(str, range(width)))
    return (*names, SIGHT) if width == 3 and table.sight is not None else names


def velocity_name(table: ParticleTable) -> str | None:
    """The column of velocities, where there is one."""
    return next((n for n in table.vectors if has_role(n, "velocity")), None)


def _finite(values: np.ndarray, name: str) -> np.ndarray:
    remedy = "choose another quantity or repair the file"
    refuse_rows(~np.isfinite(values), values, f"the quantity {name!r} must be finite", remedy)
    return values
