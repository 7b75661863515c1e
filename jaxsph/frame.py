"""A frame, as the calls of its stages: written once for eager rendering, for the forecast of its programs, and for traces.

Flow: viewing, plan -> [frame: order -> make_grid -> decide -> cast_part] -> layers.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxsph.access.grid import Grid
from jaxsph.access.lattice import Lattice
from jaxsph.access.ordering import Ordered
from jaxsph.control.pilot import PilotPlan
from jaxsph.layers import OfParts
from jaxsph.model.camera import Camera
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics.executors import Executor
from jaxsph.plan import Plan
from jaxsph.stages import (
    Decided,
    Limits,
    add_lattices,
    cast_part,
    decide_by_bounds,
    decide_by_pilot,
    decide_full_rate,
    look_part,
    make_grid,
    sum_part,
    wanted_cells,
)


class Band(NamedTuple):
    """What is known of a band.

    Attributes:
        of_parts: what its rays met and what was decided, part by part.
        faults: fault word of its lists.
        filled, pairs: slabs that a particle can touch, and (particle, bundle) pairs.
    """

    of_parts: OfParts
    faults: Int[Array, ""]
    filled: Int[Array, ""]
    pairs: Int[Array, ""]


@dataclasses.dataclass(frozen=True)
class Frame:
    """What all bands of a frame have in common; `plan` is that of the frame, and `parts` are cast side by side."""

    ordered: Ordered
    camera: Camera
    transfer: TransferFunction
    limits: Limits | None
    plan: Plan
    kernel: str
    parts: int

    @property
    def shapes(self) -> Plan:
        """What the grid and the cast are compiled for, with any error control."""
        return dataclasses.replace(self.plan, control=None)

    def band(self, first_row: Int[Array, ""], run: Executor) -> Band:
        """The band that begins at a row of pixels."""
        made = run.one("grid", make_grid, (self.ordered, self.camera, first_row), plan=self.shapes)
        grid = made.of(self.ordered)
        decided, lattice = self._decide(grid, run)
        works = [part.work for part in decided] if lattice is None else [decided[0].work] * self.parts
        inputs = [(grid, self.camera, self.transfer, work, lattice, nth) for work, nth in zip(works, self._each, strict=True)]
        rays = run.each("cast", cast_part, inputs, parts=self.parts, plan=self.shapes, kernel=self.kernel)
        return Band((tuple(rays), tuple(part.layers for part in decided)), made.lists.faults, made.filled, made.pairs)

    @property
    def _each(self) -> list[Int[Array, ""]]:
        return [jnp.int32(nth) for nth in range(self.parts)]

    def _decide(self, grid: Grid, run: Executor) -> tuple[list[Decided], Lattice | None]:
        """What is to be marched, part by part; and the lattice, of which there is one decision for all parts."""
        if self.limits is None or self.plan.control is None:
            return self._leave(grid, run, with_levels=False), None
        if isinstance(self.plan.control, PilotPlan):
            return self._ask_pilot(grid, run)
        return self._bound(grid, run), None

    def _leave(self, grid: Grid, run: Executor, *, with_levels: bool) -> list[Decided]:
        inputs = [(grid, self.transfer, nth) for nth in self._each]
        return run.each("adapt", decide_full_rate, inputs, parts=self.parts, plan=self.shapes, with_levels=with_levels)

    def _ask_pilot(self, grid: Grid, run: Executor) -> tuple[list[Decided], Lattice]:
        view = (grid, self.camera, self.transfer)
        inputs = [(*view, nth) for nth in self._each]
        lattices = run.each("adapt", sum_part, inputs, parts=self.parts, plan=self.plan, kernel=self.kernel)
        lattice = run.one("adapt", add_lattices, (tuple(lattices),)) if self.parts > 1 else lattices[0]
        # slab by slab what is at hand stays in the cache: one program is faster than parts side by side
        return [run.one("adapt", decide_by_pilot, (*view, self.limits, lattice), plan=self.plan)], lattice

    def _bound(self, grid: Grid, run: Executor) -> list[Decided]:
        look = functools.partial(run.each, "adapt", parts=self.parts, plan=self.plan)
        probes = look(look_part, [(grid, self.transfer, self.limits, nth) for nth in self._each])
        pays, wanted = run.one("adapt", wanted_cells, (tuple(probes),))
        if not run.may_hold(pays):
            return self._leave(grid, run, with_levels=True)
        view = (grid, self.camera, self.transfer, self.limits)
        return look(decide_by_bounds, [(*view, of_part, nth) for of_part, nth in zip(wanted, self._each, strict=True)])
