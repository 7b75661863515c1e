r"""Quantities that people ask for by name and files do not hold: formulas of columns, with constants that are said.

Flow: name, ParticleTable -> [derived: formula_of] -> Formula, an expression of columns -> quantities.

| name | formula | unit |
|---|---|---|
| `temperature` | $(\gamma - 1) u \mu m_p / k_B$ with $\mu = 4 / (1 + 3 X + 4 X x_e)$ | K |
| `pressure` | $(\gamma - 1) \rho u$ | what follows |
| `entropy` | $(\gamma - 1) u \rho^{1 - \gamma}$ | what follows |
| `sound_speed` | $\sqrt{\gamma (\gamma - 1) u}$ | that of a speed |
| `volume` | $m / \rho$ | that of a volume |
| `nH` | $X \rho / m_p$, hydrogen nuclei a volume; its column is N_H | length to the power -3 |
| `metallicity` | mass fraction of metals, whatever the file calls it | |

u is energy a mass, $x_e$ electrons a hydrogen nucleus. $\gamma$ = 5/3 and the mass fraction X = 0.76 of hydrogen, unless the file
states others. Where it states no electrons, gas is ionised above 10^4 K, neutral below, and at 10^4 K where it is both.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxsph.io.damage import DataError
from jaxsph.io.table import TEMPERATURE, VELOCITY, CodeUnit, ParticleTable, plain

PROTON, BOLTZMANN = 1.67262192e-24, 1.380649e-16  # CGS
GAMMA, HYDROGEN = 5 / 3, 0.76
IONISED_ABOVE = 1e4  # K, as codes of the Gadget family have it at their start
KILOMETRE = 1e5
ENERGY = tuple(2 * power for power in VELOCITY)  # a mass
ELECTRONS = "electronabundance", "electron_abundance", "ne", "elec", "elecabund"
OF_ELEMENTS = "elementmassfractions", "gfm_metals"  # vectors whose first is hydrogen
METALS = "metallicity", "metallicities", "gfm_metallicity", "metalmassfractions", "metal_mass_fraction", "metals"
MOLECULAR = "meanmolecularweight", "mean_molecular_weight", "mu"
ALSO = {
    "temp": "temperature",
    "temperatures": "temperature",
    "press": "pressure",
    "soundspeed": "sound_speed",
    "cs": "sound_speed",
}
ALSO |= {"nh": "nH", "hydrogennumberdensity": "nH"}
Find = Callable[[str], str | None]


class Formula(NamedTuple):
    """An expression of columns, its unit where that does not follow from those of columns, and a sentence on it."""

    name: str
    text: str
    said: str
    unit: CodeUnit | None = None


def formula_of(table: ParticleTable, name: str, find: Find, unit_of: Callable[[str], CodeUnit | None]) -> Formula | None:
    """How a quantity of this name is computed, where there is a formula.

    Args:
        table: what the file holds, none of it of that name.
        find: gives the name of the column that has a role, such as `"internal_energy"`.
        unit_of: gives the unit of a quantity.

    Raises:
        ValueError: the file lacks a column, or the unit of one, that the formula needs.
    """
    wanted = ALSO.get(plain(name), name.lower().replace("-", "_"))
    if wanted not in FORMULAS:
        return None
    gamma = table.units.gas.get("gamma", GAMMA)
    names = {"u": find("internal_energy"), "m": find("mass"), "rho": find("density") or "density"}
    needs, make = FORMULAS[wanted]
    for role in needs:
        if names[role] is None:
            what = {"u": "internal energy (InternalEnergy, u)", "m": "masses"}[role]
            raise DataError(f"`{wanted}` cannot be computed without {what}")
    if "u" in needs and not gamma > 1:
        raise DataError(f"`{wanted}` cannot be computed of isothermal gas, with gamma = {gamma:g} in the file")
    columns = {role: f"`{column}`" for role, column in names.items() if column is not None}
    return make(table, columns, gamma, unit_of)


def _said(name: str, formula: str, gamma: float | None = None, more: str = "") -> str:
    stated = "" if gamma is None else f", with gamma = {'5/3' if gamma == GAMMA else format(gamma, 'g')}"
    return f"{name} is computed: {formula}{stated}{more}".replace("`", "")


def _temperature(table: ParticleTable, columns: dict[str, str], gamma: float, unit_of: Callable[..., CodeUnit | None]) -> Formula:
    u = columns["u"]
    hydrogen, of_hydrogen = _hydrogen(table)
    electrons, weight = table.named(*ELECTRONS), table.named(*MOLECULAR)
    mu, said = f"(4 / (1 + 3 * {hydrogen} + 4 * {hydrogen} * `{electrons}`))", f"4 / (1 + 3 X + 4 X {electrons}), {of_hydrogen}"
    if weight is not None and table.columns[weight].ndim == 1:
        mu, said = f"`{weight}`", f"{weight} of the file"
    elif "mu" in table.units.gas:
        mu = f"{table.units.gas['mu']:.9g}"
        said = f"{mu}, which the file states"
    elif electrons is None:
        mu = f"(4 / (3 + 5 * {hydrogen}))"
    said = f"(gamma - 1) u mu m_p / k_B of {u}, with mu = {said}"
    unit = unit_of(u.strip("`"))
    known = unit is not None and unit.powers == ENERGY
    kelvin = (gamma - 1) * PROTON / BOLTZMANN * (_physical(table, unit) if known and unit is not None else KILOMETRE**2)
    text = f"{kelvin:.9g} * {mu} * {u}"
    if electrons is None and mu.startswith("(4"):
        neutral = text.replace(mu, f"(4 / (1 + 3 * {hydrogen}))")
        text = f"max({text}, min({neutral}, {IONISED_ABOVE:g}))"
        of = "mu = 4 / (3 + 5 X) of ionised gas above 10^4 K, 4 / (1 + 3 X) of neutral gas below, as the file has no electrons"
        said = f"(gamma - 1) u mu m_p / k_B of {u}, with {of}, {of_hydrogen}"
    if not known:
        needs = f"`temperature` cannot be computed, as the file does not state the unit of {u}"
        raise DataError(f"{needs}; where that is (km/s)^2, write the expression {text!r}, in K")
    return Formula("temperature", text, _said("temperature", said, gamma), CodeUnit(1.0, TEMPERATURE))


def _physical(table: ParticleTable, unit: CodeUnit) -> float:
    """What 1 in a unit is in CGS, with the scale factor and the Hubble parameter of the file."""
    return float(unit.cgs / (1 + (table.units.redshift or 0)) ** unit.a * (table.units.hubble or 1) ** unit.h)


def _hydrogen(table: ParticleTable) -> tuple[str, str]:
    """The mass fraction of hydrogen as an expression, and in words."""
    elements, metals = table.named(*OF_ELEMENTS), table.named("metallicity")
    if elements is not None and table.columns[elements].ndim == 2:
        return f"`{elements}.0`", f"X = {elements}.0"
    if metals is not None and table.columns[metals].ndim == 2:
        return f"(1 - `{metals}.0` - `{metals}.1`)", f"X = 1 - {metals}.0 - {metals}.1"
    stated = table.units.gas.get("hydrogen")
    return f"{stated or HYDROGEN:.9g}", f"X = {stated or HYDROGEN:.9g}{' of the file' if stated else ''}"


def _by_energy(name: str, formula: str, text: str) -> Callable[..., Formula]:
    """A formula of u, rho and gamma alone, whose unit follows."""

    def make(table: ParticleTable, columns: dict[str, str], gamma: float, _: Callable[..., CodeUnit | None]) -> Formula:
        return Formula(name, text.format(g=gamma, less=gamma - 1, **columns), _said(name, formula, gamma))

    return make


def _hydrogen_density(
    table: ParticleTable, columns: dict[str, str], _: float, unit_of: Callable[..., CodeUnit | None]
) -> Formula:
    hydrogen, said = _hydrogen(table)
    unit = unit_of(columns["rho"].strip("`"))
    if unit is None:
        raise DataError("`nH` cannot be computed, as the file does not state the unit of its density")
    atoms = unit.over(CodeUnit(PROTON, (0, 1, 0, 0)))
    return Formula("nH", f"{hydrogen} * {columns['rho']}", _said("nH", "X rho / m_p, with ", more=said), atoms)


def _volume(table: ParticleTable, columns: dict[str, str], *_: object) -> Formula:
    return Formula("volume", f"{columns['m']} / {columns['rho']}", _said("volume", f"{columns['m']} / {columns['rho']}"))


def _metallicity(table: ParticleTable, *_: object) -> Formula | None:
    column = "Z" if "Z" in table.columns else table.named(*METALS)
    if column is None:
        return None
    text = column if table.columns[column].ndim == 1 else f"{column}.0"
    return Formula("metallicity", f"`{text}`", _said("metallicity", text), CodeUnit(1.0, (0, 0, 0, 0)))


FORMULAS: dict[str, tuple[str, Callable[..., Formula | None]]] = {
    "temperature": ("u", _temperature),
    "pressure": ("u", _by_energy("pressure", "(gamma - 1) rho u", "{less:.9g} * {rho} * {u}")),
    "entropy": ("u", _by_energy("entropy", "(gamma - 1) u rho^(1 - gamma)", "{less:.9g} * {u} / {rho} ** {less:.9g}")),
    "sound_speed": ("u", _by_energy("sound_speed", "sqrt(gamma (gamma - 1) u)", "sqrt({g:.9g} * {less:.9g} * {u})")),
    "volume": ("m", _volume),
    "nH": ("", _hydrogen_density),
    "metallicity": ("", _metallicity),
}
"""Which of u and m each needs, and what makes it."""


def centre_of_mass(table: ParticleTable, mass: np.ndarray | None) -> np.ndarray:
    """The middle of masses, (3,), of equal ones where there are none; in a periodic box that on circles (Bai & Breen 2008)."""
    position = table.position.astype(np.float64)
    if not len(position):
        return np.zeros(3)
    mass = None if mass is None or mass.sum() == 0 else mass  # as of tracers
    if table.box_size is None:
        return np.average(position, axis=0, weights=mass)
    turn = np.exp(2j * np.pi * position / table.box_size)
    angle = np.angle(np.average(turn, axis=0, weights=mass)) % (2 * np.pi)
    return angle / (2 * np.pi) * np.asarray(table.box_size)


def away_from(table: ParticleTable, center: np.ndarray) -> np.ndarray:
    """Positions from a place, (N, 3) float64; in a periodic box on the shortest way."""
    away = table.position.astype(np.float64) - center
    if table.box_size is None:
        return away
    sides = np.asarray(table.box_size)
    return away - sides * np.round(away / sides)


def turned(vector: np.ndarray, away: np.ndarray, component: str) -> np.ndarray:
    """A vector's component at places (N, 3) from a middle: `"radial"`, `"phi"` about the z axis, or `"theta"`, down from it."""
    radius, across = np.linalg.norm(away, axis=1), np.hypot(away[:, 0], away[:, 1])
    if component == "radial":
        return (vector * away).sum(1) / np.where(radius > 0, radius, 1)
    x, y, z = away.T
    over = np.where(across > 0, across, 1)
    if component == "phi":
        return (x * vector[:, 1] - y * vector[:, 0]) / over
    outward = (x * vector[:, 0] + y * vector[:, 1]) / over
    return (z * outward - across * vector[:, 2]) / np.where(radius > 0, radius, 1)
