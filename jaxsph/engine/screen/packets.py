"""From wanted pixels to packets of rays: scattered rays of a bundle, or all of it.

Flow: canvas -> [packets] -> cast.

A bundle of which few rays are wanted is cast as packets of scattered rays, see `Apart`; one of which more are wanted is cast
whole, which takes less than to cast them apart (and tells all of its pixels).
"""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import BUNDLE, ListPlan
from jaxsph.engine.field.tasks import RayPackets
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.checks import array_of
from jaxsph.numerics.trees import tree

PIXELS = BUNDLE * BUNDLE  # of a bundle, and rays of one that is cast whole


class Apart(NamedTuple):
    """How many scattered rays a packet has, and how many packets a bundle has at most that is not cast whole."""

    rays: int
    packets: int


SHARING = Apart(8, 1)  # a list of spheres: with 16 it took nearly as long as a whole bundle, as much is read for either
SCATTERED = Apart(16, 2)  # where rays share nothing; packets of 8 took nearly as long, and a whole bundle 2.7 times as long


@dataclasses.dataclass(frozen=True)
class QuadtreePlan:
    """Static sizes of the refinement.

    Attributes:
        leaf: pixels on each side of the leaves that it begins with; nodes of the first lattice are half as far apart.
        lists: sizes of the lists of that lattice's bundles, which is cast in one band.
        packets: bundles that are cast together.
    """

    leaf: int
    lists: ListPlan
    packets: int

    @property
    def stride(self) -> int:
        """Pixels between the nodes of the first lattice."""
        return self.leaf // 2

    @property
    def sides(self) -> tuple[int, ...]:
        """Of the leaves that may be split, the largest first."""
        return tuple(2**k for k in range(self.stride.bit_length() - 1, 0, -1))


@tree()
class Chosen:
    """Some bundles, of which some rays are cast.

    Attributes:
        bundle: which they are.
        place: of each ray, its pixel in the bundle, row by row.
        real: rays that are cast, others are room; a packet of which none is real is room.
    """

    bundle: Int[Array, " packets"]
    place: Int[Array, "rays packets"]
    real: Bool[Array, "rays packets"]

    def pixels(self, grid: Grid, shape: tuple[int, int]) -> Int[Array, "packets rays"]:
        """Where rays are in an image of that shape, row by row; past the last pixel where there is no such ray."""
        row = grid.row[self.bundle] + self.place // BUNDLE
        column = grid.column[self.bundle] + self.place % BUNDLE
        inside = self.real & (row < shape[0]) & (column < shape[1])
        return jnp.where(inside, row * shape[1] + column, shape[0] * shape[1]).T


@tree(static=("rays", "packets"))
class Queue:
    """Bundles of which rays are wanted, one after the other; `packets` of them are cast together, from the `first` on.

    Attributes:
        wanted: of each bundle, which of its pixels.
        bundle: the bundles that are to be cast, and past `number` any.
        part: of each, which of the packets of its bundle it is.
        rays: of a packet; static, as is `packets`.
    """

    wanted: Bool[Array, "bundles 64"]
    bundle: Int[Array, " queued"]
    part: Int[Array, " queued"]
    number: Int[Array, ""]
    first: Int[Array, ""]
    rays: int
    packets: int = 1

    def turn(self, nth: int | Int[Array, ""], packets: int) -> Queue:
        """The same, with the `nth` so many packets to be cast."""
        return dataclasses.replace(self, first=array_of(nth * packets, jnp.int32), packets=packets)

    def chosen(self) -> Chosen:
        """The packets to be cast."""
        nth = self.first + jnp.arange(self.packets, dtype=jnp.int32)
        (bundle, part), inside = (of[jnp.minimum(nth, of.shape[0] - 1)] for of in (self.bundle, self.part)), nth < self.number
        pixel = jnp.arange(PIXELS, dtype=jnp.int32)[:, None]
        if self.rays == PIXELS:
            return Chosen(bundle, *(jnp.broadcast_to(one, (PIXELS, self.packets)) for one in (pixel, inside)))
        wanted = self.wanted[bundle].T & inside
        slot = jnp.arange(self.rays, dtype=jnp.int32)[:, None, None] + self.rays * part
        mine = wanted & (jnp.cumsum(wanted, 0, dtype=jnp.int32) - 1 == slot)
        place, real = jnp.where(mine, pixel, 0).sum(1), mine.any(1)
        return Chosen(bundle, jnp.where(real, place, place[0]), real)


def by_bundle(lists: ListPlan, image: Bool[Array, "rows columns"], first_row: Any = 0) -> Bool[Array, "bundles 64"]:
    """The pixels of the band that begins at a row of an image, bundle by bundle; the opposite of `ListPlan.as_image`."""
    rows, columns = (size * BUNDLE for size in lists.bundles)
    image = jnp.pad(image, ((0, rows), (0, max(columns - image.shape[1], 0))))
    band = lax.dynamic_slice_in_dim(image, first_row, rows, 0)[:, :columns]
    parts = band.reshape(lists.tile_rows, 2, BUNDLE, lists.tile_columns, 2, BUNDLE)
    return parts.transpose(0, 3, 1, 4, 2, 5).reshape(lists.num_bundles, PIXELS)


def queued(wanted: Bool[Array, "bundles 64"], apart: Apart) -> tuple[Queue, Queue]:
    """What is cast as scattered rays, and what as whole bundles."""
    packets = -(-wanted.sum(1)[:, None] // apart.rays)

    def queue(some: Bool[Array, "bundles parts"], rays: int) -> Queue:
        bundle, part = (one.astype(jnp.int32) for one in jnp.nonzero(some, size=some.size, fill_value=0))
        return Queue(wanted, bundle, part, some.sum(dtype=jnp.int32), jnp.int32(0), rays)

    few = packets <= apart.packets
    return queue(few & (jnp.arange(apart.packets) < packets), apart.rays), queue(~few, PIXELS)


@tree()
class Parts:
    """Squares of bundles, with as many rays as a bundle has, `step` pixels apart; those that are not `real` are room.

    Attributes:
        row, column: of the upper left corner in its bundle, pixels.
        filled: slabs in which their rays may meet anything.
    """

    bundle: Int[Array, " packets"]
    row: Int[Array, " packets"]
    column: Int[Array, " packets"]
    real: Bool[Array, " packets"]
    step: Float[Array, ""]
    filled: Bool[Array, "slabs packets"] | None = None


def rays_of_parts(grid: Grid, camera: Camera, parts: Parts) -> RayPackets:
    """Their rays, each a packet; differentiable by the camera."""
    dtype = grid.half_steps.dtype
    away = (jnp.arange(BUNDLE, dtype=dtype)[:, None] + 0.5) * parts.step.astype(dtype)
    row, column = grid.row[parts.bundle] + parts.row, grid.column[parts.bundle] + parts.column
    u, v = camera.column(column.astype(dtype) + away), camera.row(row.astype(dtype) + away)
    return RayPackets(u, v, parts.bundle, parts.real, filled=parts.filled)


def every_bundle(grid: Grid, camera: Camera, chosen: None = None) -> RayPackets:
    """The rays of all pixels of a band, or of a shard of it: of every bundle, through the middles of its 8 x 8.

    Differentiable by the camera.
    """
    return RayPackets(*grid.rays(camera, jnp.arange(grid.row.shape[0], dtype=jnp.int32)))


def whole_bundles(grid: Grid, camera: Camera, chosen: Chosen) -> RayPackets:
    """The rays of bundles that are cast whole, as tensor products; differentiable by the camera."""
    return RayPackets(*grid.rays(camera, chosen.bundle), chosen.bundle, chosen.real.any(0))


def scattered_rays(grid: Grid, camera: Camera, chosen: Chosen) -> RayPackets:
    """Their rays, one by one; those that are room go where the first one does. Differentiable by the camera."""
    dtype = grid.half_steps.dtype
    u = camera.column((grid.column[chosen.bundle] + chosen.place % BUNDLE).astype(dtype) + 0.5)
    v = camera.row((grid.row[chosen.bundle] + chosen.place // BUNDLE).astype(dtype) + 0.5)
    return RayPackets(u, v, chosen.bundle, chosen.real.any(0), scattered=True)
