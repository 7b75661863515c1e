"""Which rays of a band are cast, and how its pixels are made of them: the interface of all screen samplers.

Flow: grid, camera -> [sampler: packets] -> cast -> [sampler: resolve] -> layers.
"""

from __future__ import annotations

import abc

from jaxtyping import Array, Float

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.cast.march import RayResult
from jaxsph.engine.field.tasks import RayPackets
from jaxsph.model.camera.camera import Camera

Pixels = tuple[Float[Array, "rows columns 3"], Float[Array, "rows columns"], Float[Array, "rows columns"]]


class ScreenSampler(abc.ABC):
    """How the rays of an image are chosen."""

    @abc.abstractmethod
    def packets(self, grid: Grid, camera: Camera) -> RayPackets:
        """The rays to cast, in packets that read the lists of a grid's bundles; differentiable by the camera.

        Args:
            grid: of a band, or of a shard of it.
        """

    @abc.abstractmethod
    def resolve(self, rays: RayResult, lists: ListPlan) -> Pixels:
        """Colour, transmittance and depth of half transmittance of a band's pixels, from what its packets met; differentiable.

        Args:
            rays: of all packets of a band, those of its shards side by side.
            lists: how its bundles lie, see `ListPlan.as_image`.
        """
