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
from jaxsph.engine.control.bounds import SampleBounds, Spheres, sample_bounds, spheres, sum_rounding
from jaxsph.engine.control.errors import CANDIDATES, EXPONENTIAL, CellErrors, cell_errors, fits
from jaxsph.engine.control.ranges import RangeTables
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.fusion import fusion_barrier


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
) -> CellErrors:
    """Errors of the `wanted` cells of a band, as the bundle's pixels see them; infinite where nothing is analysed.

    Args:
        beside: windows of the slabs with their borders, as coarse samples lie on those.
        references: quantities that each slab's sums are taken relative to.
        tables: of the parts of the transfer function.
        relax: share of the lateral variation that is taken off the estimate, 0 for a certificate.
        coverage_subdivisions: sub-rectangles on each side of a footprint, for the test of coverage.
    """
    (slabs, bundles), per_cell = grid.windows.count.shape, CELL_SAMPLES // slab_samples
    num_cells = -(-slabs // per_cell)

    def padded(value: Array) -> Array:
        return jnp.pad(value, [(0, 0)] * (value.ndim - 2) + [(0, num_cells * per_cell - slabs), (0, 0)])

    def by_cell(value: Array) -> Array:
        return padded(value).reshape(num_cells, per_cell, bundles).swapaxes(0, 1)

    count, filled = by_cell(beside.count), by_cell(grid.windows.count > 0)
    band = _Band(
        grid,
        camera,
        tables,
        slab_samples,
        balls=spheres(grid.ordered),
        windows=(padded(beside.begin), padded(beside.length)),
        count=count.sum(0),
        references=[_extremes(by_cell(one), filled) for one in references],
        quantities=[_extremes(one, grid.ordered.live) for one in grid.ordered.quantities],
        borders=grid.borders(num_cells * CELL_SAMPLES),
    )
    chunk = min(cells_at_once, -(-num_cells * bundles // 16) * 16)
    order, number = fullest_first(wanted.ravel(), count.max(0).ravel(), chunk)

    def analyse_chunk(step: Array, table: CellErrors) -> CellErrors:
        at, real = lax.dynamic_slice(order, (step * chunk,), (chunk,)), step * chunk + jnp.arange(chunk) < number
        found = band.errors(at, real, relax, coverage_subdivisions)
        place = jnp.where(real, at, num_cells * bundles)
        return jax.tree.map(lambda rows, new: rows.at[..., place].set(new, mode="drop", unique_indices=True), table, found)

    # what is not analysed stays at level 0: the only candidate without an infinite error
    nothing = jnp.zeros((4, num_cells * bundles), grid.ordered.x.dtype)
    error = jnp.full((CANDIDATES, num_cells * bundles), jnp.inf, nothing.dtype).at[0].set(0)
    start = CellErrors(error, error, nothing, nothing[0])
    table = lax.fori_loop(0, (number + chunk - 1) // chunk, analyse_chunk, start)
    found: CellErrors = jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-1], num_cells, bundles), table)
    front = _transmitted(found.tau_lo)
    return dataclasses.replace(found, error=front * found.error, strict=front * found.strict)


@dataclasses.dataclass(frozen=True)
class _Band:
    """What the cells of a band are bounded by; slabs are padded to whole cells.

    Attributes:
        windows: of slabs with their borders, as `sample_bounds` takes them.
        count: particles of a cell's slabs in all.
        references: least and greatest of each cell's filled slabs, of each quantity.
        quantities: least and greatest of all particles, of each quantity.
        borders: of samples.
    """

    grid: Grid
    camera: Camera
    tables: tuple[RangeTables, ...]
    slab_samples: int
    balls: Spheres
    windows: tuple[Int[Array, "classes slabs bundles"], Int[Array, "classes slabs bundles"]]
    count: Int[Array, "cells bundles"]
    references: list[tuple[Array, Array]]
    quantities: list[tuple[Array, Array]]
    borders: Float[Array, " samples_and_one"]

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
        per_cell, (u, v) = CELL_SAMPLES // self.slab_samples, rays
        slab = (cell * per_cell + jnp.arange(per_cell, dtype=jnp.int32)[:, None]).reshape(-1)
        across, alive = jnp.tile(bundle, per_cell), jnp.tile(real, per_cell)
        begin, length = (value[:, slab, across] for value in self.windows)
        edges = self.borders[slab * self.slab_samples + jnp.arange(self.slab_samples + 1, dtype=jnp.int32)[:, None]]
        footprint = jnp.tile(u, per_cell), jnp.tile(v[::-1], per_cell)
        references = tuple(jax.tree.map(lambda end: jnp.tile(end[cell, bundle], per_cell), self.references))
        places = self.balls, self.grid.lists.rank, (begin, jnp.where(alive, length, 0)), footprint, edges
        found = sample_bounds(*places, references, self.tables, self.camera.is_perspective, subdivisions)

        def by_cell(value: Array) -> Array:
            """(samples of a slab, slabs of cells) to (samples of a cell, cells)."""
            return jnp.moveaxis(value.reshape(self.slab_samples, per_cell, -1), 1, 0).reshape(CELL_SAMPLES, -1)

        return jax.tree.map(by_cell, found)

    def _merging(self, at: Array) -> tuple[Array, Array]:
        """By how much colour and extinction of a sample can be rounded otherwise when cells are merged.

        A look-up changes by no more than its channel has, even at a jump, and by nothing where all quantities are one.
        """
        rounding, found = sum_rounding(self.count.ravel()[at], self.borders.dtype), []
        for tables, (least, greatest) in zip(self.tables, self.quantities, strict=True):
            misplaced = rounding * (greatest - least)
            found.append(jnp.where(misplaced > 0, jnp.minimum(tables.steepest[:, None] * misplaced, tables.scale[:, None]), 0))
        return found[0][:3].max(0), found[-1][3]


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
