"""The stages of a frame, each a program of its own: what `frame` runs one by one, or under one trace.

Flow: viewing -> order -> make_lists -> find_windows -> (sum_shard) -> decide_... -> cast_shard -> layers.
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

from jaxsph.engine.access.grid import (
    Grid,
    SlabWindows,
    find_slab_windows,
    shard,
    shard_of_grid,
    slab_extents,
    unshard,
    whole_cells,
)
from jaxsph.engine.access.host_lists import build_lists_on_host, depth_order, find_sides, find_touched, list_shapes, pair_shapes
from jaxsph.engine.access.lists import BUNDLE, BundleLists, ListPlan, build_lists, bundle_origins
from jaxsph.engine.access.view import Ordered, Spheres, Viewed, rank_particles
from jaxsph.engine.cast.adjoint import CastMethod, cast
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.control import ControlPlan, PilotPlan
from jaxsph.engine.control.adapt import adapt, probe
from jaxsph.engine.control.bounds import tables_of_parts
from jaxsph.engine.control.interpolation_error import interpolation_error
from jaxsph.engine.control.pilot import pilot, worth_a_lattice
from jaxsph.engine.field.lattice import Lattice, region_of, sum_at_nodes
from jaxsph.engine.field.schedule import SlabSchedule, clipped, evaluations, full_rate, reference_quantities
from jaxsph.engine.media.shown import RayLimits, Shown
from jaxsph.engine.media.within import over_slabs
from jaxsph.engine.planning.viewing import half_steps, sphere_depths
from jaxsph.engine.runtime.executors import Eager, Run
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning, cores_at_hand
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips.clips import Clip, Overlap
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.checks import array_of, is_traced

ENDED_SHARE = 0.2  # of a tolerance that segments are refined for, what rays may let through where they end


class Limits(NamedTuple):
    """What an error is held against: tolerance and relaxation."""

    tolerance: Float[Array, ""]
    relax: Float[Array, ""]


def limits_of(settings: Settings, dtype: Any) -> Limits | None:
    """Tolerance and relaxation in the dtype of the particles, the tolerance rounded down; None at full rate."""
    if settings.tolerance is None:
        return None
    tolerance = settings.tolerance
    if ends(settings):  # which take a part of it
        tolerance = tolerance - least_transmittance(settings)
    if not is_traced(tolerance) and not isinstance(tolerance, jax.Array):
        rounded = np.asarray(tolerance, dtype)  # with NumPy, as all that JAX makes under jit is traced
        tolerance = np.nextafter(rounded, np.zeros_like(rounded)) if float(rounded) > float(tolerance) else rounded
    return Limits(array_of(tolerance, dtype), array_of(settings.relax, dtype))


def ends(settings: Settings) -> bool:
    """Whether rays may end before their ends."""
    least = settings.min_transmittance
    return settings.is_refined or is_traced(least) or float(least) > 0


def least_transmittance(settings: Settings) -> Any:
    """Below which rays end: what is asked for, and a share of the tolerance where segments are refined for it."""
    least = settings.min_transmittance
    return jnp.maximum(least, ENDED_SHARE * settings.tolerance) if settings.is_refined else least


class BandGrid(NamedTuple):
    """What a `Grid` holds besides the particles, which are the same for all bands; and how much that is.

    Attributes:
        filled, pairs: slabs that a particle can touch, and (particle, bundle) pairs.
    """

    lists: BundleLists
    windows: SlabWindows
    row: Int[Array, " bundles"]
    column: Int[Array, " bundles"]
    half_steps: Float[Array, " two_samples_and_one"]
    filled: Int[Array, ""]
    pairs: Int[Array, ""]

    def of(self, ordered: Ordered) -> Grid:
        """The grid of those particles."""
        return Grid(ordered, self.lists, self.windows, self.row, self.column, self.half_steps)

    @property
    def counts(self) -> tuple[Any, Any, Any]:
        """Fault word of the lists, and how much is in them, see `layers.Drawn`."""
        return self.lists.faults, self.filled, self.pairs


class Decided(NamedTuple):
    """What is to be marched, and what the image tells of it.

    Attributes:
        schedule: of the slabs of bundles.
        bound: how wrong each bundle's pixels can be.
        full: evaluations at full rate.
        levels: what each cell was given; None where there are no levels.
        painted: what of the bound is by super-pixels; None where there is none of these.
    """

    schedule: SlabSchedule
    bound: Float[Array, " bundles"]
    full: Float[Array, " bundles"]
    levels: Int[Array, "cells bundles"] | None = None
    painted: Float[Array, " bundles"] | None = None


@stage("samples", "slab_samples", "between_samples", quickly=True)
def order(
    viewed: Viewed,
    camera: Camera,
    found: Int[Array, " particles"] | None = None,
    *,
    samples: int,
    slab_samples: int,
    between_samples: bool,
    tuning: Tuning,
) -> Ordered:
    """The particles that can be seen, by rank; `found` is the order of their keys, where the host has found it."""
    depths = sphere_depths(camera, viewed.x.dtype, samples, between_samples)
    return rank_particles(viewed, camera, depths, slab_samples, found)


@stage("lists")
def make_lists(spheres: Spheres, camera: Camera, first_row: Int[Array, ""], *, lists: ListPlan, tuning: Tuning) -> BundleLists:
    """The lists of all bundles of the band that begins at a row of pixels."""
    spheres, camera = jax.tree.map(lax.stop_gradient, (spheres, camera))
    return build_lists(spheres, camera, lists, first_row)


@stage("lists", "samples", "beside", quickly=True)
def find_windows(
    ordered: Ordered,
    made: BundleLists,
    camera: Camera,
    first_row: Int[Array, ""],
    *,
    lists: ListPlan,
    samples: int,
    beside: bool,
    tuning: Tuning,
) -> BandGrid:
    """All but the lists of the grid of the band that begins at a row of pixels, of spheres that lie `beside` samples, too.

    What a program returns it would copy.
    """
    depths = half_steps(camera, ordered.x.dtype, samples)
    windows = find_slab_windows(jax.tree.map(lax.stop_gradient, ordered), made, beside)
    pairs = (made.end - made.start).sum(dtype=jnp.int32)
    places = bundle_origins(lists, first_row)
    return BandGrid(None, windows, *places, depths, (windows.count > 0).sum(), pairs)  # type: ignore[arg-type]


def ordered_of(run: Run, viewed: Viewed, camera: Camera, tuning: Tuning, found: Array | None = None, **sizes: Any) -> Ordered:
    """The particles by rank, sorted by the host where that pays; `found` and `sizes` as of `order`."""
    if found is None and run.on_host(tuning):
        assert isinstance(run, Eager)
        shape = jax.ShapeDtypeStruct(viewed.key.shape, jnp.int32)
        found = run.by_host("grid", lambda: depth_order(viewed, cores_at_hand()), shape)
    return run.one("grid", order, (viewed, camera, found), tuning=tuning, **sizes)  # type: ignore[no-any-return]


def lists_of(
    run: Run, spheres: Spheres, camera: Camera, first_row: Int[Array, ""], lists: ListPlan, tuning: Tuning
) -> BundleLists:
    """The lists of a band, by the host where that pays."""
    if not run.on_host(tuning):
        return run.one("grid", make_lists, (spheres, camera, first_row), lists=lists, tuning=tuning)  # type: ignore[no-any-return]
    assert isinstance(run, Eager)
    sides = run.one("grid", find_sides, (spheres, camera, first_row), lists=lists)
    view = (sides.spheres, sides.bundles, camera, first_row)
    touched = run.program("grid", find_touched, (*view, pair_shapes(lists)))
    test, threads = (lambda pairs: touched(*view, pairs)), cores_at_hand()
    return run.by_host("grid", lambda: build_lists_on_host(sides, test, lists, threads), list_shapes(lists))  # type: ignore[no-any-return]


def grid_of(
    run: Run, ordered: Ordered, camera: Camera, first_row: Int[Array, ""], lists: ListPlan, tuning: Tuning, **sizes: Any
) -> BandGrid:
    """The grid of the band that begins at a row of pixels; `sizes` as of `find_windows`."""
    made = lists_of(run, ordered, camera, first_row, lists, tuning)
    static = {"lists": lists, "tuning": tuning, **sizes}
    return run.one("grid", find_windows, (ordered, made, camera, first_row), **static)._replace(lists=made)  # type: ignore[no-any-return]


@stage("shards", "lists", "cast", "control", "kernel")
def sum_shard(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    nth: Int[Array, ""],
    *,
    shards: int,
    lists: ListPlan,
    cast: CastPlan,
    control: PilotPlan,
    kernel: str,
    tuning: Tuning,
) -> Lattice:
    """The lattice of the `nth` of `shards` of a band, for the pilot estimator."""
    grid, camera, transfer = jax.tree.map(lax.stop_gradient, (grid, camera, transfer))
    slab_samples, room = cast.slab_samples, control.room or lists.bundles
    wanted = worth_a_lattice(grid, camera, slab_samples, control.nodes)
    seen = jnp.argmax(grid.ordered.live)
    references = _among(transfer, [quantity[seen] for quantity in grid.ordered.quantities], grid.half_steps.dtype)
    region = region_of(grid, *room, control.nodes)
    of_shard = shard_of_grid(grid, nth, shards)
    return sum_at_nodes(of_shard, camera, kernel, slab_samples, region, references, tuning.cells_of_nodes, wanted)


@stage(quickly=True)
def add_lattices(lattices: tuple[Lattice, ...], *, tuning: Tuning) -> Lattice:
    """That of a band, of those of its shards: the nodes of other shards' bundles are zero."""
    weight, weighted = jax.tree.map(lambda *values: sum(values[1:], values[0]), *((one.weight, one.weighted) for one in lattices))
    evaluations = unshard(tuple(one.evaluations for one in lattices))
    return dataclasses.replace(lattices[0], weight=weight, weighted=weighted, evaluations=evaluations)


@stage("shards", "cast", quickly=True)
def decide_full_rate(
    grid: Grid,
    shown: Shown,
    nth: Int[Array, ""],
    *,
    shards: int,
    cast: CastPlan,
    tuning: Tuning,
) -> Decided:
    """Every cell of the `nth` of `shards` of a band at full rate."""
    grid, shown = jax.tree.map(lax.stop_gradient, (shard_of_grid(grid, nth, shards), shown))
    camera, transfer, media, within = shown
    schedule, full = _at_full_rate(grid, transfer, cast, _overlap(grid, camera, within, cast))
    extents = slab_extents(grid, camera, cast.slab_samples) if media else None
    filled = functools.reduce(jnp.logical_or, (medium.occupied(extents) for medium in media), schedule.filled)
    nothing = jnp.zeros(full.shape, grid.half_steps.dtype)
    return Decided(dataclasses.replace(schedule, filled=filled), nothing, full)


@stage("cast", quickly=True)
def decide_by_pilot(
    grid: Grid,
    shown: Shown,
    limits: Limits,
    lattice: Lattice,
    *,
    cast: CastPlan,
    tuning: Tuning,
) -> Decided:
    """How each slab of a band is sampled, by what the lattice tells. Decisions carry no gradient.

    Slabs that a face of a clip may cross are at full rate.
    """
    grid, shown, limits = jax.tree.map(lax.stop_gradient, (grid, shown, limits))
    lies = _overlap(grid, shown.camera, shown.within, cast)
    schedule, full = _at_full_rate(grid, shown.transfer, cast, lies)
    camera, transfer, *_ = shown.of_type(grid.half_steps.dtype)
    assert transfer is not None  # error control is of particles
    found = interpolation_error(grid, lattice, camera, transfer, cast.slab_samples)
    able = None if lies is None else lies.holds
    schedule, bound = pilot(grid, lattice, found, camera, schedule.references, limits.tolerance, cast.slab_samples, able)
    return Decided(clipped(schedule, None if lies is None else lies.meets), bound, full)


@stage("shards", "cast", "control")
def decide_by_bounds(
    grid: Grid,
    shown: Shown,
    limits: Limits,
    nth: Int[Array, ""],
    *,
    shards: int,
    cast: CastPlan,
    control: ControlPlan,
    tuning: Tuning,
) -> Decided:
    """How each cell of the `nth` of `shards` of a band is sampled. Decisions carry no gradient.

    Cells that a face of a clip may cross are at full rate, so that all others are as if there were no clip, or not there.
    """
    grid, shown, limits = jax.tree.map(lax.stop_gradient, (grid, shown, limits))
    camera, transfer, *_ = shown.of_type(grid.half_steps.dtype)
    assert transfer is not None  # error control is of particles
    promising = probe(grid, tables_of_parts(transfer), limits.tolerance, cast.slab_samples, tuning.cells_probed)
    wanted, grid = shard(promising, nth, shards), shard_of_grid(grid, nth, shards)
    lies = _overlap(grid, shown.camera, shown.within, cast)
    schedule, full = _at_full_rate(grid, shown.transfer, cast, lies)
    wanted = wanted if lies is None else wanted & whole_cells(lies.holds, cast.slab_samples)
    references = schedule.references
    decided = adapt(grid, camera, transfer, references, wanted, *limits, cast.slab_samples, control, tuning)
    schedule, bound, painted, levels = decided
    return Decided(clipped(schedule, None if lies is None else lies.meets), bound, full, levels, painted)


def _overlap(grid: Grid, camera: Camera, within: Clip | None, cast: CastPlan) -> Overlap | None:
    """How a clip lies to the slabs of a band or of a shard of it; None without one."""
    return None if within is None else over_slabs(within, slab_extents(grid, camera, cast.slab_samples))


def _at_full_rate(
    grid: Grid, transfer: TransferFunction | None, cast: CastPlan, lies: Overlap | None = None
) -> tuple[SlabSchedule, Float[Array, " bundles"]]:
    """The schedule of the reference image, and its evaluations."""
    references = [reference_quantities(grid.windows, grid.lists.rank, one) for one in grid.ordered.quantities]
    schedule = clipped(full_rate(grid.windows, _among(transfer, references)), None if lies is None else lies.meets)
    return schedule, evaluations(schedule, grid.samples, cast.slab_samples)


def _among(transfer: TransferFunction | None, references: list[Array], dtype: Any = None) -> tuple[Array, ...]:
    """References among the control points: one far beyond what is shown would cost the digits of what is."""
    if transfer is not None:
        parts = zip(references, transfer.parts(), strict=True)
        references = [jnp.clip(reference, part.values[0], part.values[-1]) for reference, part in parts]
    return tuple(reference if dtype is None else reference.astype(dtype) for reference in references)


class Cast(NamedTuple):
    """What the rays of a shard have met, see `march.RayResult`, a bundle after the other.

    Attributes:
        evaluations: of kernels, a pixel.
        cut: whose rays ended before their ends.
        normal: of what ends rays.
    """

    color: Float[Array, "bundles rows columns 3"]
    transmittance: Float[Array, "bundles rows columns"]
    depth: Float[Array, "bundles rows columns"]
    evaluations: Float[Array, " bundles"]
    error: Float[Array, "bundles rows columns"] | None
    cut: Bool[Array, " bundles"] | None
    normal: Float[Array, "bundles rows columns 3"] | None


@stage("shards", "method")
def cast_shard(
    grid: Grid,
    shown: Shown,
    schedule: SlabSchedule,
    lattice: Lattice | None,
    limits: RayLimits,
    nth: Int[Array, ""],
    *,
    shards: int,
    method: CastMethod,
    tuning: Tuning,
) -> Cast:
    """The `nth` of `shards` of a band. The grid is of the whole band, and so is the schedule with a lattice."""
    shown = shown.of_type(grid.half_steps.dtype)
    of_nodes = None if lattice is None else lattice.evaluations
    if lattice is not None:
        schedule, of_nodes = shard((schedule, of_nodes), nth, shards)
    method = dataclasses.replace(method, plan=method.plan.of_shard(shards))
    grid = shard_of_grid(grid, nth, shards)
    rays = cast(grid, schedule, shown, method, lattice=lattice, limits=limits)
    packets = method.packets_of(grid, shown.camera)
    spent = evaluations(schedule, grid.samples, method.plan.slab_samples)
    spent = packets.per_pixel(spent, BUNDLE * BUNDLE)
    if rays.refined is not None:
        spent = spent + packets.sum_per_pixel(rays.refined, spent.shape[0], BUNDLE * BUNDLE)
    if rays.left_out is not None:
        spent = spent - packets.sum_per_pixel(rays.left_out, spent.shape[0], BUNDLE * BUNDLE)
    cut = None if rays.cut is None else packets.sum_per_pixel(rays.cut, spent.shape[0], BUNDLE * BUNDLE) > 0
    spent = spent if of_nodes is None else spent + of_nodes
    normal = None if rays.stop is None else jnp.moveaxis(rays.stop[1:], 0, -1)
    return Cast(jnp.moveaxis(rays.color, 0, -1), rays.transmittance, rays.depth, spent, rays.error, cut, normal)
