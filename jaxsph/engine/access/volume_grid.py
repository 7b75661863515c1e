"""A volume as a camera sees it: where its grid lies in view space, what it is between grid points, and where it is empty.

Flow: volume, camera, transfer function -> [volume grid] -> media -> schedule.

A macrocell is `MACROCELL` grid cells along each axis, with the points on all of its faces: what is trilinear between grid points
stays between the least and the greatest of them. How many macrocells of a box are occupied follows from eight entries of their
running sums, however large the box is.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Num

from jaxsph.engine.access.compaction import running_sum
from jaxsph.engine.access.grid import SlabExtents
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import ROUNDING, heights
from jaxsph.model.transfer.function import EVEN, SELECT_ALL, TransferFunction, look_up
from jaxsph.model.volume import Volume
from jaxsph.numerics.compiled import greater, lesser
from jaxsph.numerics.trees import tree

MACROCELL = 4
Reduction = Callable[..., Array]
ROUNDING_BETWEEN = 8  # eps that interpolation between two values, or their look-up, may be off by
PAIRS = lax.GatherDimensionNumbers(offset_dims=(3,), collapsed_slice_dims=(), start_index_map=(0,))


@tree()
class MacrocellRanges:
    """The least and the greatest value at the grid points of each macrocell."""

    lo: Num[Array, "bx by bz"]
    hi: Num[Array, "bx by bz"]

    @classmethod
    def of(cls, values: Num[Array, "nx ny nz"]) -> MacrocellRanges:
        """Of the values of a grid that are not NaN; the least is above the greatest where all of a macrocell are."""
        values = lax.stop_gradient(values)
        lo, hi = (jnp.where(jnp.isnan(values), nothing, values).astype(values.dtype) for nothing in (jnp.inf, -jnp.inf))
        for axis in range(3):
            lo, hi = _reduced(lo, jnp.minimum, jnp.min, axis), _reduced(hi, jnp.maximum, jnp.max, axis)
        return cls(lo, hi)

    def finite(self) -> Bool[Array, ""]:
        """Whether all values are, or NaN."""
        return ((jnp.isfinite(self.lo) & jnp.isfinite(self.hi)) | (self.lo > self.hi)).all()

    def widened(self, dtype: jnp.dtype) -> tuple[Float[Array, "bx by bz"], Float[Array, "bx by bz"]]:
        """The range of what is interpolated with rounding; equal values are interpolated exactly."""
        lo, hi = self.lo.astype(dtype), self.hi.astype(dtype)
        off = jnp.where(lo < hi, ROUNDING_BETWEEN * jnp.finfo(dtype).eps * jnp.maximum(jnp.abs(lo), jnp.abs(hi)), 0)
        return lo - off, hi + off

    def holding(self, level: Float[Array, ""]) -> Bool[Array, "bx by bz"]:
        """Macrocells that reach a level."""
        lo, hi = self.widened(level.dtype)
        return (lo <= level) & (level <= hi)

    def shown_by(self, transfer: TransferFunction) -> Bool[Array, "bx by bz"]:
        """Macrocells in which a transfer function gives extinction > 0: at an end of the range, or at a control point in it."""
        values = transfer.values
        lo, hi = self.widened(values.dtype)
        if values.shape[0] > SELECT_ALL:  # evenly spaced points are met to a few eps of their range; the outermost exactly
            off = 2 * EVEN * jnp.finfo(values.dtype).eps * jnp.abs(values).max()
            lo = jnp.where((lo > values[0]) & (lo < values[-1]), lo - off, lo)
            hi = jnp.where((hi > values[0]) & (hi < values[-1]), hi + off, hi)
        up_to = jnp.concatenate([jnp.zeros(1, jnp.int32), running_sum((transfer.extinction > 0).astype(jnp.int32))])
        method = "compare_all" if values.shape[0] <= SELECT_ALL else "scan"  # as look-ups do
        first = jnp.searchsorted(values, lo, side="left", method=method)
        last = jnp.searchsorted(values, hi, side="right", method=method)
        segments = transfer.segments()
        at_ends = (look_up(segments, lo)[3] > 0) | (look_up(segments, hi)[3] > 0)
        return (at_ends | (up_to[last] > up_to[first])) & (lo <= hi)


def counted(occupied: Bool[Array, "bx by bz"]) -> Int[Array, "bx_and_one by_and_one bz_and_one"]:
    """How many occupied macrocells lie before each corner of a macrocell."""
    count = jnp.pad(occupied.astype(jnp.int32), ((1, 0),) * 3)
    for axis in range(3):
        count = running_sum(count, axis)
    return count


def _reduced(values: Array, of_two: Reduction, of_all: Reduction, axis: int) -> Array:
    """Least or greatest of the points of macrocells along an axis, both ends included."""
    points, before_axis, behind = values.shape[axis], values.shape[:axis], values.shape[axis + 1 :]
    number = -(-(points - 1) // MACROCELL)
    last = lax.slice_in_dim(values, points - 1, points, axis=axis)
    missing = number * MACROCELL + 1 - points
    padded = jnp.concatenate([values, *[last] * missing], axis) if missing else values
    own = lax.slice_in_dim(padded, 0, number * MACROCELL, axis=axis).reshape(*before_axis, number, MACROCELL, *behind)
    of_next = lax.slice_in_dim(padded, MACROCELL, number * MACROCELL + 1, MACROCELL, axis)
    return of_two(of_all(own, axis=axis + 1), of_next)


@tree()
class VolumeGrid:
    """Values on a grid in view space. Grid coordinates count in cells: the points are where all three are whole numbers.

    Attributes:
        values: at the grid points.
        origin: view coordinates of the point (0, 0, 0), length units.
        cells: rows: grid coordinates x, y and z that one length unit along each view axis takes.
    """

    values: Num[Array, "nx ny nz"]
    origin: Float[Array, "3"]
    cells: Float[Array, "3 3"]

    @classmethod
    def seen(cls, volume: Volume, camera: Camera) -> VolumeGrid:
        """In the view space of a camera."""
        dtype = jnp.promote_types(volume.dtype, camera.dtype)
        origin = camera.to_view(volume.lower.astype(dtype), volume.lower_rest.astype(dtype))
        return cls(volume.values, origin.astype(dtype), (camera.axes.T / volume.spacing[:, None]).astype(dtype))

    def holding(self, values: Num[Array, "nx ny nz"] | None) -> VolumeGrid:
        """The same place with other values, or with none."""
        return dataclasses.replace(self, values=jnp.zeros((0, 0, 0), self.values.dtype) if values is None else values)

    def coordinates(self, place: tuple[Float[Array, "..."], ...]) -> list[Float[Array, "..."]]:
        """Grid coordinates of view coordinates."""
        away = [at - zero for at, zero in zip(place, self.origin, strict=True)]
        return [row[0] * away[0] + row[1] * away[1] + row[2] * away[2] for row in self.cells]

    def rounding(self, place: tuple[Float[Array, "..."], ...]) -> list[Float[Array, "..."]]:
        """How far computed grid coordinates of view coordinates may be off, in cells."""
        eps = ROUNDING * jnp.finfo(self.origin.dtype).eps
        x, y, z = (eps * (jnp.abs(at) + jnp.abs(zero)) for at, zero in zip(place, self.origin, strict=True))
        return [row[0] * x + row[1] * y + row[2] * z for row in jnp.abs(self.cells)]

    def directions(self, gradient: list[Float[Array, "..."]]) -> list[Float[Array, "..."]]:
        """View coordinates of the gradient of a field, from what it rises along each axis of the grid a cell."""
        return [sum(row[k] * part for row, part in zip(self.cells, gradient, strict=True)) for k in range(3)]  # type: ignore[misc]

    def inside(self, coordinates: list[Float[Array, "..."]]) -> Bool[Array, "..."]:
        """Whether points lie in the box of the grid."""
        within = [(at >= 0) & (at <= points - 1) for at, points in zip(coordinates, self.values.shape, strict=True)]
        return within[0] & within[1] & within[2]

    def clipped(
        self, begin: list[Float[Array, "..."]], end: list[Float[Array, "..."]]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """The shares of the way from grid coordinates to others at which the box begins and ends; nothing of it has no length."""
        enter, leave = jnp.zeros_like(begin[0]), jnp.ones_like(begin[0])
        for first, last, points in zip(begin, end, self.values.shape, strict=True):
            change = last - first
            moves = jnp.abs(change) > jnp.finfo(change.dtype).eps  # of a cell; else its derivatives could overflow
            inverse = 1 / jnp.where(moves, change, 1)
            faces = -first * inverse, (points - 1 - first) * inverse
            inside = (first >= 0) & (first <= points - 1)
            enter = greater(enter, jnp.where(moves, lesser(*faces), jnp.where(inside, 0, 1)))
            leave = lesser(leave, jnp.where(moves, greater(*faces), jnp.where(inside, 1, 0)))
        return lesser(1, enter), greater(0, leave)

    def interpolate(self, coordinates: list[Float[Array, "a b c"]]) -> Float[Array, "a b c"]:
        """The trilinear field at grid coordinates; those outside are moved to the nearest cell's own trilinear field.

        It is NaN in cells with a corner that is, and has derivatives of 0 there.
        """
        shape = self.values.shape  # cells, in range even for NaN, and shares of them before
        whole = [
            jnp.clip(jnp.clip(at, 0, points - 2).astype(jnp.int32), 0, points - 2)
            for at, points in zip(coordinates, shape, strict=True)
        ]
        part = [at - cell.astype(at.dtype) for at, cell in zip(coordinates, whole, strict=True)]
        _, ny, nz = self.values.shape
        corner = (whole[0] * ny + whole[1]) * nz + whole[2]
        row = self.values.ravel()
        edges, missing = [], jnp.zeros((), bool)
        for beside in (0, nz, ny * nz, ny * nz + nz):  # two neighbours read at once cost two thirds of what two entries do
            pair = lax.gather(row, (corner + beside)[..., None], PAIRS, (2,), mode="promise_in_bounds").astype(part[0].dtype)
            if jnp.issubdtype(row.dtype, jnp.floating):
                empty = jnp.isnan(pair)
                pair, missing = jnp.where(empty, 0, pair), missing | empty[..., 0] | empty[..., 1]
            edges.append(_lerp(pair[..., 0], pair[..., 1], part[2]))
        between = _lerp(_lerp(edges[0], edges[1], part[1]), _lerp(edges[2], edges[3], part[1]), part[0])
        return jnp.where(missing, jnp.nan, between)

    def touched(self, before: Int[Array, "bx_and_one by_and_one bz_and_one"], slabs: SlabExtents) -> Bool[Array, "slabs bundles"]:
        """Slabs that an occupied macrocell may be in, roundings included; `counted` has how many are `before` each corner."""
        lower, upper = (slabs.x_lower, slabs.y_lower, slabs.z_lower), (slabs.x_upper, slabs.y_upper, slabs.z_upper)
        first, last, beside = [], [], jnp.zeros((), bool)
        for row, corners in zip(self.cells, before.shape, strict=True):
            low, high = (jnp.floor(side / MACROCELL) for side in heights(self.origin, row, lower, upper))
            beside |= (high < 0) | (low > corners - 1)  # the last point may be where a macrocell would begin
            first.append(jnp.clip(low, 0, corners - 2).astype(jnp.int32))
            last.append(jnp.clip(high, 0, corners - 2).astype(jnp.int32) + 1)
        (x0, y0, z0), (x1, y1, z1) = first, last
        planes = [before[x, y1, z1] - before[x, y0, z1] - before[x, y1, z0] + before[x, y0, z0] for x in (x0, x1)]
        return (planes[1] > planes[0]) & ~beside


def _lerp(first: Array, second: Array, part: Array) -> Array:
    """Exact where both are equal."""
    return first + part * (second - first)
