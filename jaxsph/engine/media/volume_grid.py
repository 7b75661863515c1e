"""A volume as a camera sees it: where its grid lies in view space, and what it is between grid points.

Flow: volume, camera -> [volume grid] -> media.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Num

from jaxsph.engine.access.grid import SlabExtents
from jaxsph.engine.access.macrocells import Occupancy
from jaxsph.model.camera.camera import Camera
from jaxsph.model.volume import Volume
from jaxsph.numerics.extremes import greater, lesser
from jaxsph.numerics.trees import tree

ROUNDING = 32  # eps of view coordinates that a computed grid coordinate may be off by: six products, their sums, and the box's
PAIRS = lax.GatherDimensionNumbers(offset_dims=(3,), collapsed_slice_dims=(), start_index_map=(0,))


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
        """The trilinear field at grid coordinates; those outside are moved to the nearest cell's own trilinear field."""
        whole, part = zip(*(_cell(at, points) for at, points in zip(coordinates, self.values.shape, strict=True)), strict=True)
        _, ny, nz = self.values.shape
        corner = (whole[0] * ny + whole[1]) * nz + whole[2]
        row = self.values.ravel()
        edges = [_lerp(*_pair(row, corner + beside, part[0].dtype), part[2]) for beside in (0, nz, ny * nz, ny * nz + nz)]
        return _lerp(_lerp(edges[0], edges[1], part[1]), _lerp(edges[2], edges[3], part[1]), part[0])

    def touched(self, occupancy: Occupancy, slabs: SlabExtents) -> Bool[Array, "slabs bundles"]:
        """Slabs that an occupied macrocell may be in, roundings included."""
        sides = ((slabs.x_lower, slabs.x_upper), (slabs.y_lower, slabs.y_upper), (slabs.z_lower, slabs.z_upper))
        lower, upper = [], []
        eps = ROUNDING * jnp.finfo(self.origin.dtype).eps
        for row in self.cells:
            low = high = off = jnp.zeros((), self.origin.dtype)
            for (least, most), zero, scale in zip(sides, self.origin, row, strict=True):
                ends = scale * (least - zero), scale * (most - zero)
                low, high = low + jnp.minimum(*ends), high + jnp.maximum(*ends)
                off = off + jnp.abs(scale) * (jnp.maximum(jnp.abs(least), jnp.abs(most)) + jnp.abs(zero))
            lower.append(low - eps * off)
            upper.append(high + eps * off)
        return occupancy.any_in(lower, upper)


def _cell(at: Float[Array, "..."], points: int) -> tuple[Int[Array, "..."], Float[Array, "..."]]:
    """The cell that a coordinate lies in, and the share of the cell before it; in range even for NaN."""
    whole = jnp.clip(jnp.clip(at, 0, points - 2).astype(jnp.int32), 0, points - 2)
    return whole, at - whole.astype(at.dtype)


def _pair(row: Array, at: Array, dtype: jnp.dtype) -> tuple[Array, Array]:
    """Two neighbouring entries: read at once, they cost two thirds of what two entries do."""
    found = lax.gather(row, at[..., None], PAIRS, (2,), mode="promise_in_bounds").astype(dtype)
    return found[..., 0], found[..., 1]


def _lerp(first: Array, second: Array, part: Array) -> Array:
    """Exact where both are equal."""
    return first + part * (second - first)
