"""Every pixel has a ray of its own."""

from __future__ import annotations

import jax.numpy as jnp

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.cast.march import RayResult
from jaxsph.engine.field.tasks import RayPackets
from jaxsph.engine.screen.sampler import Pixels, ScreenSampler
from jaxsph.model.camera.camera import Camera


class EveryPixel(ScreenSampler):
    """A packet is a bundle: the rays through the middles of its 8 x 8 pixels."""

    def packets(self, grid: Grid, camera: Camera) -> RayPackets:
        """See `ScreenSampler`."""
        return RayPackets(*grid.rays(camera, jnp.arange(grid.row.shape[0], dtype=jnp.int32)))

    def resolve(self, rays: RayResult, lists: ListPlan) -> Pixels:
        """See `ScreenSampler`."""
        color = lists.as_image(jnp.moveaxis(rays.color, 0, -1))
        return color, lists.as_image(rays.transmittance), lists.as_image(rays.depth)
