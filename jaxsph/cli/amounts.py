"""What a file's particles carry, as amounts that add up along rays, or as values of which there are means.

Flow: table, particles -> [amounts] -> columns, planes.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np

from jaxsph import io
from jaxsph.analysis.projection.project import WEIGHED
from jaxsph.cli import console
from jaxsph.cli.console import UsageError
from jaxsph.io.settle.assemble import Settled
from jaxsph.io.settle.quantities import (
    choose_quantity,
    formulas_said,
    is_log,
    unit_of,
    without_logarithm,
)
from jaxsph.io.settle.supports import density_as_summed
from jaxsph.io.table import PURE, CodeUnit, has_role
from jaxsph.model.particles.particles import Particles

MASS, VOLUME, NUMBER = "mass", "volume", "number"


class Amounts:
    """What a file's particles hold, in float64."""

    def __init__(self, table: io.ParticleTable, particles: Particles) -> None:
        support = particles.to_numpy()["support"].astype(np.float64)
        self._settled = Settled(dataclasses.replace(table, support=support, kernel=particles.kernel), None, None)
        self.table, self.mass_name = self._settled.table, self._settled.mass_name
        self.thickness = self._settled.thickness
        self.weighing = NUMBER if self.mass_name is None else MASS  # by which means are, where nobody says so

    def called(self, name: Any) -> Any:
        """A name, if any, that of a column of masses as `mass`: these are summed as they are, however the file calls them."""
        return MASS if self.mass_name is not None and has_role(name or "", "mass") else name

    def values(self, name: str) -> np.ndarray:
        """A number a particle."""
        if name == NUMBER:
            return np.ones(len(self.table))
        if name == MASS and self.mass_name is None:
            raise UsageError("the file has no masses; project --of number, volume or a quantity")
        if name == VOLUME:
            return self.volume
        notes = without_logarithm(self.table, self._settled.density, ..., name)
        console.say_notes([*notes, *formulas_said(self.table, name)])
        return choose_quantity(self.table, name, density=self._settled.density)[0]

    def amounts(self, name: str) -> np.ndarray:
        """What is summed up of a name: masses and volumes as they are, of all that each stands for, others times volume."""
        each = self.table.stands_for if name in (MASS, NUMBER) else 1.0 if name == VOLUME else self.volume
        return self.values(name) * each

    @functools.cached_property
    def density(self) -> np.ndarray:
        """As stored where that is the density, else summed over each particle's support."""
        stored = self._settled.stored
        if stored.column is not None:
            return density_as_summed(self.table, stored.column)
        return self._settled.density() if stored.told else self.values("density")

    @functools.cached_property
    def volume(self) -> np.ndarray:
        """Those of the particles."""
        return self._settled.volumes()[0]

    def unit(self, options: Any) -> CodeUnit | None:
        """The unit of what is asked for, as far as the file states those that it is made of."""
        of_values = options.along in (*WEIGHED, "max") or (options.weight is not None and options.along is None)
        name = options.of or ("density" if of_values else self.weighing)
        own, length = unit_of(self.table, (self.mass_name or MASS) if name == MASS else name), self.table.units.length
        if not of_values:
            own = PURE if name in (NUMBER, VOLUME) else own
            own = own and length and own.over(length, 2 if name in (MASS, NUMBER) else 2 - self.table.dimensions)
        return None if options.emission is not None or is_log(name) else own
