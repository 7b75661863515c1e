r"""Which slabs are painted, by bounds that cost a few lookups a slab.

Flow: grid -> [slabs: forecast -> survey -> errors -> choice] -> schedule -> cast -> image.

One range of the quantity serves all samples of a slab: that over the particles of its window (`access.extremes`), of which
every sample's value is an affine combination. The optics follow by the transfer function's ranges, whether a sample can be
empty by voxels (`coverage`), and the error of paint by the theorem of `errors`.

**Theorem.** With one range a slab, paint errs less than any level of samples. *Argument.* A coarse sample may be anything in
the range, so a fine one may be off by its width; paint is in its middle, off by a half. Wider levels have the range of all
their slabs, which is no less. $\square$ And paint costs no evaluation. So slabs are painted or at full rate. Levels are for
bounds of each sample (`adapt`): where paint is not asked for, or bounds are relaxed.

Windows of few particles are looked at by boxes, particle by particle (`bounds`), as their range by lists would be that of
others.

A forecast from one bundle of `ONE_OF` tells whether a band is looked at: if more is saved there than that costs.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.compaction import compact
from jaxsph.engine.access.extremes import window_extremes
from jaxsph.engine.access.grid import Grid, by_cell, over_bundles, shard, shard_of_grid, some_of_grid
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.access.view import Ordered
from jaxsph.engine.control.allocation import EMPTY, choose, kept, rounding_of
from jaxsph.engine.control.bounds import (
    SampleBounds,
    Spheres,
    inverse_radii_of,
    ranges_of_parts,
    rounded_range,
    sample_bounds,
    spheres,
    tables_of_parts,
)
from jaxsph.engine.control.coverage import covered_slabs
from jaxsph.engine.control.decide import Decided, Limits, at_full_rate, overlap
from jaxsph.engine.control.errors import SUPER_PIXEL, Candidates, CellErrors, as_seen, paint_errors
from jaxsph.engine.field.sums import position
from jaxsph.engine.field.tasks import Painting, SlabSchedule, evaluations, painted_over
from jaxsph.engine.media.shown import Shown
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.model.camera.camera import Camera
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.compiled import fusion_barrier, side_by_side

ONE_OF, FEWEST = 16, 256  # bundles that are looked at first, and how many there must be for each of those
PROBES = 16  # particles of each of their slabs, all over its window
FEW, PARTS = 16, 2  # particles of windows that are looked at one by one, and parts of a footprint, on each side, that one holds
LEAST_OF_ALL = 0.1  # of the evaluations of a picture of few bundles, that are all looked at: what is saved at least
KEPT = 0.7  # of what looking at some particles promises
# Evaluations that take as long, on two cores, as one of each: voxels of a particle, extremes of an entry of lists, errors of a
# slab that is filled, and what is done with any slab.
PER_PARTICLE, PER_ENTRY, PER_FILLED, PER_SLAB = 200, 36, 1400, 140


class Forecast(NamedTuple):
    """Evaluations of a ray of each of some bundles at full rate, and how many of those are expected to be saved."""

    full: Float[Array, ""]
    saved: Float[Array, ""]


class BandBounds(NamedTuple):
    """What is known of a band before its slabs are decided.

    Attributes:
        extremes: of each quantity, at most the least and at least the greatest over the windows of slabs.
        covered: slabs in which no sample is empty.
        pays: whether deciding slab by slab is expected to save more than it costs.
    """

    extremes: tuple[tuple[Float[Array, "slabs bundles"], Float[Array, "slabs bundles"]], ...]
    covered: Bool[Array, "slabs bundles"]
    pays: Bool[Array, ""]


InverseRadii = tuple[Float[Array, " particles"], Float[Array, " particles"]]
Window = tuple[Int[Array, "classes some"], Int[Array, "classes some"]]


class SlabRanges(NamedTuple):
    """What there is to know of slabs.

    Attributes:
        bounds: of the windows of some, and of the numbers of slabs and bundles: ranges of each quantity, and which are covered.
        few: particles of a window that are looked at one by one instead.
    """

    bounds: Callable[[Window, Array, Array], tuple[list[tuple[Array, Array]], Array]]
    few: int


class Choice(NamedTuple):
    """Of a shard: what is painted, how wrong pixels of bundles can be by that, and that with rounding."""

    painting: Painting
    of_paint: Float[Array, " bundles"]
    bound: Float[Array, " bundles"]


@stage(quickly=True)
def find_radii(ordered: Ordered, *, tuning: Tuning) -> InverseRadii:
    """Find the radii of all particles, once for all stages: see `bounds.spheres`."""
    return inverse_radii_of(jax.tree.map(lax.stop_gradient, ordered))


@stage("shards", "slab_samples", "allocation")
def forecast(
    grid: Grid,
    radii: InverseRadii,
    shown: Shown,
    limits: Limits,
    nth: Int[Array, ""],
    *,
    shards: int,
    slab_samples: int,
    allocation: str,
    tuning: Tuning,
) -> Forecast:
    """Look at some particles of some bundles, of these at the `nth` of `shards`."""
    grid, shown, limits = jax.tree.map(lax.stop_gradient, (grid, shown, limits))
    camera, transfer, *_ = shown.of_type(grid.half_steps.dtype)
    assert transfer is not None  # error control is of particles
    step = shards * one_of(bundles := grid.row.shape[0])
    at = nth * (step // shards) + step * jnp.arange(-(-bundles // step), dtype=jnp.int32)
    some = some_of_grid(grid, jnp.minimum(at, bundles - 1), at < bundles)
    schedule, full = at_full_rate(some, transfer, slab_samples)
    balls, sizes = spheres(grid.ordered, radii), (limits, slab_samples, allocation, tuning)
    look = probes(some, balls, camera, slab_samples)
    choice = choose_slabs(some, balls, camera, transfer, schedule, schedule.filled, look, *sizes)
    left = dataclasses.replace(schedule, count=jnp.where(choice.painting.here, 0, schedule.count))
    return Forecast(full.sum(), (full - evaluations(left, grid.samples, slab_samples)).sum())


def one_of(bundles: int) -> int:
    """Of how many bundles one is looked at first."""
    return min(ONE_OF, max(bundles // FEWEST, 1))


@stage("slab_samples")
def survey(
    grid: Grid,
    radii: InverseRadii,
    shown: Shown,
    forecasts: tuple[Forecast, ...],
    of_voxels: Bool[Array, ""],
    *,
    slab_samples: int,
    tuning: Tuning,
) -> BandBounds:
    """Look at a band as a whole, if that is expected to pay: for the extremes of its windows, or by voxels for what is covered.

    The two, of which either takes one thread, run side by side; what is not looked for is 0.
    """
    grid, shown = jax.tree.map(lax.stop_gradient, (grid, shown))
    camera, *_ = shown.of_type(grid.half_steps.dtype)
    full, saved = (functools.reduce(jnp.add, counts) for counts in zip(*forecasts, strict=True))
    every = one_of(grid.row.shape[0])
    pays = KEPT * every * BUNDLE**2 * saved >= expected_cost(grid) if every > 1 else saved >= LEAST_OF_ALL * full
    quantities, nothing = grid.ordered.quantities, jnp.zeros(grid.windows.count.shape, grid.half_steps.dtype)

    def by_lists() -> Any:
        return tuple(window_extremes(quantity, grid.lists, grid.windows) for quantity in quantities)

    def by_voxels() -> Array:
        items = compact(grid.windows.count > FEW)
        return covered_slabs(grid, spheres(grid.ordered, radii), camera, items.item, items.start[-1], slab_samples)

    extremes = lax.cond(pays & ~of_voxels, by_lists, lambda: ((nothing, nothing),) * len(quantities))
    return BandBounds(extremes, lax.cond(pays & of_voxels, by_voxels, lambda: nothing > 0), pays)


def expected_cost(grid: Grid) -> Float[Array, ""]:
    """About as many evaluations as could be made while a band is decided slab by slab."""
    count, dtype = grid.windows.count, grid.half_steps.dtype
    numbers = grid.ordered.live.sum(), grid.lists.end.max(initial=0), (count > 0).sum()
    particles, entries, filled = (number.astype(dtype) for number in numbers)
    looks = jnp.maximum(PER_PARTICLE * particles, PER_ENTRY * entries)
    return looks + PER_FILLED * filled + PER_SLAB * count.size


@stage("shards", "slab_samples", "allocation")
def decide_by_slabs(
    grid: Grid,
    radii: InverseRadii,
    shown: Shown,
    limits: Limits,
    seen: BandBounds,
    nth: Int[Array, ""],
    *,
    shards: int,
    slab_samples: int,
    allocation: str,
    tuning: Tuning,
) -> Decided:
    """Which slabs of the `nth` of `shards` of a band are painted; those that a face of a clip may cross are not."""
    grid, shown, limits = jax.tree.map(lax.stop_gradient, (shard_of_grid(grid, nth, shards), shown, limits))
    camera, transfer, *_ = shown.of_type(grid.half_steps.dtype)
    assert transfer is not None
    balls = spheres(grid.ordered, radii)

    def decide(of_bundles: tuple[Any, ...]) -> Decided:
        some, (extremes, covered) = grid.with_bundles(of_bundles[0]), of_bundles[1]
        lies = overlap(some, shown.camera, shown.within, slab_samples)
        schedule, full = at_full_rate(some, shown.transfer, slab_samples, lies)
        wanted = schedule.filled if lies is None else schedule.filled & lies.holds
        dtype, none = grid.half_steps.dtype, jnp.zeros(full.shape, grid.half_steps.dtype)

        def nothing() -> Choice:
            return Choice(Painting(jnp.zeros(wanted.shape, bool), jnp.zeros((4, *wanted.shape), dtype)), none, none)

        def bounds_of(_: Window, slab: Array, bundle: Array) -> tuple[list[tuple[Array, Array]], Array]:
            return [(least[slab, bundle], greatest[slab, bundle]) for least, greatest in extremes], covered[slab, bundle]

        def look() -> Choice:
            ranges = SlabRanges(bounds_of, FEW)
            return choose_slabs(some, balls, camera, transfer, schedule, wanted, ranges, limits, slab_samples, allocation, tuning)

        choice = lax.cond(seen.pays & wanted.any(), look, nothing)
        levels = jnp.where(some.windows.count > 0, jnp.where(choice.painting.here, SUPER_PIXEL, 0), EMPTY)
        return Decided(painted_over(schedule, choice.painting), choice.bound, full, levels, choice.of_paint)

    return over_bundles(decide, (grid.bundles, shard(seen[:2], nth, shards)), tuning.bundles_decided)


def choose_slabs(
    grid: Grid,
    balls: Spheres,
    camera: Camera,
    transfer: TransferFunction,
    schedule: SlabSchedule,
    wanted: Bool[Array, "slabs bundles"],
    look: SlabRanges,
    limits: Limits,
    slab_samples: int,
    allocation: str,
    tuning: Tuning,
) -> Choice:
    """Paint as many evaluations as the tolerance allows, of slabs that are `wanted`; `schedule` is that at full rate."""
    errors = slab_errors(grid, balls, camera, transfer, schedule, wanted, look, limits, slab_samples, tuning.slabs_bounded)
    count, dtype = grid.windows.count, errors.strict.dtype
    whole = ((jnp.arange(count.shape[0]) + 1) * slab_samples <= grid.samples)[:, None]
    saving = Candidates(jnp.zeros_like(errors.strict), (count * slab_samples).astype(dtype)[None])
    on_offer = Candidates(jnp.ones_like(errors.strict, bool), (errors.error.slabs < jnp.inf) & whole)
    rounding = rounding_of(by_cell(count, slab_samples).any(1).sum(0), dtype)
    chosen, painted = choose(errors, saving, on_offer, rounding, limits.tolerance, allocation)
    known = errors.error, chosen, painted, rounding, limits.tolerance
    _, painted, largest, of_paint = fusion_barrier(limits.tolerance >= 0, kept, *known)
    return Choice(Painting(painted[0], errors.paint[:, 0]), of_paint, largest)


def slab_errors(
    grid: Grid,
    balls: Spheres,
    camera: Camera,
    transfer: TransferFunction,
    schedule: SlabSchedule,
    wanted: Bool[Array, "slabs bundles"],
    look: SlabRanges,
    limits: Limits,
    slab_samples: int,
    at_once: int,
) -> CellErrors:
    """Errors of painted slabs as the bundle's pixels see them, infinite if they are not `wanted`; of levels, full rate alone."""
    (slabs, bundles), dtype, number = wanted.shape, grid.half_steps.dtype, wanted.size
    tables = tables_of_parts(transfer)
    borders = grid.borders(slabs * slab_samples)[::slab_samples]
    u, v = grid.rays(camera, jnp.arange(bundles, dtype=jnp.int32))
    slant = jnp.sqrt(1 + u[:, None] ** 2 + v**2) if camera.is_perspective else jnp.ones((BUNDLE, BUNDLE, bundles), dtype)
    paths = slant.min((0, 1)), slant.max((0, 1))
    windows = [value.reshape(value.shape[0], number) for value in (grid.windows.begin, grid.windows.length)]
    chunk = min(at_once, -(-number // 16) * 16)

    def by_look(window: Window, slab: Array, bundle: Array) -> SampleBounds:
        ends, covered = fusion_barrier(slab[0] >= 0, look.bounds, window, slab, bundle)
        touched, terms = jnp.ones(chunk, bool), window[1].sum(0)

        def optics() -> Any:
            rounded = []
            for (least, greatest), reference in zip(ends, schedule.references, strict=True):
                near = reference[slab, bundle]
                rounded.append(rounded_range(touched, least, greatest, (near, near), terms))
            return ranges_of_parts(tables, rounded)

        found = SampleBounds(touched, covered, *fusion_barrier(slab[0] >= 0, optics))
        return jax.tree.map(lambda one: one[None], found)  # type: ignore[no-any-return]

    def by_boxes(window: Window, slab: Array, bundle: Array) -> SampleBounds:
        near = tuple((one[slab, bundle],) * 2 for one in schedule.references)
        depths, rays = (borders[slab][None], borders[slab + 1][None]), (u[:, bundle], v[::-1, bundle])
        return sample_bounds(balls, grid.lists.rank, window, rays, *depths, near, tables, camera.is_perspective, PARTS)

    def rows(bounds_of: Callable[..., SampleBounds], at: Array, real: Array) -> Array:
        slab, bundle = at // bundles, at % bundles
        bounds = bounds_of((windows[0][:, at], jnp.where(real, windows[1][:, at], 0)), slab, bundle)

        def found(bounds: SampleBounds) -> Array:
            lengths, shortest, longest = borders[slab + 1] - borders[slab], paths[0][bundle], paths[1][bundle]
            error, paint, tau_lo = paint_errors(bounds, lengths, shortest, longest, limits, slab_samples)
            return side_by_side([error, tau_lo, *paint], 0)

        return fusion_barrier(at[0] >= 0, found, bounds)  # type: ignore[no-any-return]

    alone = grid.windows.count <= look.few
    table = jnp.zeros((6, number + 1), dtype).at[0].set(jnp.inf)
    table = _with_rows(table, wanted & ~alone, chunk, functools.partial(rows, by_look))
    if look.few:
        table = _with_rows(table, wanted & alone, chunk, functools.partial(rows, by_boxes))
    found = table[:, :-1].reshape(6, 1, slabs, bundles)
    full_rate = jnp.zeros((1, slabs, bundles), dtype)
    return as_seen(CellErrors(Candidates(full_rate, found[0]), full_rate, found[2:], found[1]))


def _with_rows(
    table: Float[Array, "rows slabs_and_one"], where: Bool[Array, "slabs bundles"], chunk: int, rows_of: Callable[..., Array]
) -> Float[Array, "rows slabs_and_one"]:
    """The table with what `rows_of(at, real)` finds of the slabs that are marked, so many at a time."""
    filled, number = compact(where), where.size
    items = jnp.pad(filled.item, (0, chunk), constant_values=number)

    def some(nth: Array, table: Array) -> Array:
        at = lax.dynamic_slice(items, (nth * chunk,), (chunk,))
        return table.at[:, at].set(rows_of(jnp.minimum(at, number - 1), at < number))

    return lax.fori_loop(0, (filled.start[-1] + chunk - 1) // chunk, some, table)


def probes(grid: Grid, balls: Spheres, camera: Camera, slab_samples: int) -> SlabRanges:
    """A look at some particles of each window. Their range is less than that of all, and slabs count as covered that may not be.

    Whether they are is seen by two opposite corners.
    """
    rank = grid.lists.rank
    borders = grid.borders(grid.windows.count.shape[0] * slab_samples)[::slab_samples]
    u, v = grid.rays(camera, jnp.arange(grid.row.shape[0], dtype=jnp.int32))

    def bounds(window: Window, slab: Array, bundle: Array) -> tuple[list[tuple[Array, Array]], Array]:
        total, corners = window[1].sum(0), []
        for pixel, side in ((0, 0), (-1, 1)):
            depth = borders[slab + side]
            scale = depth if camera.is_perspective else 1
            corners.append((u[pixel, bundle] * scale, v[pixel, bundle] * scale, depth))

        def probe(nth: Array, found: tuple[Any, ...]) -> tuple[Any, ...]:
            ends, held = found
            at = position((total * (2 * nth + 1)) // (2 * PROBES), *window)
            ball = jax.tree.map(lambda column: column[rank[jnp.clip(at, 0, rank.shape[0] - 1)]], balls)
            place = ball.x, ball.y, ball.z
            for k, corner in enumerate(corners):
                off = sum(((one - other) * ball.inner) ** 2 for one, other in zip(place, corner, strict=True))
                held[k] = held[k] | (off < 1)
            ends = [
                (jnp.minimum(low, own), jnp.maximum(high, own)) for (low, high), own in zip(ends, ball.quantities, strict=True)
            ]
            return ends, held

        infinite, no = jnp.full(total.shape, jnp.inf, balls.x.dtype), jnp.zeros(total.shape, bool)
        start = [(infinite, -infinite)] * len(balls.quantities), [no, no]
        ends, held = lax.fori_loop(0, PROBES, probe, start)
        return ends, held[0] & held[1]

    return SlabRanges(bounds, 0)
