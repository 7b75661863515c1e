"""One depth-ordered list of particles for every ray bundle, from one sort.

Flow: view -> [lists] -> grid -> cast -> image.

Expanding to (particle, bundle) pairs and sorting them all is the bottleneck of a CPU, so the sort runs on the four times
coarser *tiles* of 2 x 2 bundles; each tile's sorted list is then split among its bundles by the exact sphere-against-pyramid
test, with prefix sums and a scatter that keep the order. Lists hold ranks, so they ascend by class and depth.

Memory that is touched for the first time costs more here than arithmetic. So flags are packed into words, whose prefix sums
are short, and what is as long as the pairs is made run by run.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxsph.engine.access.compaction import running_sum
from jaxsph.engine.access.view import ROUNDING, Spheres
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics import faults
from jaxsph.numerics.checks import require_sizes
from jaxsph.numerics.compiled import fusion_barrier
from jaxsph.numerics.trees import tree

MAX_EXACT = 1 << 22  # tiles of a band that float32 divides by columns without a mistake; whole numbers take longer
MAX_PAIRS = 2.0**30  # beyond this a 32-bit sum could wrap
WORD = 32  # flags in a word
BUNDLE = 8  # pixels on each side of a ray bundle (D_xy in Hochstetter et al. 2016)
TILE = 2 * BUNDLE


@dataclasses.dataclass(frozen=True)
class ListPlan:
    """Static sizes of the lists of one band of the image.

    Attributes:
        tile_rows, tile_columns: tiles of 16 x 16 pixels in a band.
        tile_capacity: (particle, tile) pairs that fit.
        list_capacity: (particle, bundle) pairs that fit.
        runs: sorts that the pairs are shared among, which run side by side.
    """

    tile_rows: int
    tile_columns: int
    tile_capacity: int
    list_capacity: int
    runs: int = 4

    def __post_init__(self) -> None:
        require_sizes(self)

    @property
    def num_tiles(self) -> int:
        """Tiles in a band."""
        return self.tile_rows * self.tile_columns

    @property
    def bundles(self) -> tuple[int, int]:
        """Rows and columns of bundles in a band."""
        return 2 * self.tile_rows, 2 * self.tile_columns

    @property
    def num_bundles(self) -> int:
        """Bundles in a band, four a tile; bundle ids are `4 * tile + 2 * lower + right`."""
        return 4 * self.num_tiles

    def as_image(self, value: Array) -> Array:
        """What bundles hold, (bundles, down, across, ...), side by side as they lie in the band."""
        down, across = value.shape[1:3]
        value = value.reshape(self.tile_rows, self.tile_columns, 2, 2, *value.shape[1:])
        value = jnp.moveaxis(value, (0, 2, 4, 1, 3, 5), (0, 1, 2, 3, 4, 5))
        return value.reshape(self.tile_rows * 2 * down, self.tile_columns * 2 * across, *value.shape[6:])

    def over_pixels(self, value: Shaped[Array, " bundles"]) -> Shaped[Array, "rows columns"]:
        """What each bundle holds, at each of its pixels, as they lie in the band."""
        return self.as_image(jnp.broadcast_to(value[:, None, None], (self.num_bundles, BUNDLE, BUNDLE)))


@tree()
class BundleLists:
    """Ranks of the particles that can touch each bundle: `rank[start[b] : end[b]]`, ascending.

    What `rank` holds past the last list is of no meaning.
    """

    rank: Int[Array, " pairs"]
    start: Int[Array, " bundles"]
    end: Int[Array, " bundles"]
    faults: Int[Array, ""]


def bundle_origins(plan: ListPlan, first_row: Int[Array, ""] | int) -> tuple[Array, Array]:
    """Pixel row and column of each bundle's upper left corner; `first_row` is the band's first pixel row."""
    bundle = jnp.arange(plan.num_bundles, dtype=jnp.int32)
    tile, child = bundle >> 2, bundle & 3
    row = (tile // plan.tile_columns) * TILE + (child >> 1) * BUNDLE + first_row
    column = (tile % plan.tile_columns) * TILE + (child & 1) * BUNDLE
    return row, column


def build_lists(ordered: Spheres, camera: Camera, plan: ListPlan, first_row: Int[Array, ""] | int) -> BundleLists:
    """The lists of all bundles of the band that starts at pixel row `first_row`; of a strided camera, by its nodes."""
    ranges = bundle_ranges(ordered, camera, plan, first_row)
    pairs = _tile_pairs(ranges, plan)

    def touched(pairs: tuple[Array, Array]) -> Int[Array, " pairs"]:
        rank, tile = pairs
        sphere = tuple(column[rank] for column in (ordered.x, ordered.y, ordered.z, ordered.reach))
        found = Ranges(*(side[rank] for side in (ranges.left, ranges.right, ranges.top, ranges.bottom)))
        tiles = jnp.arange(plan.num_tiles + 1, dtype=jnp.int32)  # tables, as integer division does not vectorise
        down, across = (place[tile] for place in (tiles // plan.tile_columns, tiles % plan.tile_columns))
        return jnp.where(tile < plan.num_tiles, touched_bundles(sphere, found, camera, first_row, down, across), 0)

    return _split(pairs, _run_by_run(pairs.start[0, 0] >= 0, touched, (pairs.rank, pairs.tile)), plan)


def nodes_between(first: Any, last: Any, size: int, stride: int) -> tuple[Any, Any]:
    """First and last node of those in a range of pixels; none where the range is empty, or lies between two nodes."""
    return -(-first // stride), last // stride + (first <= last) * (last == size - 1) * ((size - 1) % stride > 0)


def _run_by_run(always: Array, function: Callable[[Any], Array], runs: Any) -> Array:
    """`lax.map`; a result that XLA fuses with its being stored would be computed on one thread, so it is kept apart."""
    return lax.map(lambda run: fusion_barrier(always, function, run), runs)


@tree()
class Ranges:
    """Which bundles of a band each particle can touch: first, and past the last; none if `left >= right`."""

    left: Int[Array, " particles"]
    right: Int[Array, " particles"]
    top: Int[Array, " particles"]
    bottom: Int[Array, " particles"]


def bundle_ranges(ordered: Spheres, camera: Camera, plan: ListPlan, first_row: Int[Array, ""] | int) -> Ranges:
    """Bundle columns and rows, from the band's corner on, of the pixels (or a strided camera's nodes) that each can touch."""
    left, right, top, bottom = ordered.left, ordered.right, ordered.top, ordered.bottom
    if camera.stride > 1:
        left, right = nodes_between(left, right, camera.width, camera.stride)
        top, bottom = nodes_between(top, bottom, camera.height, camera.stride)
    top, bottom = jnp.maximum(top - first_row, 0), jnp.minimum(bottom - first_row, plan.tile_rows * TILE - 1)
    seen = (right >= left) & (bottom >= top)
    past = [jnp.where(seen, last // BUNDLE + 1, 0) for last in (right, bottom)]
    return Ranges(left // BUNDLE, past[0], top // BUNDLE, past[1])


@tree()
class _Pairs:
    """(Particle, tile) pairs in runs, each sorted by (tile, rank); a run's ranks all precede those of the next run.

    `start[run, tile]` is where a tile's pairs begin within the run; tile `num_tiles` collects unused slots.
    """

    rank: Int[Array, "runs slots"]
    tile: Int[Array, "runs slots"]
    start: Int[Array, "runs tiles_and_one"]
    faults: Int[Array, ""]


def _tile_pairs(ranges: Ranges, plan: ListPlan) -> _Pairs:
    """Expand particles to the tiles that they can touch, and sort by (tile, rank).

    Each run is sorted by itself through one packed key; XLA sorts them side by side.
    """
    words = plan.runs * -(-plan.tile_capacity // (plan.runs * WORD))
    rectangles = functools.partial(_rectangles, plan=plan, words=words)
    always = ranges.left[0] >= 0
    seen, last, total = fusion_barrier(always, rectangles, ranges)
    bits = max(ranges.left.shape[0] - 1, 1).bit_length()
    wide = bits + plan.num_tiles.bit_length() > 32
    used = jnp.minimum(total, plan.tile_capacity)
    flags = [value.reshape(plan.runs, -1) for value in (last, _flags_before(last), jnp.arange(words, dtype=jnp.int32) * WORD)]
    with jax.enable_x64(wide or jax.config.read("jax_enable_x64")):
        kind = jnp.uint64 if wide else jnp.uint32

        def packed(flags: list[Array]) -> Array:
            """Tile and rank of each slot of a run."""
            last, before, slot = (value[:, None] for value in flags)
            lane = jnp.arange(WORD, dtype=jnp.int32)
            nth = _set_before(last, before, lane).ravel()
            slot = (slot + lane).ravel()
            rank, begin, corner, columns = (column[nth] for column in seen)
            if plan.num_tiles < MAX_EXACT:
                row = (((slot - begin).astype(jnp.float32) + 0.5) / columns.astype(jnp.float32)).astype(jnp.int32)
            else:
                row = (slot - begin) // columns
            tile = corner + row * (plan.tile_columns - columns) + slot - begin
            return (jnp.where(slot < used, tile, plan.num_tiles).astype(kind) << bits) | rank.astype(kind)

        key = _run_by_run(always, packed, flags)
        key = jnp.stack([lax.sort(key[run]) for run in range(plan.runs)])
        rank = (key & kind((1 << bits) - 1)).astype(jnp.int32)
        tile = (key >> bits).astype(jnp.uint16 if plan.num_tiles < 1 << 16 else jnp.int32)
    wanted = jnp.arange(plan.num_tiles + 1, dtype=tile.dtype)
    start = jax.vmap(lambda run: jnp.searchsorted(run, wanted))(tile).astype(jnp.int32)
    overflow = faults.raised(faults.TILE_OVERFLOW, (total < 0) | (total > plan.tile_capacity))
    return _Pairs(rank, tile, start, overflow)


def _rectangles(ranges: Ranges, *, plan: ListPlan, words: int) -> tuple[tuple[Array, ...], Array, Array]:
    """Particles that can touch a tile: (rank, first slot, first tile, columns), flags of their last slots, slots in all.

    The slots in all are as in `counted`.
    """
    num_particles = ranges.left.shape[0]
    left, top = ranges.left >> 1, ranges.top >> 1
    columns = jnp.where(ranges.right > ranges.left, ((ranges.right + 1) >> 1) - left, 0)
    count = columns * (((ranges.bottom + 1) >> 1) - top)
    end, nth = running_sum(count), running_sum((count > 0).astype(jnp.int32))
    total = counted(count, end[-1])
    flag = jnp.where(count > 0, jnp.uint32(1) << ((end - 1) & (WORD - 1)).astype(jnp.uint32), 0)
    last = jnp.zeros(words, jnp.uint32).at[(end - 1) // WORD].add(flag, mode="drop")
    place = jnp.where(count > 0, nth - 1, num_particles)  # always in bounds, as a dropped entry is a branch mispredicted
    seen = jnp.zeros(num_particles + 1, jnp.int32).at[place].set(jnp.arange(num_particles, dtype=jnp.int32))
    first = (end - count, top * plan.tile_columns + left, columns)
    return (seen, *(column[seen] for column in first)), last, total


def counted(count: Int[Array, "*any"], total: Int[Array, ""]) -> Int[Array, ""]:
    """`total`, the sum of all `count` in 32 bits, where it cannot have wrapped; else -1.

    The sum in float32 tells the two apart but is itself good to some 1e-6 only, so it is not compared with any capacity.
    """
    return jnp.where(count.astype(jnp.float32).sum() < MAX_PAIRS, total, -1)


def _flags_before(word: Int[Array, "*some words"]) -> Int[Array, "*some words"]:
    """Flags that are set in the words before each."""
    number = lax.population_count(word).astype(jnp.int32)
    return running_sum(number) - number


def _set_before(word: Array, before: Array, lane: Array) -> Array:
    """Flags that are set before a flag: those before its word, and those in it."""
    return before + lax.population_count(word & ((jnp.uint32(1) << lane.astype(jnp.uint32)) - 1)).astype(jnp.int32)


def _split(pairs: _Pairs, touched: Int[Array, "runs slots"], plan: ListPlan) -> BundleLists:
    """Split each tile's pairs among its four bundles: lists are ordered by tile, bundle, run, rank."""
    runs, slots = touched.shape
    lane, child = jnp.arange(WORD, dtype=jnp.uint32), jnp.arange(4, dtype=jnp.uint32)[:, None, None]
    flag = (touched.reshape(-1, WORD).astype(jnp.uint32) >> child) & 1
    word = jnp.pad((flag << lane).sum(2, dtype=jnp.uint32), ((0, 0), (0, 1)))
    before = _flags_before(word)
    start = pairs.start + jnp.arange(runs, dtype=jnp.int32)[:, None] * slots
    at_start = _set_before(word[:, start // WORD], before[:, start // WORD], start % WORD)
    count = at_start[:, :, 1:] - at_start[:, :, :-1]
    begins = jnp.concatenate([jnp.zeros(1, jnp.int32), running_sum(jnp.moveaxis(count, 2, 0).ravel())])
    total = counted(count, begins[-1])
    overflow = pairs.faults | faults.raised(faults.LIST_OVERFLOW, (total < 0) | (total > plan.list_capacity))
    shift = jnp.moveaxis(begins[:-1].reshape(plan.num_tiles, 4, runs), 0, 2) - at_start[:, :, :-1]
    word, before = (value[:, :-1].reshape(4, runs, -1, 1) for value in (word, before))

    def place(run: Array, rank: Array) -> Array:
        tile = jnp.minimum(pairs.tile[run].astype(jnp.int32), plan.num_tiles - 1).reshape(-1, WORD)
        for child in range(4):
            flags = word[child, run]
            target = _set_before(flags, before[child, run], lane) + shift[child, run][tile]
            target = jnp.where((flags >> lane) & 1 > 0, target, plan.list_capacity)
            rank = rank.at[target.ravel()].set(pairs.rank[run], mode="drop")
        return rank

    # the last entry takes what belongs to no list: to drop half of the entries is to mispredict half of the branches
    rank = lax.fori_loop(0, runs, place, jnp.zeros(plan.list_capacity + 1, jnp.int32))
    borders = jnp.minimum(begins[::runs], plan.list_capacity)
    return BundleLists(rank, borders[:-1], borders[1:], overflow)


def touched_bundles(
    sphere: Iterable[Array], ranges: Ranges, camera: Camera, first_row: Any, down: Array, across: Array
) -> Int[Array, " pairs"]:
    """Bit `child` is set where a sphere (x, y, z, reach) meets the pyramid of rays of that bundle of a tile; all in one loop.

    Tiles are given by row and column in the band.
    """
    x, y, z, reach = sphere
    columns: list[tuple[Array, tuple[Array, Array]]] = []
    rows: list[tuple[Array, tuple[Array, Array]]] = []
    for half in range(2):
        place = 2 * across + half
        near, far = (camera.column(at).astype(x.dtype) for at in (place * BUNDLE + 0.5, place * BUNDLE + BUNDLE - 0.5))
        sides = side_distances(x, z, near, far, camera.is_perspective)
        columns.append(((ranges.left <= place) & (place < ranges.right), sides))
        place = 2 * down + half
        ends = place * BUNDLE + BUNDLE - 0.5 + first_row, place * BUNDLE + 0.5 + first_row
        low, high = (camera.row(at).astype(x.dtype) for at in ends)
        sides = side_distances(y, z, low, high, camera.is_perspective)
        rows.append(((ranges.top <= place) & (place < ranges.bottom), sides))
    size = jnp.abs(x) + jnp.abs(y) + jnp.abs(z) * (1 + camera.half_height)
    children = [(*columns[child & 1], *rows[child >> 1]) for child in range(4)]
    mask = jnp.zeros(x.shape, jnp.uint8)
    for child, (in_column, x_side, in_row, y_side) in enumerate(children):
        mask |= (in_column & in_row & touches(x_side, y_side, reach, size)).astype(jnp.uint8) << child
    return mask


def side_distances(
    x: Float[Array, "..."], z: Float[Array, "..."], low: Float[Array, "..."], high: Float[Array, "..."], perspective: bool
) -> tuple[Array, Array]:
    """Signed distance of (x, z) to the wedge of rays between coordinates `low` and `high`, and the normal's z-part.

    Positive outside. The nearer to being outside of the two planes is the one that counts.
    """
    if not perspective:
        outside = jnp.maximum(low - x, x - high)
        return outside, jnp.zeros_like(outside)
    low_norm, high_norm = 1 / jnp.sqrt(1 + low * low), 1 / jnp.sqrt(1 + high * high)
    below, above = (z * low - x) * low_norm, (x - z * high) * high_norm
    return jnp.maximum(below, above), jnp.where(below > above, low * low_norm, -high * high_norm)


def touches(
    x_side: tuple[Array, Array], y_side: tuple[Array, Array], reach: Float[Array, "..."], size: Float[Array, "..."]
) -> Bool[Array, "..."]:
    r"""Whether a sphere meets the pyramid of rays, given its distances to the two wedges.

    With unit normals $n_1, n_2$ of the two violated planes, $c = n_1 \cdot n_2$, distances $a \ge b$: the nearest point of plane
    one is $a$ away, and from there plane two is still $b - c a$ away along a direction of length $\sqrt{1 - c^2}$ a unit, so
    the distance is $\sqrt{a^2 + \max(b - c a, 0)^2 / (1 - c^2)}$. `size` bounds the coordinates, for the rounding: $b - c a$ is
    taken less and $1 - c^2$ more by what it can make of them. So no sphere that touches is left out, however wide the view:
    towards 180 degrees c tends to 1, both roundings to all there is, and the wedge that the sphere is farther from decides.
    """
    (dx, nx), (dy, ny) = x_side, y_side
    cosine, eps = nx * ny, jnp.finfo(reach.dtype).eps
    far, near = jnp.maximum(dx, dy), jnp.minimum(dx, dy)
    slack = eps * ROUNDING * size
    beyond = jnp.maximum(near - cosine * far - slack, 0)
    far = jnp.maximum(far, 0)
    limit = reach + slack
    return far * far + beyond * beyond / (1 - cosine * cosine + eps * ROUNDING) * (far > 0) <= limit * limit
