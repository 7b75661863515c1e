"""The error analysis of a band: what every cell's candidates would cost in light.

Flow: cells -> probe -> [analysis: bounds -> errors] -> levels -> merge -> cast -> image.

Cells are analysed one by one, as if nothing lay in front of them; what does is then a product along the bundle. So
promising cells can be taken in any order: fullest first, some at a time, wherever they are.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.compaction import fullest_first
from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.access.slab_windows import CELL_SAMPLES, SlabWindows
from jaxsph.engine.control.bounds import Footprint, SampleBounds, Spheres, sample_bounds, spheres, sum_rounding
from jaxsph.engine.control.errors import CANDIDATES, EXPONENTIAL, CellErrors, cell_errors, fits
from jaxsph.engine.control.ranges import RangeTables
from jaxsph.model.camera.camera import Camera
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
    references: tuple[Float[Array, "slabs bundles"], ...],
    wanted: Bool[Array, "cells bundles"],
    tables: tuple[RangeTables, ...],
    relax: Float[Array, ""],
    slab_samples: int,
    coverage_subdivisions: int,
    cells_at_once: int,
) -> Analysis:
    """Analyse the `wanted` cells of a band.

    Args:
        beside: windows of the slabs with their borders, as coarse samples lie on those.
        references: quantities that each slab's sums are taken relative to.
        tables: of the parts of the transfer function.
        relax: share of the lateral variation that is taken off the estimate, 0 for a certificate.
        slab_samples: samples of each slab of the grid's cells.
        coverage_subdivisions: sub-rectangles on each side of a footprint, for the test of coverage.
    """
    slabs, bundles = grid.windows.count.shape
    num_cells = -(-slabs * slab_samples // CELL_SAMPLES)
    chunk = min(cells_at_once, -(-num_cells * bundles // 16) * 16)
    band = _band(grid, beside, camera, references, tables, slab_samples)
    order, number = fullest_first(wanted.ravel(), band.fullest.ravel(), chunk)

    def analyse_chunk(step: Array, table: Array) -> Array:
        at = lax.dynamic_slice(order, (step * chunk,), (chunk,))
        real = step * chunk + jnp.arange(chunk) < number
        found = band.errors(at, real, relax, coverage_subdivisions)
        entry = jnp.concatenate([found.error, found.strict, found.paint, found.tau_lo[None]])
        return table.at[:, jnp.where(real, at, table.shape[1])].set(entry, mode="drop", unique_indices=True)

    # what is not analysed stays at level 0: the only candidate without an infinite error
    blank = jnp.full(2 * CANDIDATES + 5, jnp.inf, grid.ordered.x.dtype).at[jnp.asarray([0, CANDIDATES, -1])].set(0)[:, None]
    table = jnp.broadcast_to(blank, (blank.shape[0], num_cells * bundles))
    table = lax.fori_loop(0, (number + chunk - 1) // chunk, analyse_chunk, table).reshape(-1, num_cells, bundles)
    error, strict, paint, tau_lo = jnp.split(table, [CANDIDATES, 2 * CANDIDATES, 2 * CANDIDATES + 4])
    front = _transmitted(tau_lo[0])
    return Analysis(front * error, front * strict, paint)


@dataclasses.dataclass(frozen=True)
class _Band:
    """What the cells of a band are bounded by; slabs are padded to whole cells.

    Attributes:
        begin, length: windows of slabs with their borders.
        count, fullest: particles of a cell's slabs in all, and of the fullest.
        filled, references: of slabs.
        quantities: least and greatest of all particles, of each quantity.
        borders: of samples.
    """

    grid: Grid
    camera: Camera
    balls: Spheres
    tables: tuple[RangeTables, ...]
    begin: Int[Array, "classes slabs bundles"]
    length: Int[Array, "classes slabs bundles"]
    count: Int[Array, "cells bundles"]
    fullest: Int[Array, "cells bundles"]
    filled: Bool[Array, "slabs bundles"]
    references: tuple[Float[Array, "slabs bundles"], ...]
    quantities: list[tuple[Array, Array]]
    borders: Float[Array, " samples_and_one"]
    slab_samples: int

    @property
    def per_cell(self) -> int:
        """Slabs of a cell."""
        return CELL_SAMPLES // self.slab_samples

    def errors(self, at: Array, real: Array, relax: Array, subdivisions: int) -> CellErrors:
        """Errors of some cells' candidates."""
        bundles = self.grid.windows.count.shape[1]
        cell, bundle = at // bundles, at % bundles
        u, v = self.grid.rays(self.camera, bundle)
        bounds = self._bounds(cell, bundle, real, (u, v), subdivisions)
        edges = self.borders[cell * CELL_SAMPLES + jnp.arange(CELL_SAMPLES + 1, dtype=jnp.int32)[:, None]]
        paths = jnp.ones((BUNDLE, BUNDLE, at.shape[0]), edges.dtype)
        if self.camera.is_perspective:
            paths = jnp.sqrt(1 + u[:, None] ** 2 + v**2)
        path = paths.min((0, 1)), paths.max((0, 1))
        errors = functools.partial(cell_errors, fitting=fits(self.slab_samples))
        return fusion_barrier(at[0] >= 0, errors, bounds, edges, *path, self._merging(at), relax)

    def _bounds(self, cell: Array, bundle: Array, real: Array, rays: tuple[Array, Array], subdivisions: int) -> SampleBounds:
        """Bounds of all samples of cells."""
        per_cell, (u, v) = self.per_cell, rays
        slab = (cell * per_cell + jnp.arange(per_cell, dtype=jnp.int32)[:, None]).reshape(-1)
        across, alive = jnp.tile(bundle, per_cell), jnp.tile(real, per_cell)
        window = self.begin[:, slab, across], jnp.where(alive, self.length[:, slab, across], 0)
        edges = self.borders[slab * self.slab_samples + jnp.arange(self.slab_samples + 1, dtype=jnp.int32)[:, None]]
        footprint = Footprint(jnp.tile(u, per_cell), jnp.tile(v[::-1], per_cell))
        filled, *of_slabs = (value[slab, across].reshape(per_cell, -1) for value in (self.filled, *self.references))
        ends = [_extremes(one, filled) for one in of_slabs]
        references = tuple((jnp.tile(least, per_cell), jnp.tile(greatest, per_cell)) for least, greatest in ends)
        look = functools.partial(sample_bounds, perspective=self.camera.is_perspective, subdivisions=subdivisions)
        found = look(self.balls, self.grid.lists.rank, window, footprint, edges, references, self.tables)
        return jax.tree.map(functools.partial(_by_cell, per_cell=per_cell), found)

    def _merging(self, at: Array) -> tuple[Array, Array]:
        """By how much colour and extinction of a sample can be rounded otherwise when cells are merged.

        A look-up changes by no more than its channel has, even at a jump, and by nothing where all quantities are one.
        """
        rounding, found = sum_rounding(self.count.ravel()[at], self.borders.dtype), []
        for tables, (least, greatest) in zip(self.tables, self.quantities, strict=True):
            misplaced = rounding * (greatest - least)
            found.append(jnp.where(misplaced > 0, jnp.minimum(tables.steepest[:, None] * misplaced, tables.scale[:, None]), 0))
        return found[0][:3].max(0), found[-1][3]


def _band(
    grid: Grid,
    beside: SlabWindows,
    camera: Camera,
    references: tuple[Array, ...],
    tables: tuple[RangeTables, ...],
    slab_samples: int,
) -> _Band:
    slabs, bundles = grid.windows.count.shape
    per_cell = CELL_SAMPLES // slab_samples
    num_cells = -(-slabs // per_cell)
    missing = ((0, num_cells * per_cell - slabs), (0, 0))
    begin, length = (jnp.pad(window, ((0, 0), *missing)) for window in (beside.begin, beside.length))
    count = jnp.pad(beside.count, missing).reshape(num_cells, per_cell, bundles)
    filled, reference = jnp.pad(grid.windows.count > 0, missing), tuple(jnp.pad(one, missing) for one in references)
    quantities = [_extremes(one, grid.ordered.live) for one in grid.ordered.quantities]
    borders = grid.borders(num_cells * CELL_SAMPLES)
    of_cells, balls = (count.sum(1), count.max(1)), spheres(grid.ordered)
    return _Band(grid, camera, balls, tables, begin, length, *of_cells, filled, reference, quantities, borders, slab_samples)


def _transmitted(tau_lo: Float[Array, "cells bundles"]) -> Float[Array, "cells bundles"]:
    """At least what the cells in front let through, as computed: the sum is rounded down, the result up."""
    eps, cells = jnp.finfo(tau_lo.dtype).eps, tau_lo.shape[0]
    total = lax.associative_scan(jnp.add, tau_lo) * (1 - (cells + 2) * eps)
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
