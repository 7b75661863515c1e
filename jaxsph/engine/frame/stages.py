"""The stages of a frame, each a program of its own: what `frame` runs one by one, or under one trace.

Flow: viewing -> order -> make_lists -> find_windows -> (sum_shard) -> decide_... -> cast_shard -> layers.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

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
)
from jaxsph.engine.access.host_lists import build_lists_on_host, depth_order, find_sides, find_touched, list_shapes, pair_shapes
from jaxsph.engine.access.lists import BUNDLE, BundleLists, ListPlan, build_lists, bundle_origins
from jaxsph.engine.access.view import Ordered, Spheres, Viewed, rank_particles
from jaxsph.engine.cast.adjoint import CastMethod, cast
from jaxsph.engine.control.decide import Limits
from jaxsph.engine.field.schedule import SlabSchedule, evaluations
from jaxsph.engine.media.shown import RayLimits, Shown
from jaxsph.engine.planning.viewing import half_steps, sphere_depths
from jaxsph.engine.runtime.executors import Eager, Run
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning, cores_at_hand
from jaxsph.model.camera.camera import Camera
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import array_of, is_traced

if TYPE_CHECKING:  # only the pilot estimator has one
    from jaxsph.engine.field.lattice import Lattice

ENDED_SHARE = 0.2  # of a tolerance that segments are refined for, what rays may let through where they end


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
    spent = packets.sum_per_pixel(packets.reading(spent), spent.shape[0], BUNDLE * BUNDLE)
    if rays.refined is not None:
        spent = spent + packets.sum_per_pixel(rays.refined, spent.shape[0], BUNDLE * BUNDLE)
    if rays.left_out is not None:
        spent = spent - packets.sum_per_pixel(rays.left_out, spent.shape[0], BUNDLE * BUNDLE)
    cut = None if rays.cut is None else packets.sum_per_pixel(rays.cut, spent.shape[0], BUNDLE * BUNDLE) > 0
    spent = spent if of_nodes is None else spent + of_nodes
    normal = None if rays.stop is None else jnp.moveaxis(rays.stop[1:], 0, -1)
    return Cast(jnp.moveaxis(rays.color, 0, -1), rays.transmittance, rays.depth, spent, rays.error, cut, normal)
