"""Error control of a band of the image: from the grid and a tolerance to the work that is worth doing.

Flow: slab windows -> probe -> [adapt: analysis -> levels -> merge] -> schedule -> cast -> image.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.slab_windows import CELL_SAMPLES, SlabWindows, coarser_windows, find_slab_windows
from jaxsph.engine.control.analysis import analyse
from jaxsph.engine.control.errors import SUPER_PIXEL
from jaxsph.engine.control.levels import bound, choose
from jaxsph.engine.control.merge import coarse_schedule, evaluations_of_levels, merged_levels
from jaxsph.engine.control.ranges import tables_of_parts
from jaxsph.engine.field.schedule import SlabSchedule
from jaxsph.engine.runtime.tuning import Tuning
from jaxsph.model.camera.camera import Camera
from jaxsph.model.transfer.function import TransferFunction

EMPTY = -1  # what a cell without particles is given


@dataclasses.dataclass(frozen=True)
class ControlPlan:
    """Static choices of error control.

    Attributes:
        super_pixels: whether a cell may be given one colour for all of its rays (Hochstetter et al. 2016, section 5.2).
        merge: whether coarse cells are merged along depth (6.2).
        allocation: how a bundle's tolerance is shared among its cells, see `levels.choose`.
        coverage_subdivisions: sub-rectangles on each side of a footprint that are tested for coverage: 1, 2, 4 or 8.
    """

    super_pixels: bool
    merge: bool
    allocation: str
    coverage_subdivisions: int = 2


def adapt(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    references: tuple[Float[Array, "slabs bundles"], ...],
    wanted: Bool[Array, "cells bundles"],
    tolerance: Float[Array, ""],
    relax: Float[Array, ""],
    slab_samples: int,
    plan: ControlPlan,
    tuning: Tuning,
) -> tuple[SlabSchedule, Float[Array, " bundles"], Float[Array, " bundles"], Int[Array, "cells bundles"]]:
    r"""Decide how every cell is sampled, at full rate all but the `wanted`; where none is, nothing is analysed.

    Two images of a bundle whose samples agree differ by rounding. A transmittance is rounded once a sample at most (a sum of
    thicknesses, of which the exponential keeps less than that) and once a slab;
    a colour once a slab, and by the samples of a slab and three more times its share. With n samples, S to a slab, that is
    less than (n + 2 n / S + S + 4) eps / 2 a pixel, thus (n + S) eps, and twice that for two images. Only where all cells
    stay at level 0 are the images the same bits.

    Returns:
        The work; how much the pixels of each bundle can differ from the reference image (an estimate if `relax` > 0), and what
        of that is by super-pixels; and each cell's candidate: level 0 to 4, super-pixel (5), or -1 where there is nothing.
    """
    cells = grid.windows
    bundles, samples, dtype = cells.count.shape[1], grid.samples, grid.half_steps.dtype
    num_cells = -(-cells.count.shape[0] * slab_samples // CELL_SAMPLES)
    tables, windows = tables_of_parts(transfer), coarser_windows(cells, slab_samples)
    whole = ((jnp.arange(num_cells) + 1) * CELL_SAMPLES <= samples)[:, None]
    empty = _nowhere(cells, num_cells, slab_samples)

    def decide() -> tuple[Array, Array, Array, Array]:
        costs = evaluations_of_levels(windows, num_cells, slab_samples, plan.merge)
        full = next(cost for cost in costs if cost is not None)
        saving = jnp.stack([jnp.zeros_like(full) if cost is None else full - cost for cost in costs] + [full])
        on_offer = jnp.asarray([cost is not None for cost in costs] + [plan.super_pixels])[:, None, None]
        rounding = rounding_of((~empty).sum(0), dtype)
        beside = find_slab_windows(grid.ordered, grid.lists, beside=True)
        sizes = slab_samples, plan.coverage_subdivisions, tuning.cells_bounded
        errors = analyse(grid, beside, camera, references, wanted, tables, relax, *sizes)
        chosen = choose(errors, saving, on_offer & ~empty & whole, rounding, tolerance, plan.allocation)
        free = _nowhere(beside, num_cells, slab_samples)
        final = merged_levels(chosen, free & whole, slab_samples)
        painted = jnp.where(~empty & (final == SUPER_PIXEL), errors.error[SUPER_PIXEL], 0).sum(0)
        return final, bound(errors.error, jnp.where(empty, 0, final), rounding), painted, errors.paint

    def at_full_rate() -> tuple[Array, Array, Array, Array]:
        none = jnp.zeros(bundles, dtype)
        return jnp.zeros((num_cells, bundles), jnp.int32), none, none, jnp.zeros((4, num_cells, bundles), dtype)

    final, largest, painted, paint = lax.cond(wanted.any(), decide, at_full_rate)
    schedule = coarse_schedule(windows, final, references, paint if plan.super_pixels else None, slab_samples)
    return schedule, largest, painted, jnp.where(empty, EMPTY, final)


def rounding_of(filled: Int[Array, " bundles"], dtype: Any) -> Float[Array, " bundles"]:
    """What rounding adds to the bound of bundles that have so many filled cells, see `adapt`."""
    return 2 * jnp.finfo(dtype).eps * (CELL_SAMPLES * (filled + 1)).astype(dtype)


def _nowhere(cells: SlabWindows, num_cells: int, slab_samples: int) -> Bool[Array, "cells bundles"]:
    """Cells that no particle can touch."""
    count = jnp.pad(cells.count, ((0, num_cells * CELL_SAMPLES // slab_samples - cells.count.shape[0]), (0, 0)))
    return count.reshape(num_cells, -1, count.shape[1]).sum(1) == 0
