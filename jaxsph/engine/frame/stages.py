"""The stages of a frame, each a program of its own: what `frame` runs one by one, or under one trace.

Flow: viewing -> order -> make_lists -> find_windows -> (sum_shard) -> decide_... -> cast_shard -> develop -> join -> Image.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid, find_slab_windows, shard, shard_of_grid, unshard
from jaxsph.engine.access.host_lists import build_lists_on_host, depth_order, find_sides, find_touched, list_shapes, pair_shapes
from jaxsph.engine.access.lists import BUNDLE, BundleLists, ListPlan, build_lists, bundle_origins
from jaxsph.engine.access.view import Ordered, Spheres, Viewed, rank_particles
from jaxsph.engine.cast.march import CastMethod, cast
from jaxsph.engine.control.decide import Decided, Limits
from jaxsph.engine.field.lattice import Lattice
from jaxsph.engine.field.tasks import SlabSchedule, evaluations
from jaxsph.engine.media.shown import RayLimits, Shown
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.planning.viewing import half_steps, sphere_depths
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning, cores_at_hand
from jaxsph.model.camera.camera import Camera
from jaxsph.model.settings import Settings
from jaxsph.numerics.checks import array_of, is_traced

ENDED_SHARE = 0.2  # of a tolerance that segments are refined for, what rays may let through where they end
Counts = tuple[Any, Any, Any]  # the fault word of lists; slabs that a particle can touch, and pairs with bundles
REFERENCE = "samples"
"""The integrator whose image at full rate is what errors are bounded against: of others none is known without an estimate."""


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
) -> tuple[Any, ...]:
    """What follows the lists in the `Grid` of the band that begins at a row of pixels, of spheres that lie `beside` samples, too.

    And how many slabs a particle can touch, and (particle, bundle) pairs there are.
    """
    depths = half_steps(camera, ordered.x.dtype, samples)
    windows = find_slab_windows(jax.tree.map(lax.stop_gradient, ordered), made, beside)
    pairs = (made.end - made.start).sum(dtype=jnp.int32)
    places = bundle_origins(lists, first_row)
    return windows, *places, depths, (windows.count > 0).sum(), pairs


def ordered_of(clock: Clock, viewed: Viewed, camera: Camera, tuning: Tuning, found: Array | None = None, **sizes: Any) -> Ordered:
    """The particles by rank, sorted by the host where that pays; `found` and `sizes` as of `order`."""
    if found is None and not clock.traced and tuning.sorts_on_host:  # a trace holds no values for the host
        shape = jax.ShapeDtypeStruct(viewed.key.shape, jnp.int32)
        found = clock.on_host("grid", lambda: depth_order(viewed, cores_at_hand()), shape)
    return clock.one("grid", order, (viewed, camera, found), tuning=tuning, **sizes)  # type: ignore[no-any-return]


def lists_of(
    clock: Clock, spheres: Spheres, camera: Camera, first_row: Int[Array, ""], lists: ListPlan, tuning: Tuning
) -> BundleLists:
    """The lists of a band, by the host where that pays."""
    if clock.traced or not tuning.sorts_on_host:
        return clock.one("grid", make_lists, (spheres, camera, first_row), lists=lists, tuning=tuning)  # type: ignore[no-any-return]
    sides = clock.one("grid", find_sides, (spheres, camera, first_row), lists=lists)
    view = (sides.spheres, sides.bundles, camera, first_row)
    touched = clock.program("grid", find_touched, (*view, pair_shapes(lists)))
    test, threads = (lambda pairs: touched(*view, pairs)), cores_at_hand()
    return clock.on_host("grid", lambda: build_lists_on_host(sides, test, lists, threads), list_shapes(lists))  # type: ignore[no-any-return]


def grid_of(
    clock: Clock, ordered: Ordered, camera: Camera, first_row: Int[Array, ""], lists: ListPlan, tuning: Tuning, **sizes: Any
) -> tuple[Grid, Counts]:
    """The grid of the band that begins at a row of pixels, and how much is in it; `sizes` as of `find_windows`."""
    made = lists_of(clock, ordered, camera, first_row, lists, tuning)
    static = {"lists": lists, "tuning": tuning, **sizes}
    *places, filled, pairs = clock.one("grid", find_windows, (ordered, made, camera, first_row), **static)
    return Grid(ordered, made, *places), (made.faults, filled, pairs)


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
    chosen: Any = None,
    *,
    shards: int,
    method: CastMethod,
    tuning: Tuning,
) -> Cast:
    """The `nth` of `shards` of a band, or what packets are `chosen` of it (see `CastMethod.packets_of`).

    The grid is of the whole band, and so is the schedule with a lattice.
    """
    shown = shown.of_type(grid.half_steps.dtype)
    of_nodes = None if lattice is None else lattice.evaluations
    if lattice is not None:
        schedule, of_nodes = shard((schedule, of_nodes), nth, shards)
    method = dataclasses.replace(method, plan=method.plan.of_shard(shards))
    grid = shard_of_grid(grid, nth, shards)
    rays = cast(grid, schedule, shown, method, lattice=lattice, chosen=chosen, limits=limits)
    packets = method.packets_of(grid, shown.camera, chosen)
    bundles, pixels = schedule.count.shape[1], BUNDLE * BUNDLE
    spent = evaluations(packets.schedule_of(schedule), grid.samples, method.plan.slab_samples)
    spent = packets.sum_per_pixel(spent, bundles, pixels)
    if rays.refined is not None:
        spent = spent + packets.sum_per_pixel(rays.refined, bundles, pixels)
    if rays.left_out is not None:
        spent = spent - packets.sum_per_pixel(rays.left_out, bundles, pixels)
    cut = None if rays.cut is None else packets.sum_per_pixel(rays.cut, bundles, pixels) > 0
    spent = spent if of_nodes is None else spent + of_nodes
    normal = None if rays.stop is None else jnp.moveaxis(rays.stop[1:], 0, -1)
    return Cast(jnp.moveaxis(rays.color, 0, -1), rays.transmittance, rays.depth, spent, rays.error, cut, normal)


class Layers(NamedTuple):
    """Of a band, as far as it lies in the image; or of an image.

    Attributes:
        full: evaluations that full rate takes.
        levels: what error control gave each cell, if there is any that gives levels.
        rays: how many were cast, where pixels are interpolated.
        normal: of what ends rays, see `Image`; None where nothing does.
    """

    color: Float[Array, "rows columns 3"]
    transmittance: Float[Array, "rows columns"]
    depth: Float[Array, "rows columns"]
    evaluations: Float[Array, "rows columns"]
    bound: Float[Array, "rows columns"]
    full: Float[Array, "rows columns"]
    levels: Int[Array, "cells bundle_rows bundle_columns"] | None
    rays: Int[Array, ""] | None = None
    normal: Float[Array, "rows columns 3"] | None = None


class Drawn(NamedTuple):
    """Layers of a band, or of an image; the fault word of its lists; slabs that a particle can touch, and pairs with bundles."""

    layers: Layers
    faults: Any
    filled: Any
    pairs: Any

    @classmethod
    def of(cls, layers: Layers, counts: Sequence[Counts], faults: Int[Array, ""]) -> Drawn:
        """The image, of what there is of all its grids; `faults` are those of what is seen."""
        if not is_traced(faults, counts):
            faults, counts = int(faults), [(int(word), int(filled), int(pairs)) for word, filled, pairs in counts]  # type: ignore[assignment]
        words, filled, pairs = zip(*counts, strict=True)
        return cls(layers, functools.reduce(operator.or_, words, faults), sum(filled), sum(pairs))


@stage("plan", quickly=True)
def develop(cast: tuple[Cast, ...], decided: tuple[Decided, ...], *, plan: Plan) -> Layers:
    """The layers of a band, of its shards; of decisions of one where that decided for all.

    No colour or alpha is off by more than 1. What error there is where nothing was compared is unknown: inf.
    """
    rays, chosen, as_image, over_pixels = unshard(cast, 0), unshard(decided), plan.lists.as_image, plan.lists.over_pixels
    color, transmittance, depth = map(as_image, rays[:3])
    bound = over_pixels(chosen.bound)
    if rays.error is not None:
        error = as_image(rays.error)
        bound = jnp.where(error > 0, jnp.inf, bound) if plan.integrator == REFERENCE else error
    if rays.cut is not None:  # what may be left out by rays that ended is what they let through
        bound = bound + jnp.where(over_pixels(rays.cut), lax.stop_gradient(transmittance), 0)
    known = plan.integrator == REFERENCE or plan.cast.doublings > 0
    bound = jnp.where(known & (bound < jnp.inf), jnp.minimum(bound, 1), jnp.inf)
    normal = None if rays.normal is None else as_image(rays.normal)
    spent, full = over_pixels(rays.evaluations), over_pixels(chosen.full)
    layers = Layers(color, transmittance, depth, spent, bound, full, None, normal=normal)
    layers = jax.tree.map(lambda layer: layer[: plan.height, : plan.width], layers)
    if chosen.levels is None:
        return layers
    rows, columns = (-(-size // BUNDLE) for size in (plan.height, plan.width))
    levels = as_image(jnp.moveaxis(chosen.levels, 0, -1)[:, None, None])[:rows, :columns]
    return layers._replace(levels=jnp.moveaxis(levels, -1, 0))


@stage("height", quickly=True)
def join(bands: tuple[Layers, ...], *, height: int) -> Layers:
    """The image, of all of its bands, of which the last may end beyond it."""
    image: Layers = jax.tree.map(lambda *rows: jnp.concatenate(rows)[:height], *(one._replace(levels=None) for one in bands))
    if bands[0].levels is None:
        return image
    levels = jnp.concatenate([one.levels for one in bands], 1)  # type: ignore[misc]
    return image._replace(levels=levels[:, : -(-height // BUNDLE)])
