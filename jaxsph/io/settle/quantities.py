r"""Choose, or derive, the scalar that the transfer function sees.

Flow: ParticleTable -> [quantities] -> Particles.

| name | what it gives |
|---|---|
| a scalar column | that column; case and punctuation do not matter |
| `velocity.x`, `vx`, `B.2` | a component of a vector column |
| `density` | the stored density, else $\rho_i = \sum_j m_j W(\|x_i - x_j\|, H_i)$ (without masses: number density) |
| `speed` | $\|v\|$ |
| `x`, `y`, `z` | a coordinate |
| `log10:NAME` | decimal logarithm of any of these; values $\le 0$ become the smallest positive one |
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxsph.io.damage import DataError
from jaxsph.io.table import ParticleTable, plain, refuse_rows
from jaxsph.numerics.names import did_you_mean

ROLES: dict[str, tuple[str, ...]] = {
    "density": ("density", "densities", "rho", "rhop", "gas_density", "den"),
    "mass": ("mass", "masses", "particle_mass", "m"),
    "velocity": ("velocity", "velocities", "vel", "vxyz", "v"),
    "temperature": ("temperature", "temperatures", "temp"),
    "internal_energy": ("internal_energy", "internal_energies", "u", "int_energy"),
}
"""What codes call the same thing."""

LOG_PREFIX = "log10:"
LOG_DECADES = 2.0  # positive quantities that span more decades than this are shown by their logarithm when nobody chose

DECADE, DECADE_BETWEEN = 10.0, (2, 98)
"""Ratio of values, between these percentiles, from which opacity follows their logarithm."""

CLUSTERED = 30.0
"""The same of a summed density from which it tells more than speeds: particles that lie evenly are below 10, spray among them."""
ROUNDING = 1e-5  # of the largest value, up to which values differ that are meant to be the same
STEADY = 0.9  # least speed over largest, from which a component of velocities tells more

LIQUID, LIQUID_BETWEEN = 1.5, (25, 95)
"""Ratio of densities, between these percentiles, up to which they tell less than speeds do: what many codes store of a liquid's
free surface misses what is beyond it.
"""

Gather = Callable[[], Float[np.ndarray, " particles"]]


def choose_quantity(
    table: ParticleTable, name: str | None = None, *, density: Gather | None = None
) -> tuple[Float[np.ndarray, " particles"], str]:
    """The quantity called `name`, or the most telling one when `name` is `None`.

    Without a name, the first of these that the table has and that is not the same for all particles: a concentration
    or dye, temperature, internal energy, stored density unless it hardly varies and there are velocities, summed density if none
    is stored and particles cluster, as stars and dark matter do, speed, or a component of velocities where all are as fast,
    summed density unless there are velocities and no masses, or the stored one hardly varies; so a liquid at rest is shown by its
    speed, as it is when it moves. Temperature, internal energy and density become `log10:...` when they are
    positive and span more than two decades.

    Args:
        table: the particles.
        name: see the table at the top of this module.
        density: gives the summed density when the table holds none; `None` means that it cannot be derived.

    Returns:
        (N,) float64 values, all finite, and the full name of what they are.

    Raises:
        ValueError: no such quantity (the message lists those there are); a vector without a component; a logarithm of
            nothing positive; values that are not finite.
    """
    if name is None:
        return _default(table, density)
    values, full_name = _named(table, name.strip(), density)
    return _finite(values, full_name), full_name


def quantity_named(table: ParticleTable, name: str, *, density: Gather | None = None) -> Float[np.ndarray, " particles"]:
    """The same of one that has a name, as it is: values need not be finite.

    Raises:
        ValueError: no such quantity, or a vector without a component; the message lists those there are.
    """
    return _named(table, name.strip(), density)[0]


def available_quantities(table: ParticleTable) -> tuple[str, ...]:
    """Every name that `choose_quantity` takes for this table, `log10:` aside."""
    components = tuple(f"{name}.{c}" for name in table.vectors for c in _component_names(table.columns[name]))
    derived: tuple[str, ...] = () if table.named(*ROLES["density"]) else ("density",)
    derived += ("speed",) if velocity_name(table) else ()
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
    """Sentences on what `_default` would have chosen in place of what is `shown`, were it not the same for all particles."""
    before = itertools.takewhile(lambda name: name != shown.removeprefix(LOG_PREFIX), _telling(table))
    constant = [name for name in before if _is_constant(table.columns[name])]
    return [f"{name} is {table.columns[name][0]:.6g} for all particles, so {shown} is shown" for name in constant]


def _named(table: ParticleTable, name: str, density: Gather | None) -> tuple[np.ndarray, str]:
    if is_log(name):
        values, inner = _named(table, name[len(LOG_PREFIX) :].strip(), density)
        positive = _finite(values, inner)[values > 0]
        if len(values) and len(positive) == 0:
            raise DataError(f"`{LOG_PREFIX}{inner}` needs positive values, but the largest is {values.max()}; use `{inner}`")
        return np.log10(np.maximum(values, positive.min())) if len(values) else values, LOG_PREFIX + inner
    if name in table.columns:
        return _scalar(table, name), name
    column = table.named(name)
    if column is not None:
        return _scalar(table, column), column
    component = _component(table, name)
    if component is not None:
        return component
    wanted = plain(name)
    if wanted in ("x", "y", "z"):
        return table.position[:, "xyz".index(wanted)].astype(np.float64), wanted
    velocity = velocity_name(table)
    if wanted == "speed" and velocity:
        return np.linalg.norm(table.columns[velocity].astype(np.float64), axis=1), "speed"
    role = next((role for role, names in ROLES.items() if wanted in map(plain, names)), None)
    stored = table.named(*ROLES[role]) if role else None
    if stored is not None:
        return _scalar(table, stored), stored
    if role == "density" and density is not None:
        return density(), "density"
    known = available_quantities(table)
    left_out = "".join(f"; {said}" for said in table.conventions if said.startswith(f"left out {name}:"))
    meant = left_out or did_you_mean(name, known)
    raise DataError(f"there is no quantity {name!r}; there are {', '.join(known)}, and `log10:` before any of them{meant}")


def _telling(table: ParticleTable) -> list[str]:
    """Columns that tell most, the most telling first: concentrations and dyes, then what is shown by decades."""
    scaled = [table.named(*ROLES[role]) for role in ("temperature", "internal_energy", "density")]
    return [*filter(_is_dye, table.scalars), *(name for name in scaled if name in table.scalars)]


def _is_dye(name: str) -> bool:
    return any(word in plain(name) for word in ("concentration", "dye"))


def _is_constant(values: np.ndarray) -> bool:
    """Whether values are the same, but for rounding."""
    return len(values) > 0 and bool(np.ptp(values) <= ROUNDING * np.abs(values).max())


def _default(table: ParticleTable, density: Gather | None) -> tuple[np.ndarray, str]:
    speed = ["speed"] if velocity_name(table) else []
    stored, telling = table.named(*ROLES["density"]), _telling(table)
    if speed and stored in telling and len(table):  # a density that is nearly the same everywhere is that of a liquid
        low, high = np.percentile(table.columns[stored], LIQUID_BETWEEN)
        telling = [name for name in telling if name != stored or not 0 < high < LIQUID * low]
    varying = [name for name in telling if not _is_constant(table.columns[name])]
    summed = density is not None and stored not in telling and not (speed and table.named(*ROLES["mass"]) is None)
    if not varying and density is not None and stored is None and len(table) and spreads(density(), CLUSTERED):
        varying = ["density"]
    candidates = [*varying, *speed, *(["density"] if summed else []), *telling] or ["z"]
    for candidate in candidates:
        shown = _of_flow(table) if candidate == "speed" else candidate
        values, full_name = choose_quantity(table, shown, density=density)
        if len(values) == 0 or not _is_constant(values):
            wide = len(values) and values.min() > 0 and np.log10(values.max()) - np.log10(values.min()) > LOG_DECADES
            if wide and candidate not in ("speed", "z") and not _is_dye(candidate):
                return choose_quantity(table, LOG_PREFIX + candidate, density=density)
            return values, full_name
    return choose_quantity(table, candidates[0], density=density)


def _of_flow(table: ParticleTable) -> str:
    """The speed, or where all are about as fast the component of velocities that spreads most."""
    name = str(velocity_name(table))
    speed, spread = choose_quantity(table, "speed")[0], np.ptp(table.columns[name], 0) if len(table) else np.zeros(1)
    steady = 0 < STEADY * speed.max(initial=0) < speed.min(initial=np.inf) and spread.max() > np.ptp(speed)
    return f"{name}.{_component_names(table.columns[name])[int(spread.argmax())]}" if steady else "speed"


def _scalar(table: ParticleTable, name: str) -> np.ndarray:
    column = table.columns[name]
    if column.ndim == 1:
        return column.astype(np.float64)
    choices = [f"{name}.{c}" for c in _component_names(column)]
    if name == velocity_name(table):
        choices.append("speed")
    raise DataError(f"{name!r} has {column.shape[1]} components; choose one: {', '.join(choices)}")


def _component(table: ParticleTable, name: str) -> tuple[np.ndarray, str] | None:
    wanted = plain(name)
    for vector in table.vectors:
        column = table.columns[vector]
        spellings = {plain(vector), *(map(plain, ROLES["velocity"]) if vector == velocity_name(table) else ())}
        for index, component in enumerate(_component_names(column)):
            if any(wanted in (base + component, f"{base}{index}") for base in spellings):
                return column[:, index].astype(np.float64), f"{vector}.{component}"
    return None


def _component_names(column: np.ndarray) -> tuple[str, ...]:
    width = column.shape[1]
    return tuple("xyz"[:width]) if width <= 3 else tuple(map(str, range(width)))


def velocity_name(table: ParticleTable) -> str | None:
    """The column of velocities, where there is one."""
    return next((n for n in table.vectors if plain(n) in map(plain, ROLES["velocity"])), None)


def _finite(values: np.ndarray, name: str) -> np.ndarray:
    remedy = "choose another quantity or repair the file"
    refuse_rows(~np.isfinite(values), values, f"the quantity {name!r} must be finite", remedy)
    return values
