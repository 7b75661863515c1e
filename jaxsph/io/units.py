"""What 1 in a file is, as far as the file states it.

Flow: file -> `readers.stated_units` -> [units: FileUnits] of a ParticleTable -> `settle.unit_names` -> labels.

Numbers are left as stored: where a file states powers of the scale factor a and the Hubble parameter h, units carry them, and
nothing is multiplied out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

BASE = "cm", "g", "s", "K"
LENGTH, MASS, TIME, TEMPERATURE = (1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1)
VELOCITY = (1, 0, -1, 0)
LENGTHS = {"cm": 1.0, "mm": 0.1, "m": 1e2, "km": 1e5, "AU": 1.495978707e13}
LENGTHS |= {f"{prefix}pc": 3.0856775814913673e18 * size for prefix, size in (("", 1), ("k", 1e3), ("M", 1e6), ("G", 1e9))}
"""In cm."""
SAME = 3e-5
"""Relative difference of a unit to one that it may be called after: codes have constants of four or five digits."""


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
