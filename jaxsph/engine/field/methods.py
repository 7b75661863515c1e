"""Ways to find the sums of slabs: from all particles at all rays, at some of them, or from a lattice.

Flow: schedule -> [methods: gather, nodes, interpolation] -> media.

A schedule names the method of each slab by its place here; slabs that are marched together have the same one.
"""

from __future__ import annotations

import functools
from typing import Protocol

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.field.gather import gather
from jaxsph.engine.field.interpolation import interpolate_slabs
from jaxsph.engine.field.lattice import Lattice
from jaxsph.engine.field.nodes import gather_subsampled
from jaxsph.engine.field.scattered import gather_scattered
from jaxsph.engine.field.schedule import MAX_SPACING_LEVEL
from jaxsph.engine.field.sums import Sums
from jaxsph.engine.field.tasks import SlabTask


class SlabMethod(Protocol):
    """How sums are found."""

    def __call__(self, task: SlabTask) -> Sums:
        """Sums (tasks, samples, rows, columns) at all samples of slabs."""
        ...


def methods_of(grid: Grid, kernel: str, lattice: Lattice | None, scattered: bool) -> list[SlabMethod]:
    """In the order of `schedule.DENSE`, `SUBSAMPLED`, `INTERPOLATED` and on; without a lattice, the first alone.

    Args:
        scattered: whether rays are no tensor product.
    """
    from_all = gather_scattered if scattered else gather
    dense = functools.partial(from_all, grid.ordered, grid.lists.rank, kernel=kernel)
    if lattice is None:
        return [dense]
    subsampled = functools.partial(gather_subsampled, grid.ordered, grid.lists.rank, kernel=kernel)
    interpolated = functools.partial(interpolate_slabs, lattice, grid)
    return [dense, subsampled, *(functools.partial(interpolated, level=level) for level in range(MAX_SPACING_LEVEL + 1))]
