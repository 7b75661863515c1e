"""Where rays pass points: the columns of a point set in view space, and the feet of its centres on rays.

Flow: points, tasks -> [point rays] -> points as a medium.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsph.engine.field.tasks import SlabTask

NUM_COLUMNS = 8  # of a row of the table: read, and added to, as one


class Row(NamedTuple):
    """Points in view space, as columns.

    Attributes:
        x, y, z: of the centre, length units.
        inverse: of the radius.
        strength: extinction times radius: the thickness of a chord of length 1 in radii.
        red, green, blue: in [0, 1].
    """

    x: Array
    y: Array
    z: Array
    inverse: Array
    strength: Array
    red: Array
    green: Array
    blue: Array


class PointRays(NamedTuple):
    """Rays of tasks, one by one.

    Attributes:
        u, v: ray coordinates.
        border: depths between intervals.
        slant: path length a unit of depth.
        axes: of the camera.
    """

    u: Float[Array, "tasks rays"]
    v: Float[Array, "tasks rays"]
    border: Float[Array, "tasks intervals_and_one 1"]
    slant: Float[Array, "tasks rays"]
    axes: Float[Array, "3 3"]
    perspective: bool

    @classmethod
    def of(cls, task: SlabTask, axes: Array) -> PointRays:
        """Of the slabs of a task."""
        u, v = task.ray_coordinates()
        slant = jnp.sqrt(1 + u * u + v * v) if task.perspective else jnp.ones_like(u)
        return cls(u, v, task.border[..., None], slant, axes, task.perspective)

    def nearest(self, row: Row) -> tuple[Array, list[Array]]:
        """Depth of the foot of centres on rays, (tasks, points, rays), and the offset of it from the centre."""
        u, v = self.u[:, None], self.v[:, None]
        if not self.perspective:
            foot = jnp.broadcast_to(row.z, (*row.z.shape[:2], u.shape[2]))
            return foot, [u - row.x, v - row.y, jnp.zeros_like(foot)]
        # from the depth of the centre on: what is small is not the difference of what is large
        x, y = row.x - u * row.z, row.y - v * row.z
        further = (x * u + y * v) / (self.slant[:, None] ** 2)
        return row.z + further, [u * further - x, v * further - y, further]

    def direction_in_world(self) -> list[Array]:
        """Of length 1, (tasks, rays)."""
        ahead = jnp.ones_like(self.u)
        if not self.perspective:
            return self.in_world([jnp.zeros_like(self.u), jnp.zeros_like(self.u), ahead])
        return self.in_world([part / self.slant for part in (self.u, self.v, ahead)])

    def in_world(self, view: list[Array]) -> list[Array]:
        """Directions of view space along the axes of the world."""
        return [sum(self.axes[k, axis] * view[k] for k in range(3)) for axis in range(3)]  # type: ignore[misc]
