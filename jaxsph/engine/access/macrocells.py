"""Empty space of a volume grid: the range of values in each of its macrocells, and which boxes hold what is looked for.

Flow: volume, transfer function -> [macrocells] -> media -> schedule.

A macrocell is `MACROCELL` grid cells along each axis, with the points on all of its faces: what is trilinear between grid points
stays between the least and the greatest of them. How many macrocells of a box are occupied follows from eight entries of their
running sums, however large the box is.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Num

from jaxsph.engine.access.compaction import running_sum
from jaxsph.model.transfer.function import EVEN, SELECT_ALL, TransferFunction, look_up
from jaxsph.numerics.trees import tree

MACROCELL = 4
Reduction = Callable[..., Array]
ROUNDING = 8  # eps that interpolation between two values, or their look-up, may be off by


@tree()
class MacrocellRanges:
    """The least and the greatest value at the grid points of each macrocell."""

    lo: Num[Array, "bx by bz"]
    hi: Num[Array, "bx by bz"]

    @classmethod
    def of(cls, values: Num[Array, "nx ny nz"]) -> MacrocellRanges:
        """Of the values of a grid; NaN where a macrocell holds any."""
        values = lax.stop_gradient(values)
        lo, hi = values, values
        for axis in range(3):
            lo, hi = _reduced(lo, jnp.minimum, jnp.min, axis), _reduced(hi, jnp.maximum, jnp.max, axis)
        return cls(lo, hi)

    def finite(self) -> Bool[Array, ""]:
        """Whether all values are."""
        return (jnp.isfinite(self.lo) & jnp.isfinite(self.hi)).all()

    def widened(self, dtype: jnp.dtype) -> tuple[Float[Array, "bx by bz"], Float[Array, "bx by bz"]]:
        """The range of what is interpolated with rounding; equal values are interpolated exactly."""
        lo, hi = self.lo.astype(dtype), self.hi.astype(dtype)
        off = jnp.where(lo < hi, ROUNDING * jnp.finfo(dtype).eps * jnp.maximum(jnp.abs(lo), jnp.abs(hi)), 0)
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
        return at_ends | (up_to[last] > up_to[first])


@tree()
class Occupancy:
    """Which macrocells are occupied, as numbers of those before each corner of a macrocell."""

    before: Int[Array, "bx_and_one by_and_one bz_and_one"]

    @classmethod
    def of(cls, occupied: Bool[Array, "bx by bz"]) -> Occupancy:
        """Of marked macrocells."""
        count = jnp.pad(occupied.astype(jnp.int32), ((1, 0),) * 3)
        for axis in range(3):
            count = running_sum(count, axis)
        return cls(count)

    def any_in(self, lower: list[Float[Array, "*any"]], upper: list[Float[Array, "*any"]]) -> Bool[Array, "*any"]:
        """Whether boxes touch an occupied macrocell, from their least and greatest grid coordinates x, y and z."""
        first, last, beside = [], [], jnp.zeros((), bool)
        for axis in range(3):
            macrocells = self.before.shape[axis] - 1
            low, high = (jnp.floor(side[axis] / MACROCELL) for side in (lower, upper))
            beside |= (high < 0) | (low > macrocells)  # the last point may be where a macrocell would begin
            first.append(jnp.clip(low, 0, macrocells - 1).astype(jnp.int32))
            last.append(jnp.clip(high, 0, macrocells - 1).astype(jnp.int32) + 1)
        (x0, y0, z0), (x1, y1, z1) = first, last
        planes = [self._in_plane(x, y0, y1, z0, z1) for x in (x0, x1)]
        return (planes[1] > planes[0]) & ~beside

    def _in_plane(self, x: Array, y0: Array, y1: Array, z0: Array, z1: Array) -> Array:
        at = self.before
        return at[x, y1, z1] - at[x, y0, z1] - at[x, y1, z0] + at[x, y0, z0]


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
