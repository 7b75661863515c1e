r"""Bounds of all pixels of a bundle, for any levels of its cells: Hochstetter et al. 2016, sections 4.2 and 4.3, equation 4.

Flow: cells, levels -> [enclosure] -> lower and upper image.

Composited back to front in the lerp form: what leaves a sample is $c (1 - T) + T B$ for what arrives B, which grows with c and
with B and is linear in T, so its range over independent intervals lies at the ends of T. The paper keeps irradiance
$I = c (1 - T)$ and T as intervals of their own and adds $I + T B$, which forgets that they move together; `form="paper"` does
the same, to compare.

Error control does not need these bounds (see `errors`): they count how much the rays of a bundle differ even at full rate.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.grid import CELL_SAMPLES, MAX_LEVEL, Grid, find_slab_windows
from jaxsph.engine.control.bounds import SampleBounds, sample_bounds, spheres, tables_of_parts
from jaxsph.engine.control.errors import DEPTH_ROUNDING, EXPONENTIAL
from jaxsph.model.camera.camera import Camera
from jaxsph.model.transfer.function import TransferFunction

COMPOSITING = 4  # eps a sample, at most, that a computed colour is off by: its transmittance, product, difference and sum


@dataclasses.dataclass(frozen=True)
class BundleBounds:
    """Least and greatest red, green, blue and alpha of every pixel of a bundle."""

    lo: Float[Array, "4 bundles"]
    hi: Float[Array, "4 bundles"]


def bundle_bounds(
    grid: Grid,
    camera: Camera,
    transfer: TransferFunction,
    levels: Int[Array, "cells bundles"],
    slab_samples: int,
    *,
    subdivisions: int = 2,
    form: str = "lerp",
) -> BundleBounds:
    """Bounds of the pixels of all bundles of a band when cells are sampled at `levels`, 0 to 4.

    Args:
        levels: of every cell; those of merged cells are equal.
        slab_samples: samples of each slab of the grid's cells.
        subdivisions: sub-rectangles on each side of a footprint, for the test of coverage.
        form: `"lerp"`, or `"paper"` for irradiance and transmittance as separate intervals.
    """
    ordered, lists = grid.ordered, grid.lists
    slabs, bundles = grid.windows.count.shape
    dtype = ordered.x.dtype
    per_cell = CELL_SAMPLES // slab_samples
    num_cells = -(-slabs // per_cell)
    tables, balls = tables_of_parts(transfer), spheres(ordered)
    missing = ((0, num_cells * per_cell - slabs), (0, 0))
    borders = grid.borders(num_cells * CELL_SAMPLES)
    beside = find_slab_windows(ordered, lists, beside=True)
    begin, length = (jnp.pad(window, ((0, 0), *missing)) for window in (beside.begin, beside.length))
    extremes = [
        (jnp.where(ordered.live, quantity, jnp.inf).min(), jnp.where(ordered.live, quantity, -jnp.inf).max())
        for quantity in ordered.quantities
    ]
    u, v = grid.rays(camera, jnp.arange(bundles, dtype=jnp.int32))
    paths = jnp.sqrt(1 + u[:, None] ** 2 + v**2) if camera.is_perspective else jnp.ones((1, 1, bundles), dtype)
    path = paths.min((0, 1)), paths.max((0, 1))

    def through_cell(cell: Array, behind: tuple[Array, Array]) -> tuple[Array, Array]:
        found = []
        for k in range(per_cell):
            slab = cell * per_cell + k
            edges = borders[slab * slab_samples + jnp.arange(slab_samples + 1)]
            edges = jnp.broadcast_to(edges[:, None], (slab_samples + 1, bundles))
            window = begin[:, slab], length[:, slab]
            places = tuple(tuple(jnp.broadcast_to(end, (bundles,)) for end in ends) for ends in extremes)
            footprint = u, v[::-1]
            settings = tables, camera.is_perspective, subdivisions
            found.append(sample_bounds(balls, lists.rank, window, footprint, edges, places, *settings))
        bounds = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *found)
        edges = borders[cell * CELL_SAMPLES + jnp.arange(CELL_SAMPLES + 1)]
        options = [_composited(bounds, edges, path, behind, level, form) for level in range(MAX_LEVEL + 1)]
        lo, hi = (jnp.stack(side) for side in zip(*options, strict=True))
        return _at(lo, levels[cell]), _at(hi, levels[cell])

    nothing = jnp.zeros((4, bundles), dtype)
    lo, hi = lax.fori_loop(0, num_cells, lambda n, behind: through_cell(num_cells - 1 - n, behind), (nothing, nothing))
    return BundleBounds(lo, hi)


def _at(options: Float[Array, "levels 4 bundles"], level: Int[Array, " bundles"]) -> Float[Array, "4 bundles"]:
    return jnp.take_along_axis(options, level[None, None], 0)[0]


def _composited(
    bounds: SampleBounds, edges: Array, path: tuple[Array, Array], behind: tuple[Array, Array], level: int, form: str
) -> tuple[Array, Array]:
    """What leaves a cell at one level for what arrives: back to front over its windows."""
    width = 1 << level
    lo, hi = behind
    rounding = DEPTH_ROUNDING * jnp.finfo(edges.dtype).eps
    outward = (EXPONENTIAL + COMPOSITING) * jnp.finfo(edges.dtype).eps
    for first in range(CELL_SAMPLES - width, -1, -width):
        part = slice(first, first + width)
        touched, depth = bounds.touched[part], edges[first + width] - edges[first]
        least = jnp.where(bounds.covered[part], bounds.lo[3][part], 0).min(0) * depth * path[0] * (1 - rounding)
        most = jnp.where(touched, bounds.hi[3][part], 0).max(0) * depth * path[1] * (1 + rounding)
        colors = [
            (jnp.where(touched, low[part], 1).min(0), jnp.where(touched, high[part], 0).max(0))
            for low, high in zip(bounds.lo[:3], bounds.hi[:3], strict=True)
        ]
        one = jnp.ones_like(least)
        low, high = (jnp.stack(side) for side in zip(*colors, (one, one), strict=True))
        clear, dim = jnp.exp(-least), jnp.exp(-most)
        if form == "lerp":
            lows, highs = ([c * (1 - t) + t * b for t in (clear, dim)] for c, b in ((low, lo), (high, hi)))
            new_lo, new_hi = jnp.minimum(*lows), jnp.maximum(*highs)
        else:
            new_lo, new_hi = low * (1 - clear) + dim * lo, high * (1 - dim) + clear * hi
        some = touched.any(0)
        lo = jnp.where(some, new_lo - outward, lo)
        hi = jnp.where(some, new_hi + outward, hi)
    return lo, hi


jax.tree_util.register_dataclass(BundleBounds, data_fields=["lo", "hi"], meta_fields=[])
