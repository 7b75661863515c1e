"""Error control of a band of the image: from the grid and a tolerance to the work that is worth doing.

Flow: cells -> [look -> adapt: analysis -> levels -> merge] -> worklist -> cast -> image.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.access.cells import Cells, cells_with_borders
from jaxsph.access.grid import Grid
from jaxsph.control.analysis import analyse
from jaxsph.control.levels import Offer, bound, choose
from jaxsph.control.merge import coarse_work, coarser_windows, evaluations_of_levels, merged_levels, uncoarsened
from jaxsph.control.probe import Probe, probe
from jaxsph.control.ranges import range_tables
from jaxsph.control.worklist import CELL, Worklist
from jaxsph.model.camera import Camera
from jaxsph.model.transfer import TransferFunction

EMPTY = -1  # what a cell without particles is given


@dataclasses.dataclass(frozen=True)
class ControlPlan:
    """Static choices of error control.

    Attributes:
        super_pixels: whether a cell may be given one colour for all of its rays (first paper, section 5.2).
        merge: whether coarse cells are merged along depth (6.2).
        allocation: how a bundle's tolerance is shared among its cells, see `levels.choose`.
        parts: sub-rectangles on each side of a footprint that are tested for coverage: 1, 2, 4 or 8.
    """

    super_pixels: bool
    merge: bool
    allocation: str
    parts: int = 2


def look(
    grid: Grid,
    transfer: TransferFunction,
    tolerance: Float[Array, ""],
    relax: Float[Array, ""],
    slab_samples: int,
    plan: ControlPlan,
) -> Probe:
    """Which cells are worth an analysis, of a band or of a part of it."""
    lateral = 1 - relax if plan.allocation == "paper" else 0.0
    return probe(grid, range_tables(transfer), tolerance, lateral, slab_samples)


def adapt(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    origin: Float[Array, "slabs bundles"],
    wanted: Bool[Array, "cells bundles"],
    tolerance: Float[Array, ""],
    relax: Float[Array, ""],
    slab_samples: int,
    plan: ControlPlan,
) -> tuple[Worklist, Float[Array, " bundles"], Int[Array, "cells bundles"]]:
    r"""Decide how every cell is sampled, at full rate all but the `wanted`; where none is, nothing is analysed.

    Two images of a bundle whose samples agree differ by rounding. A transmittance is rounded once a sample at most (a sum of
    thicknesses, of which the exponential keeps less than that) and once a slab;
    a colour once a slab, and by the samples of a slab and three more times its share. With n samples, S to a slab, that is
    less than (n + 2 n / S + S + 4) eps / 2 a pixel, thus (n + S) eps, and twice that for two images. Only where all cells
    stay at level 0 are the images the same bits.

    Returns:
        The work; how much the pixels of each bundle can differ from the reference image (an estimate if `relax` > 0); and
        each cell's candidate: level 0 to 4, super-pixel (5), or -1 where there is nothing.
    """
    cells = grid.cells
    bundles, samples, dtype = cells.count.shape[1], grid.samples, grid.half_steps.dtype
    num_cells = -(-cells.count.shape[0] * slab_samples // CELL)
    tables = range_tables(transfer)
    whole = ((jnp.arange(num_cells) + 1) * CELL <= samples)[:, None]
    empty = _nowhere(cells, num_cells, slab_samples)

    def decide() -> tuple[Worklist, Array, Array]:
        windows = coarser_windows(cells, slab_samples)
        costs = evaluations_of_levels(windows, num_cells, slab_samples, plan.merge)
        full = next(cost for cost in costs if cost is not None)
        saving = jnp.stack([jnp.zeros_like(full) if cost is None else full - cost for cost in costs] + [full])
        on_offer = jnp.asarray([cost is not None for cost in costs] + [plan.super_pixels])[:, None, None]
        rounding = 2 * jnp.finfo(dtype).eps * (CELL * ((~empty).sum(0) + 1)).astype(dtype)
        offer = Offer(saving, on_offer & ~empty & whole, rounding)
        beside = cells_with_borders(grid.ordered, grid.lists)
        analysis = analyse(grid, beside, camera, origin, wanted, tables, relax, slab_samples, plan.parts)
        chosen = choose(analysis, offer, tolerance, relax, plan.allocation)
        free = _nowhere(beside, num_cells, slab_samples)
        final = merged_levels(chosen, free & whole, slab_samples)
        largest = bound(analysis.error, jnp.where(empty, 0, final), rounding)
        paint = analysis.paint if plan.super_pixels else None
        return coarse_work(windows, final, origin, paint, slab_samples), largest, final

    def leave() -> tuple[Worklist, Array, Array]:
        return uncoarsened(cells, origin, plan.super_pixels), jnp.zeros(bundles, dtype), untouched(cells, slab_samples)

    work, largest, final = lax.cond(wanted.any(), decide, leave)
    return work, largest, jnp.where(empty, EMPTY, final)


def untouched(cells: Cells, slab_samples: int) -> Int[Array, "cells bundles"]:
    """Levels of cells that are all left at full rate."""
    empty = _nowhere(cells, -(-cells.count.shape[0] * slab_samples // CELL), slab_samples)
    return jnp.where(empty, jnp.int32(EMPTY), 0)


def _nowhere(cells: Cells, num_cells: int, slab_samples: int) -> Bool[Array, "cells bundles"]:
    """Cells that no particle can touch."""
    count = jnp.pad(cells.count, ((0, num_cells * CELL // slab_samples - cells.count.shape[0]), (0, 0)))
    return count.reshape(num_cells, -1, count.shape[1]).sum(1) == 0
