"""What a picture's key says: the quantity, its unit, that of lengths, and the moment.

Flow: ParticleTable, quantity -> [labels] -> colour bar, scale bar and time of a figure.
"""

from __future__ import annotations

import dataclasses
import importlib.util

from jaxsph.io.settle.quantities import LOG_PREFIX, ROLES, is_log, velocity_name
from jaxsph.io.table import ParticleTable
from jaxsph.io.units import CodeUnit, FileUnits, named

CODE_UNITS = "code units"
NEEDS = 'the file states units, but naming them needs the library `unyt`: pip install "jaxsph[units]"'


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
    """

    quantity: str = "quantity"
    unit: str = CODE_UNITS
    factor: float = 1.0
    length: CodeUnit | None = None
    length_unit: str | None = None
    moment: str = ""
    opacity: str = "its own quantity"

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
    factor, name = (1.0, CODE_UNITS) if code is None else named(code, magnitude, unit)
    if length is not None and length_unit is not None:
        named(length, 1.0, length_unit)  # refuses what does not agree before anything is drawn
    return Labels(quantity, name, factor, length, length_unit, moment_of(table.units))


def unit_of(table: ParticleTable, quantity: str) -> CodeUnit | None:
    """Unit of a quantity by its full name, as `choose_quantity` gives it; `None` where the file does not state it.

    Of `log10:NAME` it is that of NAME. A density that is a sum over particles has that of masses over volumes.
    """
    units, name = table.units, quantity
    if is_log(name):
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
