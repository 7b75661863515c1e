"""Ways to find the sums of slabs: from all particles at all rays, at some of them, or from a lattice.

Flow: tasks -> [methods: gather, interpolation] -> media.

A schedule names the method of each slab; those that are marched together have the same one.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Protocol

import jax.numpy as jnp
from jax import lax

from jaxsph.access.grid import Grid
from jaxsph.access.lists import BUNDLE
from jaxsph.field.gather import gather
from jaxsph.field.interpolation import gather_subsampled, interpolate
from jaxsph.field.lattice import Lattice
from jaxsph.field.schedule import MAX_SPACING_LEVEL
from jaxsph.field.sums import Sums
from jaxsph.field.tasks import SlabTask


class SlabMethod(Protocol):
    """How sums (tasks, samples, rows, columns) are found."""

    def __call__(self, task: SlabTask) -> Sums:
        """The sums at all samples of slabs."""
        ...


@dataclasses.dataclass(frozen=True)
class Dense:
    """From all particles of a slab's windows, at all rays."""

    grid: Grid
    kernel: str

    def __call__(self, task: SlabTask) -> Sums:
        """See `SlabMethod`."""
        return gather(self.grid.ordered, self.grid.lists.rank, task, self.kernel)


@dataclasses.dataclass(frozen=True)
class Subsampled:
    """From all particles at a few rays of a bundle, and by interpolation between them."""

    grid: Grid
    kernel: str

    def __call__(self, task: SlabTask) -> Sums:
        """See `SlabMethod`."""
        return gather_subsampled(self.grid.ordered, self.grid.lists.rank, task, self.kernel)


@dataclasses.dataclass(frozen=True)
class Interpolated:
    """From the lattice, for samples `2**level` fine ones apart."""

    lattice: Lattice
    grid: Grid
    level: int

    def __call__(self, task: SlabTask) -> Sums:
        """See `SlabMethod`."""
        corner = (side[task.bundle] * self.lattice.region.spacing.across for side in self.lattice.region.place(self.grid)[:2])
        row, column = corner
        found = interpolate(self.lattice, task.slab, (row, column), task.depth.shape[1], self.level)
        shape = (*found.packed[0].shape[:2], BUNDLE, BUNDLE)
        return dataclasses.replace(found, packed=tuple(value.reshape(shape) for value in found.packed))


def sums_by_schedule(grid: Grid, kernel: str, lattice: Lattice | None, task: SlabTask) -> Sums:
    """The sums of slabs by the method that all of them have in the schedule."""
    if lattice is None or task.entry.method is None:
        return Dense(grid, kernel)(task)
    methods: list[SlabMethod] = [Dense(grid, kernel), Subsampled(grid, kernel)]
    methods += [Interpolated(lattice, grid, level) for level in range(MAX_SPACING_LEVEL + 1)]
    # a dummy has any method, and drops what it finds
    method = jnp.where(task.slab < grid.windows.count.shape[0], task.entry.method, 0).max()
    return lax.switch(method, [functools.partial(one, task) for one in methods])
