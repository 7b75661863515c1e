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

from jaxsph.io.damage import DataError
from jaxsph.io.table import PURE, TEMPERATURE, VELOCITY, CodeUnit, ParticleTable, plain

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
    "nh": "nH",
    "hydrogennumberdensity": "nH",
}  # other names, but for case and punctuation
UnitOf = Callable[[ParticleTable, str], CodeUnit | None]


class Formula(NamedTuple):
    """An expression of columns, its unit where that does not follow from those of columns, and a sentence on it."""

    name: str
    text: str
    said: str
    unit: CodeUnit | None = None

    @classmethod
    def of(cls, gas: _Gas, text: str, words: str, unit: CodeUnit | None = None) -> Formula:
        """Make a formula of its text, and of words that say it."""
        return cls(gas.name, text, f"{gas.name} is computed: {words}", unit)

    @classmethod
    def by_gamma(cls, gas: _Gas, text: str, words: str, unit: CodeUnit | None = None) -> Formula:
        """Make one that has the adiabatic index in it, which is said, too."""
        gamma = "5/3" if gas.gamma == GAMMA else f"{gas.gamma:g}"
        return cls.of(gas, text, f"{words}, with gamma = {gamma}", unit)


def formula_of(table: ParticleTable, name: str, unit_of: UnitOf) -> Formula | None:
    """How a quantity of this name is computed, where there is a formula.

    Args:
        table: what the file holds, none of it of that name.
        name: but for case and punctuation.
        unit_of: gives the unit of a quantity of a table.

    Raises:
        ValueError: the file lacks a column, or the unit of one, that the formula needs.
    """
    name = ALSO.get(plain(name), name.lower().replace("-", "_"))
    return FORMULAS[name](_Gas(name, table, unit_of)) if name in FORMULAS else None


class _Gas(NamedTuple):
    """Columns and constants that formulas are made of, for the quantity `name`."""

    name: str
    table: ParticleTable
    unit_of: UnitOf

    @property
    def gamma(self) -> float:
        return self.table.units.gas.get("gamma", GAMMA)

    @property
    def density(self) -> str:
        return self.table.of_role("density") or "density"

    @property
    def mass(self) -> str:
        return self._require("mass", "masses")

    @property
    def energy(self) -> str:
        """That a mass, of gas that is not isothermal."""
        column = self._require("internal_energy", "internal energy (InternalEnergy, u)")
        if not self.gamma > 1:
            raise DataError(f"`{self.name}` cannot be computed of isothermal gas, with gamma = {self.gamma:g} in the file")
        return column

    def _require(self, role: str, what: str) -> str:
        column = self.table.of_role(role)
        if column is None:
            raise DataError(f"`{self.name}` cannot be computed without {what}")
        return column

    def hydrogen(self) -> tuple[str, str]:
        """The mass fraction X of hydrogen as an expression, and in words."""
        elements, metals = self.table.named(*OF_ELEMENTS), self.table.named("metallicity")
        if elements in self.table.vectors:
            return f"`{elements}.0`", f"X = {elements}.0"
        if metals in self.table.vectors:
            return f"(1 - `{metals}.0` - `{metals}.1`)", f"X = 1 - {metals}.0 - {metals}.1"
        stated = self.table.units.gas.get("hydrogen")
        return f"{stated or HYDROGEN:.9g}", f"X = {stated or HYDROGEN:.9g}{' of the file' if stated else ''}"


def _temperature(gas: _Gas) -> Formula:
    u, (hydrogen, of_hydrogen) = gas.energy, gas.hydrogen()
    unit, electrons, weight = gas.unit_of(gas.table, u), gas.table.named(*ELECTRONS), gas.table.named(*MOLECULAR)
    known = unit is not None and unit.powers == ENERGY
    kelvin = (gas.gamma - 1) * PROTON / BOLTZMANN * (gas.table.units.physical(unit) if known and unit else KILOMETRE**2)

    def of_gas(mu: str) -> str:
        return f"{kelvin:.9g} * {mu} * `{u}`"

    if weight in gas.table.scalars:
        text, words = of_gas(f"`{weight}`"), f"{weight} of the file"
    elif "mu" in gas.table.units.gas:
        mu = f"{gas.table.units.gas['mu']:.9g}"
        text, words = of_gas(mu), f"{mu}, which the file states"
    elif electrons is not None:
        text = of_gas(f"(4 / (1 + 3 * {hydrogen} + 4 * {hydrogen} * `{electrons}`))")
        words = f"4 / (1 + 3 X + 4 X {electrons}), {of_hydrogen}"
    else:
        ionised, neutral = of_gas(f"(4 / (3 + 5 * {hydrogen}))"), of_gas(f"(4 / (1 + 3 * {hydrogen}))")
        text = f"max({ionised}, min({neutral}, {IONISED_ABOVE:g}))"
        of = "4 / (3 + 5 X) of ionised gas above 10^4 K, 4 / (1 + 3 X) of neutral gas below, as the file has no electrons"
        words = f"{of}, {of_hydrogen}"
    if not known:
        needs = f"`temperature` cannot be computed, as the file does not state the unit of `{u}`"
        raise DataError(f"{needs}; where that is (km/s)^2, write the expression {text!r}, in K")
    return Formula.by_gamma(gas, text, f"(gamma - 1) u mu m_p / k_B of {u}, with mu = {words}", CodeUnit(1.0, TEMPERATURE))


def _hydrogen_density(gas: _Gas) -> Formula:
    (hydrogen, words), unit = gas.hydrogen(), gas.unit_of(gas.table, gas.density)
    if unit is None:
        raise DataError("`nH` cannot be computed, as the file does not state the unit of its density")
    atoms = unit.over(CodeUnit(PROTON, (0, 1, 0, 0)))
    return Formula.of(gas, f"{hydrogen} * `{gas.density}`", f"X rho / m_p, with {words}", atoms)


def _metallicity(gas: _Gas) -> Formula | None:
    column = "Z" if "Z" in gas.table.columns else gas.table.named(*METALS)
    if column is None:
        return None
    text = column if column in gas.table.scalars else f"{column}.0"
    return Formula.of(gas, f"`{text}`", text, PURE)


FORMULAS: dict[str, Callable[[_Gas], Formula | None]] = {
    "temperature": _temperature,
    "pressure": lambda gas: Formula.by_gamma(gas, f"{gas.gamma - 1:.9g} * `{gas.density}` * `{gas.energy}`", "(gamma - 1) rho u"),
    "entropy": lambda gas: Formula.by_gamma(
        gas, f"{gas.gamma - 1:.9g} * `{gas.energy}` / `{gas.density}` ** {gas.gamma - 1:.9g}", "(gamma - 1) u rho^(1 - gamma)"
    ),
    "sound_speed": lambda gas: Formula.by_gamma(
        gas, f"sqrt({gas.gamma:.9g} * {gas.gamma - 1:.9g} * `{gas.energy}`)", "sqrt(gamma (gamma - 1) u)"
    ),
    "volume": lambda gas: Formula.of(gas, f"`{gas.mass}` / `{gas.density}`", f"{gas.mass} / {gas.density}"),
    "nH": _hydrogen_density,
    "metallicity": _metallicity,
}
