"""The sparse perspective grid of a band of the image: where everything is, for control and cast.

Flow: ordering -> lists -> cells -> [grid] -> control, cast.

On CPUs XLA splits every kernel among its threads, but those of a chunk of slabs are over before that pays: two threads were 1.1
to 1.3 times as fast as one, two programs side by side 1.9 times. So bundles are dealt out like cards, that each shard of a band
has about as much to do wherever the fluid is, and is a run of the same program. What a bundle's rays meet does not depend on what
it is marched with, so the image is the same bit for bit.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.lists import BUNDLE, BundleLists
from jaxsph.engine.access.ordering import Ordered
from jaxsph.engine.access.slab_windows import SlabWindows
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.trees import tree


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


def slab_extents(grid: Grid, camera: Camera, slab_samples: int) -> SlabExtents:
    """Boxes of all slabs of a band or of a shard of it."""
    slabs, bundles = grid.windows.count.shape
    borders = grid.borders(slabs * slab_samples)
    front, back = borders[:-1:slab_samples, None], borders[slab_samples::slab_samples, None]
    u, v = grid.rays(camera, jnp.arange(bundles, dtype=jnp.int32))

    def sides(rays: Array) -> tuple[Array, Array]:
        lower, upper = rays.min(0), rays.max(0)
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
    windows, row, column, start, end = shard((grid.windows, grid.row, grid.column, grid.lists.start, grid.lists.end), nth, shards)
    lists = dataclasses.replace(grid.lists, start=start, end=end)
    return dataclasses.replace(grid, lists=lists, windows=windows, row=row, column=column)


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
