r"""Error control of a band by bounds of each sample: cells are sampled at levels, merged, and some of their slabs painted.

Flow: slab windows -> probe -> [adapt: analysis -> candidates -> merge] -> schedule -> cast -> image.

By default slabs are painted by cheaper bounds (`slabs`). Bounds of samples serve where paint is not asked for, as it has no
derivatives, and where bounds may be relaxed (`ControlPlan.by_samples`).

Most cells of a mixed fluid vary too much, and bounds need every particle of one. A few from the middle of a slab's window vary
less than all: where even these would change the image too much, nothing is lost by leaving a cell at full rate (`probe`).

A slab of S samples at level l spans 2^l slabs of fine samples, and its particles are the union of their windows: windows of
one depth-ordered list, so nothing is copied and nothing is referenced twice (Hochstetter et al. 2016, section 6.2). As long as
it fits into a cell, a cell gets fewer slabs; beyond that, neighbouring cells are merged in pairs, level by level, if all of
them allow it. A cell whose neighbours do not falls back to the last level that fits, which costs the same and errs less.

Decisions carry no gradient.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import (
    CELL_SAMPLES,
    MAX_LEVEL,
    Grid,
    SlabWindows,
    by_cell,
    by_slab,
    coarser_windows,
    find_slab_windows,
    shard,
    shard_of_grid,
    whole_cells,
)
from jaxsph.engine.control.allocation import EMPTY, bound, choose, kept, rounding_of
from jaxsph.engine.control.bounds import spheres, tables_of_parts
from jaxsph.engine.control.decide import Decided, Limits, at_full_rate, overlap
from jaxsph.engine.control.errors import LEVELS, SUPER_PIXEL, Candidates, analyse, fits
from jaxsph.engine.control.slabs import SlabRanges, Window, decide_by_slabs, find_radii, forecast, probes, slab_errors, survey
from jaxsph.engine.field.tasks import Painting, SlabSchedule, clipped, painted_over
from jaxsph.engine.media.shown import Shown
from jaxsph.engine.runtime.clock import Clock
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.model.camera.camera import Camera
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.compiled import fusion_barrier

MIN_SHARE_OF_CELL = 0.5  # of a cell's work, that promising slabs must hold: about what its analysis costs
MIN_PROMISING_SHARE = 0.1  # of a band's work, that promising cells must hold: the analysis costs up to a third of their cast


@dataclasses.dataclass(frozen=True)
class ControlPlan:
    """Static choices of error control.

    Attributes:
        super_pixels: whether a slab may be given one colour for all of its rays (Hochstetter et al. 2016, section 5.2).
        merge: whether coarse cells are merged along depth (6.2).
        allocation: how a bundle's tolerance is shared among its cells, see `allocation.choose`.
        coverage_subdivisions: sub-rectangles on each side of a footprint that are tested for coverage: 1, 2, 4 or 8.
        relaxed: whether bounds of samples may be relaxed (5.1).
    """

    super_pixels: bool
    merge: bool
    allocation: str
    coverage_subdivisions: int = 2
    relaxed: bool = False

    @property
    def by_samples(self) -> bool:
        """Whether cells are sampled at levels, by bounds of each sample: else slabs are painted or at full rate, see `slabs`."""
        return self.relaxed or not self.super_pixels

    def decide(
        self, clock: Clock, grid: Grid, shown: Shown, limits: Limits, shards: int, lists: Any, kernel: str, **sizes: Any
    ) -> tuple[list[Decided], None]:
        """What is to be marched of a band, shard by shard."""
        if self.by_samples:
            inputs = [(grid, shown, limits, nth) for nth in clock.shards(shards)]
            return clock.each("adapt", decide_by_bounds, inputs, shards=shards, control=self, **sizes), None
        how, each = {"shards": shards, "allocation": self.allocation, **sizes}, clock.shards(shards)
        radii = clock.one("adapt", find_radii, (grid.ordered,), tuning=sizes["tuning"])
        forecasts = clock.all_shards(clock.each("adapt", forecast, [(grid, radii, shown, limits, nth) for nth in each], **how))
        kinds = [(grid, radii, shown, tuple(forecasts), np.bool_(of_voxels)) for of_voxels in (False, True)]
        by_lists, by_voxels = clock.each("adapt", survey, kinds, **sizes)
        seen = by_lists._replace(covered=by_voxels.covered)
        return clock.each("adapt", decide_by_slabs, [(grid, radii, shown, limits, seen, nth) for nth in each], **how), None


@stage("shards", "slab_samples", "control")
def decide_by_bounds(
    grid: Grid,
    shown: Shown,
    limits: Limits,
    nth: Int[Array, ""],
    *,
    shards: int,
    slab_samples: int,
    control: ControlPlan,
    tuning: Tuning,
) -> Decided:
    """How each cell of the `nth` of `shards` of a band is sampled. Decisions carry no gradient.

    Cells that a face of a clip may cross are at full rate, so that all others are as if there were no clip, or not there.
    """
    grid, shown, limits = jax.tree.map(lax.stop_gradient, (grid, shown, limits))
    camera, transfer, *_ = shown.of_type(grid.half_steps.dtype)
    assert transfer is not None  # error control is of particles
    promising = probe(grid, camera, transfer, limits, slab_samples, tuning.slabs_bounded)
    wanted, grid = shard(promising, nth, shards), shard_of_grid(grid, nth, shards)
    lies = overlap(grid, shown.camera, shown.within, slab_samples)
    schedule, full = at_full_rate(grid, shown.transfer, slab_samples, lies)
    wanted = wanted if lies is None else wanted & whole_cells(lies.holds, slab_samples)
    references = schedule.references
    decided = adapt(grid, camera, transfer, references, wanted, limits, slab_samples, control, tuning)
    schedule, bound, painted, of_cells = decided
    count = grid.windows.count
    levels = jnp.where(count > 0, jnp.repeat(of_cells, CELL_SAMPLES // slab_samples, 0)[: count.shape[0]], EMPTY)
    marched = (levels == SUPER_PIXEL) & (schedule.count[: count.shape[0]] > 0)  # of a cell whose other slabs are painted
    levels = jnp.where(marched, 0, levels)
    return Decided(clipped(schedule, None if lies is None else lies.meets), bound, full, levels, painted)


def probe(
    grid: Grid, camera: Camera, transfer: TransferFunction, limits: Limits, slab_samples: int, at_once: int
) -> Bool[Array, "cells bundles"]:
    """Cells with slabs whose probes would change the image by less than the tolerance if painted, and all of opaque bundles.

    Bundles that the probes find opaque are analysed whole, as only bounds can tell how much of what lies behind is hidden.
    What is promising grows with the tolerance. Where such slabs hold too little of the work of a cell, or of all, to be analysed,
    there are none.
    """
    schedule, balls = at_full_rate(grid, transfer, slab_samples)[0], spheres(grid.ordered)
    look, tolerance = probes(grid, balls, camera, slab_samples), limits.tolerance

    def as_covered(window: Window, slab: Array, bundle: Array) -> tuple[list[tuple[Array, Array]], Array]:
        ends, covered = look.bounds(window, slab, bundle)
        return ends, jnp.ones_like(covered)

    whole = SlabRanges(as_covered, 0)
    errors = slab_errors(grid, balls, camera, transfer, schedule, schedule.filled, whole, limits, slab_samples, at_once)
    opaque = jnp.exp(-errors.tau_lo[0].sum(0)) < tolerance
    found = schedule.filled & ((errors.error.slabs[0] <= tolerance) | opaque)
    of_slabs = by_cell(schedule.count, slab_samples)
    held, all_held = (
        jnp.where(by_cell(where, slab_samples), of_slabs, 0).astype(jnp.float32).sum(1) for where in (found, schedule.filled)
    )
    wanted = (held > 0) & (held >= MIN_SHARE_OF_CELL * all_held)
    return wanted & (jnp.where(wanted, held, 0).sum() >= MIN_PROMISING_SHARE * all_held.sum())


def evaluations_of_levels(windows: list[SlabWindows], num_cells: int, slab_samples: int, merge: bool) -> list[Array | None]:
    """Kernel evaluations a ray and cell at every level, (cells, bundles); None where a level does not fit without merging."""
    costs: list[Array | None] = []
    fitting = fits(slab_samples)
    for level, window in enumerate(windows):
        count = window.count.astype(jnp.float32) * slab_samples
        if level <= fitting:
            groups = CELL_SAMPLES // slab_samples >> level
            costs.append(count.reshape(-1, groups, count.shape[1]).sum(1)[:num_cells])
        else:
            share = 1 << (level - fitting)
            costs.append(jnp.repeat(count / share, share, 0)[:num_cells] if merge else None)
    return costs


def merged_levels(
    chosen: Int[Array, "cells bundles"], free: Bool[Array, "cells bundles"], slab_samples: int
) -> Int[Array, "cells bundles"]:
    """Levels that neighbours agree on: above what fits into a cell, the highest that all of an aligned group allow.

    Args:
        chosen: candidate of every cell.
        free: cells that no particle can touch, nor their borders: they allow any level.
        slab_samples: samples of a slab.
    """
    fitting, num_cells = fits(slab_samples), chosen.shape[0]
    lateral = chosen == SUPER_PIXEL
    final = jnp.where(lateral, SUPER_PIXEL, jnp.minimum(chosen, fitting))
    able = jnp.where(free, MAX_LEVEL, jnp.where(lateral, 0, chosen))
    for level in range(fitting + 1, LEVELS):
        share = 1 << (level - fitting)
        groups = jnp.pad(able, ((0, -num_cells % share), (0, 0))).reshape(-1, share, able.shape[1])
        final = jnp.where(jnp.repeat((groups >= level).all(1), share, 0)[:num_cells], level, final)
    return final


def coarse_schedule(
    windows: list[SlabWindows],
    levels: Int[Array, "cells bundles"],
    references: tuple[Float[Array, "slabs bundles"], ...],
    painting: Painting | None,
    slab_samples: int,
) -> SlabSchedule:
    """The schedule for the `levels` of cells, as `merged_levels` gives them.

    Args:
        references: of the slabs at full rate; coarser ones take those of the first filled slab they span.
        painting: of super-pixels; None where there are none. Their other slabs are at full rate.
    """
    per_cell = CELL_SAMPLES // slab_samples
    classes, slabs, bundles = windows[0].begin.shape
    missing = slabs - levels.shape[0] * per_cell
    level = jnp.pad(jnp.repeat(jnp.where(levels == SUPER_PIXEL, 0, levels), per_cell, 0), ((0, missing), (0, 0)))
    place = jnp.arange(slabs, dtype=jnp.int32)[:, None]
    begin = length = jnp.zeros((classes, slabs, bundles), jnp.int32)
    for step, window in enumerate(windows):
        here = (level == step) & (place % (1 << step) == 0)
        begin = jnp.where(here, jnp.repeat(window.begin, 1 << step, 1), begin)
        length = jnp.where(here, jnp.repeat(window.length, 1 << step, 1), length)
    count = length.sum(0).astype(jnp.int32)
    references = tuple(_shared_references(reference, windows, level) for reference in references)
    schedule = SlabSchedule(count > 0, level, begin, length, count, references)
    return schedule if painting is None else painted_over(schedule, painting)


def _shared_references(reference: Array, windows: list[SlabWindows], level: Array) -> Array:
    """Of every item, that of the first filled slab that it spans."""
    first = shared = jnp.pad(reference, ((0, level.shape[0] - reference.shape[0]), (0, 0)))
    for step in range(1, LEVELS):
        filled = windows[step - 1].count > 0
        first = jnp.where(filled[::2], first[::2], first[1::2])
        shared = jnp.where(level == step, jnp.repeat(first, 1 << step, 0), shared)
    return shared


def adapt(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    references: tuple[Float[Array, "slabs bundles"], ...],
    wanted: Bool[Array, "cells bundles"],
    limits: Limits,
    slab_samples: int,
    plan: ControlPlan,
    tuning: Tuning,
) -> tuple[SlabSchedule, Float[Array, " bundles"], Float[Array, " bundles"], Int[Array, "cells bundles"]]:
    r"""Decide how every cell is sampled, at full rate all but the `wanted`; where none is, nothing is analysed.

    Two images of a bundle whose samples agree differ by rounding. A transmittance is rounded once a sample at most (a sum of
    thicknesses, of which the exponential keeps less than that) and once a slab; a colour once a slab, and by the samples of a
    slab and three more times its share. With n samples, S to a slab, that is less than (n + 2 n / S + S + 4) eps / 2 a pixel,
    thus (n + S) eps, and twice that for two images. Painted slabs round no more often than those that they stand for (what one
    rounds within itself is in its error). Only where all cells stay at level 0 are the images the same bits.

    Returns:
        The work; how much the pixels of each bundle can differ from the reference image (an estimate if `relax` > 0), and what
        of that is by super-pixels; and each cell's candidate: level 0 to 4, super-pixel (5), or -1 where there is nothing.
    """
    cells = grid.windows
    bundles, samples, dtype = cells.count.shape[1], grid.samples, grid.half_steps.dtype
    num_cells = -(-cells.count.shape[0] * slab_samples // CELL_SAMPLES)
    tables, windows = tables_of_parts(transfer), coarser_windows(cells)
    whole = ((jnp.arange(num_cells) + 1) * CELL_SAMPLES <= samples)[:, None]
    empty = by_cell(cells.count, slab_samples).sum(1) == 0

    def decide() -> tuple[Any, ...]:
        costs = evaluations_of_levels(windows, num_cells, slab_samples, plan.merge)
        full = next(cost for cost in costs if cost is not None)
        count = by_cell(cells.count, slab_samples).swapaxes(0, 1)
        of_levels = jnp.stack([jnp.zeros_like(full) if cost is None else full - cost for cost in costs])
        saving = Candidates(of_levels, (count * slab_samples).astype(of_levels.dtype))
        at_hand = jnp.asarray([cost is not None for cost in costs])[:, None, None]
        on_offer = Candidates(at_hand & ~empty & whole, plan.super_pixels & (count > 0) & whole)
        rounding = rounding_of((~empty).sum(0), dtype)
        beside = find_slab_windows(grid.ordered, grid.lists, beside=True)
        sizes = slab_samples, plan.coverage_subdivisions, tuning.cells_bounded
        errors = analyse(grid, beside, camera, references, wanted, tables, limits, *sizes)
        pick = functools.partial(choose, allocation=plan.allocation)
        chosen, painted = fusion_barrier(limits.tolerance >= 0, pick, errors, saving, on_offer, rounding, limits.tolerance)
        known = errors.error, chosen, painted, rounding, limits.tolerance
        chosen, painted, *_ = fusion_barrier(limits.tolerance >= 0, kept, *known)
        free = by_cell(beside.count, slab_samples).sum(1) == 0
        final = merged_levels(chosen, free & whole, slab_samples)
        shares = bound(errors.error, jnp.where(empty, 0, final), painted, rounding)
        return final, *shares, Painting(by_slab(painted), by_slab(errors.paint))

    def at_full_rate() -> tuple[Any, ...]:
        none, slabs = jnp.zeros(bundles, dtype), num_cells * CELL_SAMPLES // slab_samples
        nothing = Painting(jnp.zeros((slabs, bundles), bool), jnp.zeros((4, slabs, bundles), dtype))
        return jnp.zeros((num_cells, bundles), jnp.int32), none, none, nothing

    final, largest, of_paint, painting = lax.cond(wanted.any(), decide, at_full_rate)
    schedule = coarse_schedule(windows, final, references, painting if plan.super_pixels else None, slab_samples)
    return schedule, largest, of_paint, jnp.where(empty, EMPTY, final)
