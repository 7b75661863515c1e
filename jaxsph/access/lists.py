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
RUNS = 16  # sorts that run side by side
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


def build_lists(
    ordered: Ordered, camera: Camera, depths: Float[Array, " samples"], plan: ListPlan, first_row: Int[Array, ""] | int
) -> BundleLists:
    """The lists of all bundles of the band that starts at pixel row `first_row`."""
    ranges = bundle_ranges(ordered, camera, depths, plan, first_row)
    pairs = _tile_pairs(ranges, plan)
    touch = functools.partial(_touched_children, plan=plan)
    touched = computed_once(pairs.start[0, 0] >= 0, touch, ordered, camera, first_row, ranges, pairs)
    return _split(pairs, touched, plan)


@dataclasses.dataclass(frozen=True)
class Ranges:
    """Which bundles of a band each particle can touch: first, and past the last; none if `left >= right`."""

    left: Int[Array, " particles"]
    right: Int[Array, " particles"]
    top: Int[Array, " particles"]
    bottom: Int[Array, " particles"]


def bundle_ranges(
    ordered: Ordered, camera: Camera, depths: Float[Array, " samples"], plan: ListPlan, first_row: Int[Array, ""] | int
) -> Ranges:
    """Bundle columns and rows, counted from the band's corner, of the pixels that each particle can touch."""
    left, right, top, bottom = pixel_ranges(ordered, camera, depths[0], depths[-1])
    top = jnp.maximum(top - first_row, 0)
    bottom = jnp.minimum(bottom - first_row, plan.tile_rows * TILE - 1)
    seen = (right >= left) & (bottom >= top)
    past = [jnp.where(seen, last // BUNDLE + 1, 0) for last in (right, bottom)]
    return Ranges(left // BUNDLE, past[0], top // BUNDLE, past[1])


@dataclasses.dataclass(frozen=True)
class _Pairs:
    """(Particle, tile) pairs in runs, each sorted by (tile, rank); a run's ranks all precede those of the next run.

    `start[run, tile]` is where a run's pairs of a tile begin; tile `num_tiles` collects unused slots.
    """

    rank: Int[Array, " pairs"]
    tile: Int[Array, " pairs"]
    run: Int[Array, " pairs"]
    start: Int[Array, "runs tiles_and_one"]
    faults: Int[Array, ""]


def _tile_pairs(ranges: Ranges, plan: ListPlan) -> _Pairs:
    """Expand particles to the tiles that they can touch."""
    capacity, num_particles = plan.tile_capacity, ranges.left.shape[0]
    left, top = ranges.left >> 1, ranges.top >> 1
    columns = jnp.where(ranges.right > ranges.left, ((ranges.right + 1) >> 1) - left, 0)
    count = columns * (((ranges.bottom + 1) >> 1) - top)
    end = lax.associative_scan(jnp.add, count)
    total = jnp.where(count.astype(jnp.float32).sum() < MOST_PAIRS, end[-1], capacity + 1)
    slots = jnp.arange(capacity, dtype=jnp.int32)
    begin = jnp.where(count > 0, end - count, capacity)
    particle = jnp.zeros(capacity, jnp.int32).at[begin].set(jnp.arange(num_particles, dtype=jnp.int32), mode="drop")
    particle = lax.associative_scan(jnp.maximum, particle)
    within = slots - begin[particle]
    # exact for fewer than 2^22 tiles a particle, which the image's largest size keeps
    row = ((within.astype(jnp.float32) + 0.5) / columns[particle].astype(jnp.float32)).astype(jnp.int32)
    tile = (top * plan.tile_columns + left)[particle] + row * (plan.tile_columns - columns[particle]) + within
    tile = jnp.where(slots < total, tile, plan.num_tiles)
    overflow = faults.raised(faults.TILE_OVERFLOW, total > capacity)
    return _sorted_runs(tile, particle, plan, num_particles, overflow)


def _sorted_runs(tile: Array, rank: Array, plan: ListPlan, num_particles: int, overflow: Array) -> _Pairs:
    """Sort by (tile, rank) through one packed key, in runs that are independent, so that XLA sorts them side by side."""
    bits = max(num_particles - 1, 1).bit_length()
    wide = bits + plan.num_tiles.bit_length() > 32
    runs = RUNS if plan.tile_capacity % RUNS == 0 else 1
    with jax.enable_x64(wide or jax.config.read("jax_enable_x64")):
        kind = jnp.uint64 if wide else jnp.uint32
        key = (tile.astype(kind) << bits) | rank.astype(kind)
        key = jnp.concatenate([lax.sort(part) for part in jnp.split(key, runs)])
        rank = (key & kind((1 << bits) - 1)).astype(jnp.int32)
        tile = (key >> bits).astype(jnp.int32)
    wanted = jnp.arange(plan.num_tiles + 1, dtype=jnp.int32)
    starts = jax.vmap(lambda part: jnp.searchsorted(part, wanted))(tile.reshape(runs, -1)).astype(jnp.int32)
    length = plan.tile_capacity // runs
    run = jnp.arange(plan.tile_capacity, dtype=jnp.int32) // length
    return _Pairs(rank, tile, run, starts + jnp.arange(runs, dtype=jnp.int32)[:, None] * length, overflow)


def _split(pairs: _Pairs, touched: Int[Array, " pairs"], plan: ListPlan) -> BundleLists:
    """Split each tile's pairs among its four bundles: lists are ordered by tile, bundle, run, rank."""
    counts, befores = [], []
    for child in range(4):
        flag = (touched >> child) & 1
        upto = lax.associative_scan(jnp.add, flag)
        at_start = jnp.where(pairs.start > 0, upto[jnp.maximum(pairs.start - 1, 0)], 0)
        counts.append(at_start[:, 1:] - at_start[:, :-1])
        befores.append((upto - flag, at_start[:, :-1]))
    count = jnp.stack(counts, 2)
    ordered_count = jnp.moveaxis(count, 0, 2).reshape(-1)
    overflow = pairs.faults | faults.raised(faults.LIST_OVERFLOW, count.astype(jnp.float32).sum() > plan.list_capacity)
    begins = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(ordered_count)])
    runs = count.shape[0]
    run_begins = jnp.moveaxis(begins[:-1].reshape(plan.num_tiles, 4, runs), 2, 0)
    rank = jnp.zeros(plan.list_capacity, jnp.int32)
    segment = pairs.run * plan.num_tiles + jnp.minimum(pairs.tile, plan.num_tiles - 1)
    for child, (before, at_start) in enumerate(befores):
        shift = (run_begins[:, :, child] - at_start).reshape(-1)
        target = jnp.where((touched >> child) & 1 > 0, before + shift[segment], plan.list_capacity)
        rank = rank.at[target].set(pairs.rank, mode="drop", unique_indices=True)
    return BundleLists(rank, jnp.minimum(begins[::runs], plan.list_capacity), overflow)


def _touched_children(
    ordered: Ordered, camera: Camera, first_row: Any, ranges: Ranges, pairs: _Pairs, *, plan: ListPlan
) -> Int[Array, " pairs"]:
    """Bit `child` is set where the particle's sphere meets the pyramid of rays of that bundle of the pair's tile."""
    rank = pairs.rank
    x, y, z, reach = (column[rank] for column in (ordered.x, ordered.y, ordered.z, ordered.reach))
    tiles = jnp.arange(plan.num_tiles + 1, dtype=jnp.int32)  # tables, as integer division does not vectorise
    down, across = ((2 * place)[pairs.tile] for place in (tiles // plan.tile_columns, tiles % plan.tile_columns))
    columns: list[tuple[Array, tuple[Array, Array]]] = []
    rows: list[tuple[Array, tuple[Array, Array]]] = []
    for half in range(2):
        near, far = (across + half) * BUNDLE + 0.5, (across + half) * BUNDLE + BUNDLE - 0.5
        sides = side_distances(x, z, _of(x, camera.column(near)), _of(x, camera.column(far)), camera.is_perspective)
        columns.append(((ranges.left[rank] <= across + half) & (across + half < ranges.right[rank]), sides))
        high, low = (down + half) * BUNDLE + 0.5 + first_row, (down + half) * BUNDLE + BUNDLE - 0.5 + first_row
        sides = side_distances(y, z, _of(x, camera.row(low)), _of(x, camera.row(high)), camera.is_perspective)
        rows.append(((ranges.top[rank] <= down + half) & (down + half < ranges.bottom[rank]), sides))
    size = jnp.abs(x) + jnp.abs(y) + jnp.abs(z) * (1 + camera.half_height)
    mask = jnp.zeros_like(rank)
    for child in range(4):
        (inside_column, x_side), (inside_row, y_side) = columns[child & 1], rows[child >> 1]
        touched = inside_column & inside_row & touches(x_side, y_side, reach, size)
        mask |= touched.astype(jnp.int32) << child
    return jnp.where(pairs.tile < plan.num_tiles, mask, 0)


def _of(like: Array, value: Array) -> Array:
    return value.astype(like.dtype)


for _kind in (BundleLists, Ranges, _Pairs):
    jax.tree_util.register_dataclass(_kind, data_fields=[field.name for field in dataclasses.fields(_kind)], meta_fields=[])
