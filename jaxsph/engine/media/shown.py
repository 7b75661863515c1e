"""What a frame shows, as its stages are given it.

Flow: viewing -> [shown] -> stages: control | cast.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
from jaxtyping import Array, Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips.clips import Clip
from jaxsph.model.medium import Medium
from jaxsph.model.transfer.function import TransferFunction


class Shown(NamedTuple):
    """What is shown besides spheres, which a grid holds.

    Attributes:
        camera: in whose view, or through whose rays.
        transfer: of the particles; None without any.
        media: other media, in view space.
        within: where particles are shown, None everywhere; other media are so by themselves.
    """

    camera: Camera
    transfer: TransferFunction | None
    media: tuple[Medium, ...] = ()
    within: Clip | None = None

    def of_type(self, dtype: Any) -> Shown:
        """With the numbers of the transfer function in the type of what is marched."""
        return self._replace(transfer=jax.tree.map(lambda leaf: leaf.astype(dtype), self.transfer))


class RayLimits(NamedTuple):
    """Where rays stop being marched, and slabs being halved; None for neither.

    Attributes:
        min_transmittance: below which a ray ends.
        tolerance: that segments are refined for.
    """

    min_transmittance: Float[Array, ""] | None = None
    tolerance: Float[Array, ""] | None = None
