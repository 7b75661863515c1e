"""One depth-ordered list of particles for every ray bundle, from one sort.

Flow: ordering -> footprint -> [lists] -> cells -> cast -> image.

Expanding to (particle, bundle) pairs and sorting them all is the bottleneck of a CPU, so the sort runs on the four times
coarser *tiles* of 2 x 2 bundles; each tile's sorted list is then split among its bundles by the exact sphere-against-pyramid
test, with prefix sums and a scatter that keep the order. Lists hold ranks, so they ascend by class and depth.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.access.footprint import pixel_ranges, side_distances, touches
from jaxsph.access.ordering import Ordered
from jaxsph.model.camera import Camera
from jaxsph.numerics import faults
from jaxsph.numerics.staging import computed_once

MOST_PAIRS = 2.0**30  # beyond this a 32-bit sum could wrap
BUNDLE = 8  # pixels on each side of a ray bundle (D_xy in the first paper)
TILE = 2 * BUNDLE


@dataclasses.dataclass(frozen=True)
class ListPlan:
    """Static sizes of the lists of one band of the image.

    Attributes:
        tile_rows, tile_columns: tiles of 16 x 16 pixels in a band.
        tile_capacity: (particle, tile) pairs that fit.
        list_capacity: (particle, bundle) pairs that fit.
    """

    tile_rows: int
    tile_columns: int
    tile_capacity: int
    list_capacity: int

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if getattr(self, field.name) < 1:
                raise ValueError(f"`{field.name}` must be at least 1, got {getattr(self, field.name)}")

    @property
    def num_tiles(self) -> int:
        """Tiles in a band."""
        return self.tile_rows * self.tile_columns

    @property
    def num_bundles(self) -> int:
        """Bundles in a band, four a tile; bundle ids are `4 * tile + 2 * lower + right`."""
        return 4 * self.num_tiles


@dataclasses.dataclass(frozen=True)
class BundleLists:
    """Ranks of the particles that can touch each bundle: `rank[start[b] : start[b + 1]]`, ascending."""

    rank: Int[Array, " pairs"]
    start: Int[Array, " bundles_and_one"]
    faults: Int[Array, ""]


def bundle_origins(plan: ListPlan, first_row: Int[Array, ""] | int) -> tuple[Array, Array]:
    """Pixel row and column of each bundle's upper left corner; `first_row` is the band's first pixel row."""
    bundle = jnp.arange(plan.num_bundles, dtype=jnp.int32)
    tile, child = bundle >> 2, bundle & 3
    row = (tile // plan.tile_columns) * TILE + (child >> 1) * BUNDLE + first_row
    column = (tile % plan.tile_columns) * TILE + (child & 1) * BUNDLE
    return row, column


def bundle_ranges(
    ordered: Ordered, camera: Camera, depths: Float[Array, " samples"], plan: ListPlan, first_row: Int[Array, ""] | int
) -> tuple[Array, Array, Array, Array]:
    """First and last bundle column, first and last bundle row of the band that each particle can touch (first > last: none)."""
    left, right, top, bottom = pixel_ranges(ordered, camera, depths[0], depths[-1])
    top = jnp.maximum(top - first_row, 0)
    bottom = jnp.minimum(bottom - first_row, plan.tile_rows * TILE - 1)
    seen = (right >= left) & (bottom >= top)
    return left // BUNDLE, jnp.where(seen, right // BUNDLE, -1), top // BUNDLE, jnp.where(seen, bottom // BUNDLE, -1)


def build_lists(
    ordered: Ordered, camera: Camera, depths: Float[Array, " samples"], plan: ListPlan, first_row: Int[Array, ""] | int
) -> BundleLists:
    """The lists of all bundles of the band that starts at pixel row `first_row`."""
    ranges = bundle_ranges(ordered, camera, depths, plan, first_row)
    rank, tile, start, overflow = _tile_lists(ranges, plan)
    touch = functools.partial(_touched_children, plan=plan)
    touched = computed_once(start[-1] >= 0, touch, ordered, camera, first_row, ranges, rank, tile)
    return _split(plan, touched, rank, tile, start, overflow)


def _tile_lists(ranges: tuple[Array, ...], plan: ListPlan) -> tuple[Array, ...]:
    """Ranks sorted by (tile, rank), the tile of each, where each tile's ranks start, and a fault word."""
    left, right, top, bottom = (bundle >> 1 for bundle in ranges)
    columns, rows = jnp.where(right >= 0, right - left + 1, 0), bottom - top + 1
    count = columns * rows
    end = jnp.cumsum(count)
    total = jnp.where(count.astype(jnp.float32).sum() < MOST_PAIRS, end[-1], plan.tile_capacity + 1)
    overflow = faults.raised(faults.TILE_OVERFLOW, total > plan.tile_capacity)
    slots = jnp.arange(plan.tile_capacity, dtype=jnp.int32)
    particle = jnp.repeat(jnp.arange(count.shape[0], dtype=jnp.int32), count, total_repeat_length=plan.tile_capacity)
    within = slots - (end - count)[particle]
    # exact for fewer than 2^22 tiles a particle, which the image's largest size keeps
    row = ((within.astype(jnp.float32) + 0.5) / columns[particle].astype(jnp.float32)).astype(jnp.int32)
    tile = (top[particle] + row) * plan.tile_columns + left[particle] + within - row * columns[particle]
    tile = jnp.where(slots < total, tile, plan.num_tiles)
    return *_sort_pairs(tile, particle, plan.num_tiles, count.shape[0]), overflow


def _sort_pairs(tile: Array, rank: Array, num_tiles: int, num_particles: int) -> tuple[Array, Array, Array]:
    """Sort by (tile, rank) through one packed key, 32 bits wide where it fits."""
    bits = max(num_particles - 1, 1).bit_length()
    wide = bits + num_tiles.bit_length() > 32
    with jax.enable_x64(wide or jax.config.read("jax_enable_x64")):
        kind = jnp.uint64 if wide else jnp.uint32
        key = lax.sort((tile.astype(kind) << bits) | rank.astype(kind))
        rank = (key & kind((1 << bits) - 1)).astype(jnp.int32)
        tile = (key >> bits).astype(jnp.int32)
    start = jnp.searchsorted(tile, jnp.arange(num_tiles + 1, dtype=jnp.int32)).astype(jnp.int32)
    return rank, tile, start


def _split(plan: ListPlan, touched: Array, rank: Array, tile: Array, start: Array, overflow: Array) -> BundleLists:
    """Split each tile's list among its four bundles."""
    kept = [(touched >> child) & 1 for child in range(4)]
    before = [jnp.cumsum(flag) - flag for flag in kept]
    totals = [jnp.append(upto, upto[-1] + flag[-1]) for upto, flag in zip(before, kept, strict=True)]
    upto_tile = jnp.stack([upto[start] for upto in totals], 1)
    counts = (upto_tile[1:] - upto_tile[:-1]).reshape(-1)
    overflow |= faults.raised(faults.LIST_OVERFLOW, counts.astype(jnp.float32).sum() > plan.list_capacity)
    begins = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(counts)])
    shift = begins[:-1].reshape(-1, 4) - upto_tile[:-1]
    out = jnp.zeros(plan.list_capacity, jnp.int32)
    here = jnp.minimum(tile, plan.num_tiles - 1)
    for child in range(4):
        target = jnp.where(kept[child] > 0, before[child] + shift[:, child][here], plan.list_capacity)
        out = out.at[target].set(rank, mode="drop", unique_indices=True)
    return BundleLists(out, jnp.minimum(begins, plan.list_capacity), overflow)


def _touched_children(
    ordered: Ordered,
    camera: Camera,
    first_row: Any,
    ranges: tuple[Array, ...],
    rank: Array,
    tile: Array,
    *,
    plan: ListPlan,
) -> Int[Array, " pairs"]:
    """Bit `child` is set where the particle's sphere meets the pyramid of rays of that bundle of the pair's tile."""
    x, y, z, reach = (column[rank] for column in (ordered.x, ordered.y, ordered.z, ordered.reach))
    row, column = (tile // plan.tile_columns) * TILE + first_row, (tile % plan.tile_columns) * TILE
    sides: dict[str, list[tuple[Array, Array]]] = {"x": [], "y": []}
    for half in (0, BUNDLE):
        u = (
            camera.column(column + half + 0.5).astype(x.dtype),
            camera.column(column + half + BUNDLE - 0.5).astype(x.dtype),
        )
        v = (camera.row(row + half + BUNDLE - 0.5).astype(x.dtype), camera.row(row + half + 0.5).astype(x.dtype))
        sides["x"].append(side_distances(x, z, *u, camera.is_perspective))
        sides["y"].append(side_distances(y, z, *v, camera.is_perspective))
    size = jnp.abs(x) + jnp.abs(y) + jnp.abs(z) * (1 + camera.half_height)
    left, right, top, bottom = (bound[rank] for bound in ranges)
    mask = jnp.zeros_like(rank)
    for child in range(4):
        across, down = 2 * (tile % plan.tile_columns) + (child & 1), 2 * (tile // plan.tile_columns) + (child >> 1)
        inside = (left <= across) & (across <= right) & (top <= down) & (down <= bottom)
        touched = inside & touches(sides["x"][child & 1], sides["y"][child >> 1], reach, size)
        mask |= touched.astype(jnp.int32) << child
    return jnp.where(tile < plan.num_tiles, mask, 0)


jax.tree_util.register_dataclass(BundleLists, data_fields=["rank", "start", "faults"], meta_fields=[])
