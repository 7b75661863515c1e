"""The stages of a frame, each a program of its own: what `frame` runs one by one, or under one trace.

Flow: viewing -> order -> make_grid -> (sum_part or look_part) -> decide_... -> cast_part -> layers.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.access.cells import Cells, find_cells
from jaxsph.access.grid import Grid
from jaxsph.access.lattice import Lattice, added, region_of
from jaxsph.access.lists import BundleLists, build_lists, bundle_origins
from jaxsph.access.ordering import Ordered, rank_particles
from jaxsph.access.parts import dealt, part_of
from jaxsph.access.view import Viewed
from jaxsph.cast.adjoint import cast
from jaxsph.cast.nodes import sum_at_nodes
from jaxsph.cast.parts import plan_of_part
from jaxsph.cast.points import Rays, evaluations
from jaxsph.control.adapt import ControlPlan, adapt, look, untouched
from jaxsph.control.pilot import PilotPlan, pilot, worth_a_lattice
from jaxsph.control.probe import Probe, worthwhile
from jaxsph.control.residuals import residuals
from jaxsph.control.worklist import Worklist, full_rate, origins
from jaxsph.model.camera import Camera
from jaxsph.model.settings import Settings
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics.checks import is_traced
from jaxsph.numerics.programs import light
from jaxsph.plan import Plan
from jaxsph.viewing import half_steps

Limits = tuple[Array, Array]  # tolerance and relaxation


def limits_of(settings: Settings, dtype: Any) -> Limits | None:
    """Tolerance and relaxation in the dtype of the particles, the tolerance rounded down; None at full rate."""
    if settings.tolerance is None:
        return None
    tolerance = settings.tolerance
    if not is_traced(tolerance):
        rounded = np.asarray(tolerance, dtype)  # with NumPy, as all that JAX makes under jit is traced
        tolerance = np.nextafter(rounded, np.zeros_like(rounded)) if float(rounded) > float(tolerance) else rounded
    return jnp.asarray(tolerance, dtype), jnp.asarray(settings.relax, dtype)


class GridParts(NamedTuple):
    """What a `Grid` holds besides the particles, which are the same for all bands; and how much that is.

    Attributes:
        filled, pairs: slabs that a particle can touch, and (particle, bundle) pairs.
    """

    lists: BundleLists
    cells: Cells
    row: Int[Array, " bundles"]
    column: Int[Array, " bundles"]
    half_steps: Float[Array, " two_samples_and_one"]
    filled: Int[Array, ""]
    pairs: Int[Array, ""]

    def of(self, ordered: Ordered) -> Grid:
        """The grid of those particles."""
        return Grid(ordered, self.lists, self.cells, self.row, self.column, self.half_steps)


@dataclasses.dataclass(frozen=True)
class Decided:
    """What is to be marched, what would be at full rate, how wrong each bundle's pixels can be, what each cell was given."""

    work: Worklist
    full: Float[Array, " bundles"]
    bound: Float[Array, " bundles"]
    levels: Int[Array, "cells bundles"] | None

    @property
    def layers(self) -> tuple[Array, ...]:
        """What the image shows of it: error bound, evaluations at full rate, and levels if there are any."""
        return (self.bound, self.full) if self.levels is None else (self.bound, self.full, self.levels)


jax.tree_util.register_dataclass(Decided, data_fields=["work", "full", "bound", "levels"], meta_fields=[])


@light
@functools.partial(jax.jit, static_argnames="plan")
def order(viewed: Viewed, camera: Camera, *, plan: Plan) -> Ordered:
    """The particles that can be seen, by rank."""
    depths = half_steps(camera, viewed.x.dtype, plan.samples)[1::2]
    return rank_particles(viewed, camera, depths, plan.cast.slab_samples)


@functools.partial(jax.jit, static_argnames="plan")
def make_grid(ordered: Ordered, camera: Camera, first_row: Int[Array, ""], *, plan: Plan) -> GridParts:
    """The grid of the band that begins at a row of pixels."""
    depths = half_steps(camera, ordered.x.dtype, plan.samples)
    ordered, camera = jax.tree.map(lax.stop_gradient, (ordered, camera))
    lists = build_lists(ordered, camera, plan.lists, first_row)
    cells = find_cells(ordered, lists)
    return GridParts(lists, cells, *bundle_origins(plan.lists, first_row), depths, (cells.count > 0).sum(), lists.end[-1])


@functools.partial(jax.jit, static_argnames=("parts", "plan", "kernel"))
def sum_part(
    grid: Grid, camera: Camera, transfer: TransferFunction, nth: Int[Array, ""], *, parts: int, plan: Plan, kernel: str
) -> Lattice:
    """The lattice of the `nth` of `parts` of a band, for the pilot estimator."""
    assert isinstance(plan.control, PilotPlan)
    nodes = plan.control.nodes
    grid, camera, transfer = jax.tree.map(lax.stop_gradient, (grid, camera, transfer))
    slab_samples, room = plan.cast.slab_samples, plan.control.room or plan.lists.bundles
    wanted = worth_a_lattice(grid, camera, slab_samples, nodes)
    amid = jnp.clip(grid.ordered.quantity[jnp.argmax(grid.ordered.live)], transfer.values[0], transfer.values[-1])
    amid = amid.astype(grid.half_steps.dtype)
    region = region_of(grid, *room, nodes)
    return sum_at_nodes(part_of(grid, nth, parts), camera, kernel, slab_samples, region, amid, wanted)


add_lattices = light(jax.jit(added))


@light
@functools.partial(jax.jit, static_argnames=("parts", "plan"))
def look_part(grid: Grid, transfer: TransferFunction, limits: Limits, nth: Int[Array, ""], *, parts: int, plan: Plan) -> Probe:
    """What may be worth bounding, in the `nth` of `parts` of a band."""
    grid, transfer, limits = jax.tree.map(lax.stop_gradient, (grid, transfer, limits))
    transfer = jax.tree.map(lambda leaf: leaf.astype(grid.half_steps.dtype), transfer)
    assert isinstance(plan.control, ControlPlan)
    tolerance, relax = limits
    return look(part_of(grid, nth, parts), transfer, tolerance, relax, plan.cast.slab_samples, plan.control)


@light
@jax.jit
def wanted_cells(probes: tuple[Probe, ...]) -> tuple[Bool[Array, ""], tuple[Bool[Array, "cells bundles"], ...]]:
    """Whether any cell is to be analysed; and which, of each part."""
    pays = worthwhile([(probe.held, probe.all_held) for probe in probes])
    return pays & jnp.stack([probe.promising.any() for probe in probes]).any(), tuple(probe.promising & pays for probe in probes)


@light
@functools.partial(jax.jit, static_argnames=("parts", "plan", "with_levels"))
def decide_full_rate(
    grid: Grid, transfer: TransferFunction, nth: Int[Array, ""], *, parts: int, plan: Plan, with_levels: bool
) -> Decided:
    """Every cell of the `nth` of `parts` of a band at full rate: without error control, or where none of it would pay."""
    grid, transfer = jax.tree.map(lax.stop_gradient, (part_of(grid, nth, parts), transfer))
    work, full = _at_full_rate(grid, transfer, plan)
    levels = untouched(grid.cells, plan.cast.slab_samples) if with_levels else None
    return Decided(work, full, jnp.zeros(full.shape, grid.half_steps.dtype), levels)


@light
@functools.partial(jax.jit, static_argnames="plan")
def decide_by_pilot(
    grid: Grid, camera: Camera, transfer: TransferFunction, limits: Limits, lattice: Lattice, *, plan: Plan
) -> Decided:
    """How each slab of a band is sampled, by what the lattice tells. Decisions carry no gradient."""
    grid, camera, transfer, limits = jax.tree.map(lax.stop_gradient, (grid, camera, transfer, limits))
    dtype, slab_samples = grid.half_steps.dtype, plan.cast.slab_samples
    work, full = _at_full_rate(grid, transfer, plan)
    transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), transfer)
    found = residuals(grid, lattice, camera, transfer, slab_samples)
    work, bound = pilot(grid, lattice, found, camera, work.origin, limits[0], slab_samples)
    return Decided(work, full, bound, None)


@functools.partial(jax.jit, static_argnames=("parts", "plan"))
def decide_by_bounds(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    limits: Limits,
    wanted: Bool[Array, "cells bundles"],
    nth: Int[Array, ""],
    *,
    parts: int,
    plan: Plan,
) -> Decided:
    """How each cell of the `nth` of `parts` of a band is sampled, if it is `wanted`. Decisions carry no gradient."""
    assert isinstance(plan.control, ControlPlan)
    grid, camera, transfer, limits = jax.tree.map(lax.stop_gradient, (grid, camera, transfer, limits))
    dtype, grid = grid.half_steps.dtype, part_of(grid, nth, parts)
    work, full = _at_full_rate(grid, transfer, plan)
    transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), transfer)
    chosen = adapt(grid, camera, transfer, work.origin, wanted, *limits, plan.cast.slab_samples, plan.control)
    return Decided(chosen[0], full, *chosen[1:])


def _at_full_rate(grid: Grid, transfer: TransferFunction, plan: Plan) -> tuple[Worklist, Float[Array, " bundles"]]:
    """The work of the reference image, and its evaluations."""
    origin = origins(grid.cells, grid.lists.rank, grid.ordered.quantity)
    # an origin far beyond what is shown would cost the digits of what is
    work = full_rate(grid.cells, jnp.clip(origin, transfer.values[0], transfer.values[-1]))
    return work, evaluations(work, plan.samples, plan.cast)


@functools.partial(jax.jit, static_argnames=("parts", "plan", "kernel"))
def cast_part(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    work: Worklist,
    lattice: Lattice | None,
    nth: Int[Array, ""],
    *,
    parts: int,
    plan: Plan,
    kernel: str,
) -> Rays:
    """What the rays of the `nth` of `parts` of a band meet. The grid is of the whole band, and so is the work with a lattice."""
    transfer = jax.tree.map(lambda leaf: leaf.astype(grid.half_steps.dtype), transfer)
    if lattice is not None:
        work, spent = dealt((work, lattice.evaluations), nth, parts)
        lattice = dataclasses.replace(lattice, evaluations=spent)
    return cast(part_of(grid, nth, parts), work, camera, transfer, kernel, plan_of_part(plan.cast, parts), lattice)
