"""The stages of a frame, each a program of its own: what `render` calls, eagerly one by one or under one trace.

Flow: rescale -> order -> grid_parts -> (sum_part or look_part) -> decide_part -> cast_part -> layers.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int

from jaxsph.access.cells import Cells, find_cells
from jaxsph.access.grid import Grid
from jaxsph.access.lattice import Lattice, added, region_of
from jaxsph.access.lists import BundleLists, build_lists, bundle_origins
from jaxsph.access.ordering import Ordered, order_particles
from jaxsph.access.parts import dealt, part_of
from jaxsph.access.quantities import rescaled, too_small
from jaxsph.access.resolution import too_fine
from jaxsph.cast.adjoint import cast
from jaxsph.cast.nodes import sum_at_nodes
from jaxsph.cast.parts import plan_of_part
from jaxsph.cast.points import Rays, evaluations
from jaxsph.control.adapt import ControlPlan, adapt, look
from jaxsph.control.pilot import PilotPlan, pilot, worth_a_lattice
from jaxsph.control.probe import Probe, worthwhile
from jaxsph.control.residuals import residuals
from jaxsph.control.worklist import Worklist, full_rate, origins
from jaxsph.model.camera import Camera
from jaxsph.model.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer import TransferFunction
from jaxsph.numerics import faults
from jaxsph.numerics.checks import is_traced
from jaxsph.plan import Plan


def limits_of(settings: Settings, like: Ordered) -> tuple[Array, Array] | None:
    """Tolerance and relaxation in the dtype of the particles, the tolerance rounded down; None at full rate."""
    if settings.tolerance is None:
        return None
    dtype, tolerance = like.x.dtype, settings.tolerance
    if not is_traced(tolerance):
        rounded = np.asarray(tolerance, dtype)  # with NumPy, as all that JAX makes under jit is traced
        tolerance = np.nextafter(rounded, np.zeros_like(rounded)) if float(rounded) > float(tolerance) else rounded
    tolerance = jnp.asarray(tolerance, dtype)
    return tolerance, jnp.asarray(settings.relax, dtype)


@dataclasses.dataclass(frozen=True)
class Decided:
    """What is to be marched, what would be at full rate, how wrong each bundle's pixels can be, what each cell was given."""

    work: Worklist
    full: Array
    bound: Array
    levels: Array | None

    @property
    def layers(self) -> tuple[Array, ...]:
        """What the image shows of it: error bound, evaluations at full rate, and levels if there are any."""
        return (self.bound, self.full) if self.levels is None else (self.bound, self.full, self.levels)


jax.tree_util.register_dataclass(Decided, data_fields=["work", "full", "bound", "levels"], meta_fields=[])


@jax.jit
def rescale(scene: Scene, camera: Camera) -> tuple[Array, TransferFunction]:
    """Quantities and transfer function in the units that all later stages see, in the dtype of view space."""
    dtype = jnp.promote_types(scene.particles.dtype, camera.dtype)
    transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), scene.transfer)
    return rescaled(scene.particles.quantity.astype(dtype), transfer)


def in_own_units(scene: Scene, quantity: Array, transfer: TransferFunction) -> tuple[Particles, TransferFunction]:
    """Particles and transfer function, with what `rescale` found."""
    return dataclasses.replace(scene.particles, quantity=quantity), transfer


@functools.partial(jax.jit, static_argnames="plan")
def order(particles: Particles, camera: Camera, *, plan: Plan) -> Ordered:
    """The particles that can be seen, by rank."""
    depths = _half_steps(camera, particles, plan)[1::2]
    return order_particles(particles, camera, depths, plan.cast.slab_samples, plan.num_classes)


@functools.partial(jax.jit, static_argnames="plan")
def grid_parts(
    ordered: Ordered, camera: Camera, first_row: Int[Array, ""], *, plan: Plan
) -> tuple[BundleLists, Cells, Array, Array, Array]:
    """What a `Grid` holds besides the particles, which are the same for all bands."""
    half_steps = _half_steps(camera, ordered.x, plan)
    ordered, camera, depths = jax.tree.map(lax.stop_gradient, (ordered, camera, half_steps[1::2]))
    lists = build_lists(ordered, camera, depths, plan.lists, first_row)
    return lists, find_cells(ordered, lists), *bundle_origins(plan.lists, first_row), half_steps


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


@functools.partial(jax.jit, static_argnames=("parts", "plan"))
def look_part(
    grid: Grid, transfer: TransferFunction, limits: tuple[Array, Array], nth: Int[Array, ""], *, parts: int, plan: Plan
) -> Probe:
    """What may be worth bounding, in the `nth` of `parts` of a band."""
    grid, transfer, limits = jax.tree.map(lax.stop_gradient, (grid, transfer, limits))
    transfer = jax.tree.map(lambda leaf: leaf.astype(grid.half_steps.dtype), transfer)
    assert isinstance(plan.control, ControlPlan)
    tolerance, relax = limits
    return look(part_of(grid, nth, parts), transfer, tolerance, relax, plan.cast.slab_samples, plan.control)


add_lattices = jax.jit(added)


@functools.partial(jax.jit, static_argnames=("parts", "plan"))
def decide_part(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    limits: tuple[Array, Array] | None,
    seen: Any,
    nth: Int[Array, ""],
    *,
    parts: int,
    plan: Plan,
) -> Decided:
    """How each cell is sampled, in the `nth` of `parts` of a band. Decisions carry no gradient.

    Args:
        seen: what the decision rests on. Nothing at full rate; of the pilot, the lattice, and there is only one part; else the
            cells of this part that are promising, and the shares of work that they hold in all parts.
    """
    grid, camera, transfer, limits = jax.tree.map(lax.stop_gradient, (grid, camera, transfer, limits))
    dtype, grid = grid.half_steps.dtype, part_of(grid, nth, parts)
    origin = origins(grid.cells, grid.lists.rank, grid.ordered.quantity)
    # an origin far beyond what is shown would cost the digits of what is
    origin = jnp.clip(origin, transfer.values[0], transfer.values[-1])
    work = full_rate(grid.cells, origin)
    full = evaluations(work, plan.samples, plan.cast)
    if limits is None or plan.control is None:
        return Decided(work, full, jnp.zeros(full.shape, dtype), None)
    transfer = jax.tree.map(lambda leaf: leaf.astype(dtype), transfer)
    tolerance, relax = limits
    if isinstance(plan.control, PilotPlan):
        lattice, found = seen, residuals(grid, seen, camera, transfer, plan.cast.slab_samples)
        work, bound = pilot(grid, lattice, found, camera, origin, tolerance, plan.cast.slab_samples)
        return Decided(work, full, bound, None)
    promising, shares = seen
    wanted = promising & worthwhile(shares)
    work, bound, levels = adapt(grid, camera, transfer, origin, wanted, tolerance, relax, plan.cast.slab_samples, plan.control)
    return Decided(work, full, bound, levels)


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


def _half_steps(camera: Camera, like: Any, plan: Plan) -> Array:
    """View depths s(0), s(1/2), ... s(N): fine samples sit at the odd entries, between borders at the even ones."""
    u = jnp.arange(2 * plan.samples + 1, dtype=like.dtype) / 2
    return camera.depth(u, plan.samples).astype(like.dtype)


@functools.partial(jax.jit, static_argnames="samples")
def input_faults(scene: Scene, camera: Camera, samples: int) -> Int[Array, ""]:
    """Fault bits of camera and transfer function, whose numbers may have been changed under jit."""
    numbers = jnp.concatenate([camera.eye, camera.axes.ravel(), jnp.stack([camera.half_height, camera.near, camera.far])])
    usable = jnp.isfinite(numbers).all() & (camera.half_height > 0) & (camera.near < camera.far)
    if camera.is_perspective:
        usable &= camera.near > 0
    transfer = scene.transfer
    shown = (transfer.values[1:] >= transfer.values[:-1]).all() & jnp.isfinite(transfer.values).all()
    shown &= ((transfer.colors >= 0) & (transfer.colors <= 1)).all()
    shown &= ((transfer.extinction >= 0) & jnp.isfinite(transfer.extinction)).all() & ~too_small(transfer.values)
    unresolved = faults.raised(faults.UNRESOLVED, usable & too_fine(camera, samples))
    return unresolved | faults.raised(faults.BAD_CAMERA, ~usable) | faults.raised(faults.BAD_TRANSFER, ~shown)
