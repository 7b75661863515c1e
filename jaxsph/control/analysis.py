"""The error analysis of a band: what every cell's candidates would cost in light.

Flow: cells -> probe -> [analysis: bounds -> errors] -> levels -> merge -> cast -> image.

SlabWindows are analysed one by one, as if nothing lay in front of them; what does is then a product along the bundle. So
promising cells can be taken in any order: fullest first, some at a time, wherever they are.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.access.compaction import fullest_first
from jaxsph.access.grid import Grid
from jaxsph.access.lists import BUNDLE
from jaxsph.access.slab_windows import CELL_SAMPLES, SlabWindows
from jaxsph.control.bounds import Footprint, sample_bounds, spheres, sum_rounding
from jaxsph.control.errors import CANDIDATES, EXPONENTIAL, cell_errors, fits
from jaxsph.control.ranges import RangeTables
from jaxsph.model.camera import Camera
from jaxsph.numerics.fusion import fusion_barrier


@dataclasses.dataclass(frozen=True)
class Analysis:
    """Errors of all candidates of all cells: levels 0 to 4, super-pixel. Infinite where nothing was analysed.

    Attributes:
        error: bound (an estimate if relaxed) of the change of the bundle's pixels.
        strict: the same, never relaxed.
        paint: red, green, blue and extinction of each cell's super-pixel.
    """

    error: Float[Array, "candidates cells bundles"]
    strict: Float[Array, "candidates cells bundles"]
    paint: Float[Array, "4 cells bundles"]


def analyse(
    grid: Grid,
    beside: SlabWindows,
    camera: Camera,
    reference_quantity: Float[Array, "slabs bundles"],
    wanted: Bool[Array, "cells bundles"],
    tables: RangeTables,
    relax: Float[Array, ""],
    slab_samples: int,
    coverage_subdivisions: int,
    cells_at_once: int,
) -> Analysis:
    """Analyse the `wanted` cells of a band.

    Args:
        beside: windows of the slabs with their borders, as coarse samples lie on those.
        reference_quantity: quantity that each slab's sums are taken relative to.
        tables: of the transfer function.
        relax: share of the lateral variation that is taken off the estimate, 0 for a certificate.
        slab_samples: samples of each slab of the grid's cells.
        coverage_subdivisions: sub-rectangles on each side of a footprint, for the test of coverage.
    """
    ordered, rank = grid.ordered, grid.lists.rank
    slabs, bundles = grid.windows.count.shape
    dtype = ordered.x.dtype
    per_cell = CELL_SAMPLES // slab_samples
    num_cells = -(-slabs // per_cell)
    chunk = min(cells_at_once, -(-num_cells * bundles // 16) * 16)
    balls = spheres(ordered)
    missing = ((0, num_cells * per_cell - slabs), (0, 0))
    count = jnp.pad(beside.count, missing).reshape(num_cells, per_cell, bundles)
    fullest, count = count.max(1), count.sum(1)
    filled = jnp.pad(grid.windows.count > 0, missing)
    order, number = fullest_first(wanted.ravel(), fullest.ravel(), chunk)
    begin, length = (jnp.pad(window, ((0, 0), *missing)) for window in (beside.begin, beside.length))
    reference_quantity = jnp.pad(reference_quantity, missing)
    quantities = _extremes(ordered.quantity, ordered.live)
    borders = grid.borders(num_cells * CELL_SAMPLES)

    def analyse_chunk(step: Array, table: Array) -> Array:
        at = lax.dynamic_slice(order, (step * chunk,), (chunk,))
        cell, bundle, real = at // bundles, at % bundles, step * chunk + jnp.arange(chunk) < number
        u, v = grid.rays(camera, bundle)
        slab = (cell * per_cell + jnp.arange(per_cell, dtype=jnp.int32)[:, None]).reshape(-1)
        across, alive = jnp.tile(bundle, per_cell), jnp.tile(real, per_cell)
        window = begin[:, slab, across], jnp.where(alive, length[:, slab, across], 0)
        edges = borders[slab * slab_samples + jnp.arange(slab_samples + 1, dtype=jnp.int32)[:, None]]
        footprint = Footprint(jnp.tile(u, per_cell), jnp.tile(v[::-1], per_cell))
        places = _extremes(*(value[slab, across].reshape(per_cell, chunk) for value in (reference_quantity, filled)))
        places = jnp.tile(places[0], per_cell), jnp.tile(places[1], per_cell)
        look = functools.partial(
            sample_bounds, tables=tables, perspective=camera.is_perspective, subdivisions=coverage_subdivisions
        )
        of_slabs = look(balls, rank, window, footprint, edges, places)
        bounds = jax.tree.map(functools.partial(_by_cell, per_cell=per_cell), of_slabs)
        edges = borders[cell * CELL_SAMPLES + jnp.arange(CELL_SAMPLES + 1, dtype=jnp.int32)[:, None]]
        paths = jnp.ones((BUNDLE, BUNDLE, chunk), dtype)
        if camera.is_perspective:
            paths = jnp.sqrt(1 + u[:, None] ** 2 + v**2)
        misplaced = sum_rounding(count.ravel()[at], dtype) * (quantities[1] - quantities[0])
        # a look-up changes by no more than its channel has, even at a jump, and by nothing where all quantities are one
        merging = jnp.where(misplaced > 0, jnp.minimum(tables.steepest[:, None] * misplaced, tables.scale[:, None]), 0)
        errors = functools.partial(cell_errors, fitting=fits(slab_samples))
        path = paths.min((0, 1)), paths.max((0, 1))
        found = fusion_barrier(step >= 0, errors, bounds, edges, *path, (merging[:3].max(0), merging[3]), relax)
        entry = jnp.concatenate([found.error, found.strict, found.paint, found.thin[None]])
        return table.at[:, jnp.where(real, at, table.shape[1])].set(entry, mode="drop", unique_indices=True)

    # what is not analysed stays at level 0: the only candidate without an infinite error
    blank = jnp.full(2 * CANDIDATES + 5, jnp.inf, dtype).at[jnp.asarray([0, CANDIDATES, -1])].set(0)[:, None]
    table = jnp.broadcast_to(blank, (blank.shape[0], num_cells * bundles))
    table = lax.fori_loop(0, (number + chunk - 1) // chunk, analyse_chunk, table).reshape(-1, num_cells, bundles)
    error, strict, paint, thin = jnp.split(table, [CANDIDATES, 2 * CANDIDATES, 2 * CANDIDATES + 4])
    front = _transmitted(thin[0])
    return Analysis(front * error, front * strict, paint)


def _transmitted(thin: Float[Array, "cells bundles"]) -> Float[Array, "cells bundles"]:
    """At least what the cells in front let through, as computed: the sum is rounded down, the result up."""
    eps, cells = jnp.finfo(thin.dtype).eps, thin.shape[0]
    total = lax.associative_scan(jnp.add, thin) * (1 - (cells + 2) * eps)
    # each sample's computed transmittance may be larger than the exponential by a few roundings, and products round too
    return jnp.concatenate([jnp.ones_like(total[:1]), jnp.exp(-total[:-1])]) * (
        1 + (EXPONENTIAL + 1) * CELL_SAMPLES * cells * eps
    )


def _extremes(value: Array, where: Array) -> tuple[Array, Array]:
    """Least and greatest along the first axis of those that count."""
    return jnp.where(where, value, jnp.inf).min(0), jnp.where(where, value, -jnp.inf).max(0)


def _by_cell(value: Array, per_cell: int) -> Array:
    """(samples of a slab, slabs of cells) to (samples of a cell, cells)."""
    samples = value.shape[0]
    return jnp.moveaxis(value.reshape(samples, per_cell, -1), 1, 0).reshape(per_cell * samples, -1)


jax.tree_util.register_dataclass(Analysis, data_fields=["error", "strict", "paint"], meta_fields=[])
