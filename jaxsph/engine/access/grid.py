"""The sparse perspective grid of a band of the image: for every slab of a bundle, the windows of its list that can touch it.

Flow: view -> lists -> [grid] -> control, schedule, cast.

A slab is some samples of all rays of a bundle, a cell as many slabs as have `CELL_SAMPLES` samples. Nothing is copied along
depth: a particle that touches ten slabs of a bundle is listed once and lies in ten windows. There is a window for each class
of supports.

On CPUs XLA splits every kernel among its threads, but those of a chunk of slabs are over before that pays: two threads were 1.1
to 1.3 times as fast as one, two programs side by side 1.9 times. So bundles are dealt out like cards, that each shard of a band
has about as much to do wherever the fluid is, and is a run of the same program. What a bundle's rays meet does not depend on what
it is marched with, so the image is the same bit for bit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Shaped

from jaxsph.engine.access.lists import BUNDLE, BundleLists
from jaxsph.engine.access.view import Ordered
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.compiled import fusion_barrier
from jaxsph.numerics.trees import tree

MAX_LEVEL = 4  # at which a cell has one sample
CELL_SAMPLES = 1 << MAX_LEVEL  # fine samples of a cell along depth: D_z of Hochstetter et al. 2016
Found = TypeVar("Found")


@tree()
class SlabWindows:
    """Windows `rank[begin : begin + length]` of a bundle's list, and their sum over classes.

    A slab with `count` 0 is empty: no particle can touch it.
    """

    begin: Int[Array, "classes slabs bundles"]
    length: Int[Array, "classes slabs bundles"]
    count: Int[Array, "slabs bundles"]


def find_slab_windows(ordered: Ordered, lists: BundleLists, beside: bool) -> SlabWindows:
    """Bisect every bundle's list for the first and last rank of every slab and class.

    `beside`: of slabs with all that lies between their samples and those of the next, for samples of any spacing.
    """
    first, last = (ordered.first_beside, ordered.last_beside) if beside else (ordered.first_rank, ordered.last_rank)
    wanted = jnp.stack([first, last])

    def of_class(nth: Array, found: Array) -> Array:
        return found.at[:, nth].set(_bisect(lists.rank, wanted[:, nth], lists.start, lists.end))

    if (classes := first.shape[0]) == 1:
        begin, end = _bisect(lists.rank, wanted, lists.start, lists.end)
    else:  # classes that nobody is in cost nothing
        used = jnp.max(jnp.where((first < last).any(1), jnp.arange(1, classes + 1, dtype=jnp.int32), 0))
        begin, end = lax.fori_loop(0, used, of_class, jnp.zeros((*wanted.shape, lists.start.shape[0]), jnp.int32))
    length = jnp.maximum(end - begin, 0)
    return SlabWindows(begin, length, length.sum(0, dtype=jnp.int32))


def coarser_windows(cells: SlabWindows) -> list[SlabWindows]:
    """Unions of the windows of 1, 2, 4, 8 and 16 slabs; the number of slabs is rounded up to a multiple of 16."""
    missing = (0, -cells.count.shape[0] % (1 << MAX_LEVEL)), (0, 0)
    begin, length = (jnp.pad(value, ((0, 0), *missing)) for value in (cells.begin, cells.length))
    windows = [SlabWindows(begin, length, jnp.pad(cells.count, missing))]
    for _ in range(MAX_LEVEL):
        first = jnp.where(length > 0, begin, jnp.iinfo(begin.dtype).max)
        end = jnp.where(length > 0, begin + length, 0)
        first = jnp.minimum(first[:, ::2], first[:, 1::2])
        length = jnp.maximum(jnp.maximum(end[:, ::2], end[:, 1::2]) - first, 0)
        begin = jnp.where(length > 0, first, 0)
        windows.append(SlabWindows(begin, length, length.sum(0, dtype=jnp.int32)))
    return windows


def slabs_with(grid: Grid, spheres: slice) -> Bool[Array, "slabs bundles"]:
    """Slabs whose windows hold any of some spheres, by their numbers in the scene: in others a medium of these meets none."""
    wanted = jnp.zeros(grid.ordered.index.shape, bool).at[spheres].set(True)[grid.ordered.index[grid.lists.rank]]
    before = jnp.pad(jnp.cumsum(wanted, dtype=jnp.int32), (1, 0))
    begin = grid.windows.begin
    return (before[begin + grid.windows.length] > before[begin]).any(0)


def by_cell(value: Array, slab_samples: int, past: Any = 0) -> Shaped[Array, "*any cells slabs_of_a_cell bundles"]:
    """What slabs hold, cell by cell; the last is filled up with what is `past` the last slab."""
    *more, slabs, bundles = value.shape
    per_cell = CELL_SAMPLES // slab_samples
    padding = [(0, 0)] * len(more) + [(0, -slabs % per_cell), (0, 0)]
    return jnp.pad(value, padding, constant_values=past).reshape(*more, -1, per_cell, bundles)


def by_slab(value: Shaped[Array, "*any slabs_of_a_cell cells bundles"]) -> Shaped[Array, "*any slabs bundles"]:
    """What the slabs of cells hold, one slab of a ray behind the other."""
    *more, per_cell, cells, bundles = value.shape
    return value.swapaxes(-3, -2).reshape(*more, cells * per_cell, bundles)


def whole_cells(slabs: Bool[Array, "slabs bundles"], slab_samples: int) -> Bool[Array, "cells bundles"]:
    """Cells all of whose slabs are marked."""
    return by_cell(slabs, slab_samples, True).all(1)


def _bisect(rank: Array, wanted: Array, low: Array, high: Array) -> Array:
    """First position in `[low, high)` of each bundle's list with `rank >= wanted`, for all (end, class, slab).

    By steps of powers of two from `low`, as long as all that is stepped over is smaller: one array goes round the loop, where
    of two ends XLA copies both in every turn.
    """
    bits = 32 - lax.clz((high - low).max(initial=0))
    wanted = wanted[..., None]

    def step(turn: Array, position: Array) -> Array:
        past = position + (1 << (bits - 1 - turn))
        smaller = rank[jnp.minimum(past, rank.shape[0]) - 1] < wanted
        return jnp.where((past <= high) & smaller, past, position)

    return lax.fori_loop(0, bits, step, jnp.broadcast_to(low, (*wanted.shape[:-1], low.shape[0])))


@tree()
class SlabExtents:
    """The least and the greatest view coordinate of any point of a slab that a ray of its bundle can pass."""

    x_lower: Float[Array, "slabs bundles"]
    x_upper: Float[Array, "slabs bundles"]
    y_lower: Float[Array, "slabs bundles"]
    y_upper: Float[Array, "slabs bundles"]
    z_lower: Float[Array, "slabs bundles"]
    z_upper: Float[Array, "slabs bundles"]

    def distance_to(self, x: Array, y: Array, z: Array) -> Float[Array, "slabs bundles"]:
        """From a point to the nearest of each box."""
        sides = ((x, self.x_lower, self.x_upper), (y, self.y_lower, self.y_upper), (z, self.z_lower, self.z_upper))
        off = [jnp.maximum(jnp.maximum(lower - place, place - upper), 0) for place, lower, upper in sides]
        return jnp.sqrt(off[0] ** 2 + off[1] ** 2 + off[2] ** 2)


def slab_extents(grid: Grid, camera: Camera, slab_samples: int, fringe: float = 0) -> SlabExtents:
    """Boxes of all slabs of a band or of a shard of it, and of rays so many pixels beside theirs."""
    slabs, bundles = grid.windows.count.shape
    borders = grid.borders(slabs * slab_samples)
    front, back = borders[:-1:slab_samples, None], borders[slab_samples::slab_samples, None]
    u, v = grid.rays(camera, jnp.arange(bundles, dtype=jnp.int32))

    def sides(rays: Array) -> tuple[Array, Array]:
        lower, upper = rays.min(0), rays.max(0)
        if fringe:
            beside = 2 * fringe / camera.height * camera.half_height
            lower, upper = lower - beside, upper + beside
        if not camera.is_perspective:
            return (jnp.broadcast_to(side, (slabs, bundles)) for side in (lower, upper))  # type: ignore[return-value]
        return jnp.minimum(lower * front, lower * back), jnp.maximum(upper * front, upper * back)

    depths = (jnp.broadcast_to(side, (slabs, bundles)) for side in (front, back))
    return SlabExtents(*sides(u), *sides(v), *depths)


def shard(tree: Any, nth: Int[Array, ""] | int, shards: int) -> Any:
    """Of arrays whose last axis is bundles, every `shards`-th from the `nth` on."""
    if shards == 1:
        return tree
    return jax.tree.map(lambda value: value.reshape(*value.shape[:-1], -1, shards)[..., nth], tree)


def unshard(shards: tuple[Any, ...], axis: int = -1) -> Any:
    """All bundles again, of those that were dealt out along an axis."""
    if len(shards) == 1:
        return shards[0]

    def mixed(*values: Array) -> Array:
        place, shape = axis % values[0].ndim, values[0].shape
        return jnp.stack(values, place + 1).reshape(*shape[:place], -1, *shape[place + 1 :])

    return jax.tree.map(mixed, *shards)


def shard_of_grid(grid: Grid, nth: Int[Array, ""] | int, shards: int) -> Grid:
    """The grid of every `shards`-th bundle from the `nth` on."""
    return grid.with_bundles(shard(grid.bundles, nth, shards))


def some_of_grid(grid: Grid, at: Int[Array, " some"], real: Bool[Array, " some"]) -> Grid:
    """The grid of some bundles, those that are not real without particles."""
    some = jax.tree.map(lambda value: value[..., at], grid.bundles)
    windows = some[0]
    length, count = (jnp.where(real, value, 0) for value in (windows.length, windows.count))
    return grid.with_bundles((SlabWindows(windows.begin, length, count), *some[1:]))


def over_bundles(function: Callable[[Any], Found], of_bundles: Any, size: int) -> Found:
    """Call `function` with `size` bundles at a time, of those filled up with zeros; the last axis of all arrays is bundles."""
    bundles = jax.tree.leaves(of_bundles)[0].shape[-1]
    if bundles <= size:
        return function(of_bundles)

    def some(nth: Array | int) -> Any:
        return jax.tree.map(lambda value: lax.dynamic_slice_in_dim(value, nth * size, size, -1), of_bundles)

    def turn(nth: Array, found: Found) -> Found:
        own = fusion_barrier(nth >= 0, function, some(nth))
        return jax.tree.map(lambda of, new: lax.dynamic_update_slice_in_dim(of, new, nth * size, -1), found, own)

    missing = -bundles % size
    if missing:
        of_bundles = jax.tree.map(lambda value: jnp.pad(value, [(0, 0)] * (value.ndim - 1) + [(0, missing)]), of_bundles)
    shapes = jax.eval_shape(lambda: function(some(0)))
    nothing = jax.tree.map(lambda leaf: jnp.zeros((*leaf.shape[:-1], bundles + missing), leaf.dtype), shapes)
    found = lax.fori_loop(0, (bundles + missing) // size, turn, nothing)
    return jax.tree.map(lambda value: value[..., :bundles], found)  # type: ignore[no-any-return]


@tree()
class Grid:
    """Particles by rank, the lists of all bundles, and the windows of all slabs.

    Attributes:
        row, column: pixel row and column of each bundle's upper left corner.
        half_steps: view depths s(0), s(1/2), s(1), ... s(N), length units: borders of the fine samples at the even entries,
            the samples between.
    """

    ordered: Ordered
    lists: BundleLists
    windows: SlabWindows
    row: Int[Array, " bundles"]
    column: Int[Array, " bundles"]
    half_steps: Float[Array, " two_samples_and_one"]

    @property
    def bundles(self) -> tuple[SlabWindows, Array, Array, Array, Array]:
        """All arrays whose last axis is bundles."""
        return self.windows, self.row, self.column, self.lists.start, self.lists.end

    def with_bundles(self, bundles: tuple[SlabWindows, Array, Array, Array, Array]) -> Grid:
        """The grid of other bundles, see `bundles`."""
        windows, row, column, start, end = bundles
        lists = dataclasses.replace(self.lists, start=start, end=end)
        return dataclasses.replace(self, lists=lists, windows=windows, row=row, column=column)

    @property
    def samples(self) -> int:
        """Fine samples N of a ray."""
        return self.half_steps.shape[0] // 2

    def borders(self, samples: int) -> Float[Array, " samples_and_one"]:
        """Depths of the borders of `samples` fine samples; those past the last have length zero."""
        return jnp.pad(self.half_steps[::2], (0, samples - self.samples), mode="edge")

    def rays(self, camera: Camera, bundle: Int[Array, " n"]) -> tuple[Float[Array, "8 n"], Float[Array, "8 n"]]:
        """Ray coordinates of the pixel columns and, descending, of the pixel rows of bundles."""
        pixel, dtype = jnp.arange(BUNDLE, dtype=jnp.int32)[:, None], self.half_steps.dtype
        u = camera.column((self.column[bundle] + pixel).astype(dtype) + 0.5)
        return u, camera.row((self.row[bundle] + pixel).astype(dtype) + 0.5)
