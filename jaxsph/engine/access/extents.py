"""Boxes around the slabs of a band, by which media other than particles say where they are.

Flow: grid -> [extents] -> media -> schedule.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsph.engine.access.grid import Grid
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
