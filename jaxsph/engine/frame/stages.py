"""The stages of a frame, which `Frame` calls through its clock: as one program each, or all as parts of one trace.

Flow: viewing -> order -> make_lists -> find_windows -> (sum_shard) -> decide_... -> cast_shard -> develop -> join -> finish.

A function marked `@stage` is jitted, and its arguments after `*` are static. Functions that take a `clock` are no stages: they
choose which stages to call, such as those that leave sorting to the host.
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

ENDED_SHARE = 0.2  # of a tolerance that segments are refined for: what a ray may still let through where it ends
Counts = tuple[Any, Any, Any]
"""Of a grid: the fault word of its lists, how many slabs hold any particle, and how many pairs of particles and bundles."""
REFERENCE = "samples"
"""The integrator whose image at full rate has error bound 0, as errors are bounded against it; others need an estimate."""


def limits_of(settings: Settings, dtype: Any) -> Limits | None:
    """Tolerance and relaxation in the dtype of the particles, the tolerance rounded down; None without a tolerance.

    Rays that may end early take their part of the tolerance first.
    """
    if settings.tolerance is None:
        return None
    tolerance = settings.tolerance
    if rays_may_end(settings):
        tolerance = tolerance - least_transmittance(settings)
    if not is_traced(tolerance) and not isinstance(tolerance, jax.Array):
        rounded = np.asarray(tolerance, dtype)  # by NumPy, as whatever JAX computes under jit is traced
        tolerance = np.nextafter(rounded, np.zeros_like(rounded)) if float(rounded) > float(tolerance) else rounded
    return Limits(array_of(tolerance, dtype), array_of(settings.relax, dtype))


def rays_may_end(settings: Settings) -> bool:
    """Whether rays may stop being marched before they reach far, as too little light gets through them to matter."""
    least = settings.min_transmittance
    return settings.is_refined or is_traced(least) or float(least) > 0


def least_transmittance(settings: Settings) -> Any:
    """The transmittance below which rays end: the setting, or a share of the tolerance if segments are refined and it is more."""
    least = settings.min_transmittance
    return jnp.maximum(least, ENDED_SHARE * settings.tolerance) if settings.is_refined else least


@stage("samples", "slab_samples", "between_samples", quickly=True)
def order(
    viewed: Viewed,
    camera: Camera,
    host_order: Int[Array, " particles"] | None = None,
    *,
    samples: int,
    slab_samples: int,
    between_samples: bool,
    tuning: Tuning,
) -> Ordered:
    """Rank the particles that can be seen; `host_order` is the order of their keys where the host has sorted them."""
    depths = sphere_depths(camera, viewed.x.dtype, samples, between_samples)
    return rank_particles(viewed, camera, depths, slab_samples, host_order)


@stage("lists")
def make_lists(spheres: Spheres, camera: Camera, first_row: Int[Array, ""], *, lists: ListPlan, tuning: Tuning) -> BundleLists:
    """List, for every bundle of the band that begins at a row of pixels, the ranks of the particles that can touch it."""
    spheres, camera = jax.tree.map(lax.stop_gradient, (spheres, camera))
    return build_lists(spheres, camera, lists, first_row)


@stage("lists", "samples", "beside", quickly=True)
def find_windows(
    ordered: Ordered,
    bundle_lists: BundleLists,
    camera: Camera,
    first_row: Int[Array, ""],
    *,
    lists: ListPlan,
    samples: int,
    beside: bool,
    tuning: Tuning,
) -> tuple[Any, ...]:
    """Find all that a `Grid` has besides particles and lists, for the band that begins at a row of pixels.

    Args:
        beside: windows hold spheres that lie between samples, too.

    Returns:
        Windows, rows and columns of bundles, and half steps, as `Grid` has them; then how many slabs hold any particle, and how
        many pairs of particles and bundles there are.
    """
    depths = half_steps(camera, ordered.x.dtype, samples)
    windows = find_slab_windows(jax.tree.map(lax.stop_gradient, ordered), bundle_lists, beside)
    pairs = (bundle_lists.end - bundle_lists.start).sum(dtype=jnp.int32)
    places = bundle_origins(lists, first_row)
    return windows, *places, depths, (windows.count > 0).sum(), pairs


def ordered_of(
    clock: Clock, viewed: Viewed, camera: Camera, tuning: Tuning, host_order: Array | None = None, **sizes: Any
) -> Ordered:
    """Rank the particles, sorted by the host where that is faster; `host_order` and `sizes` as of `order`."""
    if host_order is None and not clock.traced and tuning.sorts_on_host:  # a trace holds no values for the host
        shape = jax.ShapeDtypeStruct(viewed.key.shape, jnp.int32)
        host_order = clock.on_host("grid", lambda: depth_order(viewed, cores_at_hand()), shape)
    return clock.one("grid", order, (viewed, camera, host_order), tuning=tuning, **sizes)  # type: ignore[no-any-return]


def lists_of(
    clock: Clock, spheres: Spheres, camera: Camera, first_row: Int[Array, ""], lists: ListPlan, tuning: Tuning
) -> BundleLists:
    """Make the lists of a band, by the host where that is faster."""
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
    """Make the grid of the band that begins at a row of pixels, and count what is in it; `sizes` as of `find_windows`."""
    bundle_lists = lists_of(clock, ordered, camera, first_row, lists, tuning)
    static = {"lists": lists, "tuning": tuning, **sizes}
    *places, filled, pairs = clock.one("grid", find_windows, (ordered, bundle_lists, camera, first_row), **static)
    return Grid(ordered, bundle_lists, *places), (bundle_lists.faults, filled, pairs)


class ShardResult(NamedTuple):
    """What `march.RayResult` has of the packets of a shard, with axes as an image has them and counts by bundle.

    Attributes:
        evaluations: kernel evaluations that a pixel of each bundle took.
        error: estimate of how wrong a pixel is, see `RayResult`; None where there is none.
        cut: bundles of which slabs were left out, as all rays of a packet had ended; None where rays do not end.
        normal: normal of what ends rays, in world space; None where nothing opaque is.
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
) -> ShardResult:
    """March the `nth` of `shards` of a band: all of its bundles, or the packets that `chosen` says (`CastMethod.packets_of`).

    The grid is that of the whole band. The schedule is that of the shard; with a lattice, that of the whole band.
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
    return ShardResult(jnp.moveaxis(rays.color, 0, -1), rays.transmittance, rays.depth, spent, rays.error, cut, normal)


class Layers(NamedTuple):
    """Arrays by pixel, of the part of a band that lies in the image, or of all the image.

    Attributes:
        evaluations: kernel evaluations that each pixel took.
        bound: how wrong a pixel can be, or is estimated to be; infinite where nothing is known.
        full: kernel evaluations that each pixel takes at full rate.
        levels: of slabs, by error control; None where it has no levels.
        rays: number of rays that were cast, if a quadtree interpolates pixels between them; None if each pixel has its own.
        normal: normal of what ends rays, see `Image`; None where nothing opaque is.
    """

    color: Float[Array, "rows columns 3"]
    transmittance: Float[Array, "rows columns"]
    depth: Float[Array, "rows columns"]
    evaluations: Float[Array, "rows columns"]
    bound: Float[Array, "rows columns"]
    full: Float[Array, "rows columns"]
    levels: Int[Array, "slabs bundle_rows bundle_columns"] | None
    rays: Int[Array, ""] | None = None
    normal: Float[Array, "rows columns 3"] | None = None


class Drawing(NamedTuple):
    """What drawing a band, or all the image, gives: its layers, and with them the counts of its grids.

    Attributes:
        faults: fault word of lists; of an image that of the scene in view, too.
        filled: number of slabs that hold any particle.
        pairs: number of pairs of particles and bundles.
    """

    layers: Layers
    faults: Any
    filled: Any
    pairs: Any

    @classmethod
    def of(cls, layers: Layers, counts: Sequence[Counts], faults: Int[Array, ""]) -> Drawing:
        """That of an image, by the counts of all its grids; `faults` is the fault word of the scene in view."""
        if not is_traced(faults, counts):
            faults, counts = int(faults), [(int(word), int(filled), int(pairs)) for word, filled, pairs in counts]  # type: ignore[assignment]
        words, filled, pairs = zip(*counts, strict=True)
        return cls(layers, functools.reduce(operator.or_, words, faults), sum(filled), sum(pairs))


@stage("plan", quickly=True)
def develop(shards: tuple[ShardResult, ...], decided: tuple[Decided, ...], *, plan: Plan) -> Layers:
    """Make the layers of a band of the results and decisions of its shards; there is one decision if one was made for all.

    A finite bound is at most 1, as no colour or alpha is off by more. Where nothing was compared the error is unknown: the bound
    is infinite.
    """
    rays, chosen, as_image, over_pixels = unshard(shards, 0), unshard(decided), plan.lists.as_image, plan.lists.over_pixels
    color, transmittance, depth = map(as_image, rays[:3])
    bound = over_pixels(chosen.bound)
    if rays.error is not None:
        error = as_image(rays.error)
        bound = jnp.where(error > 0, jnp.inf, bound) if plan.integrator == REFERENCE else error
    if rays.cut is not None:  # rays that ended leave out at most what they let through
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
    """Join the layers of all bands to those of the image; the last band may reach beyond it."""
    image: Layers = jax.tree.map(lambda *rows: jnp.concatenate(rows)[:height], *(one._replace(levels=None) for one in bands))
    if bands[0].levels is None:
        return image
    levels = jnp.concatenate([one.levels for one in bands], 1)  # type: ignore[misc]
    return image._replace(levels=levels[:, : -(-height // BUNDLE)])
