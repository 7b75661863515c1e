"""Packets of rays, and the slabs of samples along them that are marched together.

Flow: screen -> [tasks: RayPackets] -> cast -> [tasks: SlabTask] -> media, integrators.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsph.field.schedule import SlabSchedule


@dataclasses.dataclass(frozen=True)
class RayPackets:
    """Rays in tensor products: of a packet, through all pairs of a column and a row.

    Attributes:
        u, v: ray coordinates of columns and rows: a ray's view coordinates at depth 1 (perspective) or any depth.
        list_id: bundle whose list of particles a packet reads, and whose schedule it keeps; None where packet k reads list k.
    """

    u: Float[Array, "columns packets"]
    v: Float[Array, "rows packets"]
    list_id: Int[Array, " packets"] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a packet."""
        return self.v.shape[0], self.u.shape[0]

    @property
    def num_rays(self) -> int:
        """Rays of a packet."""
        return self.u.shape[0] * self.v.shape[0]

    def reading(self, of_bundles: Array) -> Array:
        """Of an array whose last axis is bundles, those that packets read."""
        return of_bundles if self.list_id is None else of_bundles[..., self.list_id]

    def per_pixel(self, per_ray: Float[Array, " bundles"], pixels: int) -> Float[Array, " bundles"]:
        """Of what every ray of a bundle takes, what its rays take in all, a pixel of the bundle."""
        share = self.num_rays / pixels
        if self.list_id is None:
            return per_ray if share == 1 else per_ray * share
        return jnp.zeros_like(per_ray).at[self.list_id].add(share * per_ray[self.list_id])


@dataclasses.dataclass(frozen=True)
class SlabTask:
    """Slabs that are marched together, and where their samples are.

    Attributes:
        entry: what the schedule says of each.
        slab, bundle: which slabs they are, and whose lists they read.
        u, v: ray coordinates of columns and rows, see `RayPackets`.
        depth: view depths of the samples: in the middle between borders or, where an integrator asks for it, on them.
        border: view depths of the borders of what samples stand for.
        perspective: whether rays spread with depth.
    """

    entry: SlabSchedule
    slab: Int[Array, " tasks"]
    bundle: Int[Array, " tasks"]
    u: Float[Array, "tasks columns"]
    v: Float[Array, "tasks rows"]
    depth: Float[Array, "tasks samples"]
    border: Float[Array, "tasks samples_and_one"]
    perspective: bool

    @property
    def shape(self) -> tuple[int, int, int]:
        """Tasks, samples of each, and rays."""
        return self.depth.shape[0], self.depth.shape[1], self.u.shape[1] * self.v.shape[1]

    def positions(self) -> tuple[Float[Array, "tasks samples rays"], ...]:
        """View coordinates x, y, z of all samples."""
        lateral_scale = self.depth if self.perspective else jnp.ones_like(self.depth)
        x = (self.u[:, None, None, :] * lateral_scale[..., None, None]) * jnp.ones_like(self.v)[:, None, :, None]
        y = (self.v[:, None, :, None] * lateral_scale[..., None, None]) * jnp.ones_like(self.u)[:, None, None, :]
        z = jnp.broadcast_to(self.depth[..., None], self.shape)
        return x.reshape(self.shape), y.reshape(self.shape), z

    def path(self) -> Float[Array, "tasks samples rays"]:
        """Path lengths between borders; of one ray for all where rays do not spread."""
        step = (self.border[:, 1:] - self.border[:, :-1])[:, :, None]
        if self.perspective:
            slant = jnp.sqrt(1 + self.u[:, None, :] ** 2 + self.v[:, :, None] ** 2)
            step = step * slant.reshape(-1, 1, self.u.shape[1] * self.v.shape[1])
        return step


jax.tree_util.register_dataclass(RayPackets, data_fields=["u", "v", "list_id"], meta_fields=[])
jax.tree_util.register_dataclass(
    SlabTask,
    data_fields=["entry", "slab", "bundle", "u", "v", "depth", "border"],
    meta_fields=["perspective"],
)
