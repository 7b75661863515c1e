"""What a frame shows, as its stages are given it; and of a band of it, as media are.

Flow: viewing -> [shown] -> stages: control | cast -> media.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
from jaxtyping import Array, Float

from jaxsph.engine.access.grid import Grid
from jaxsph.model.camera.camera import Camera
from jaxsph.model.clips import Clip
from jaxsph.model.medium import Medium
from jaxsph.model.transfer.function import TransferFunction

if TYPE_CHECKING:  # only the pilot estimator has one
    from jaxsph.engine.field.lattice import Lattice


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


class Band(NamedTuple):
    """What media are given of a band of the image.

    Attributes:
        grid: spheres, and where they are.
        lattice: where the sums of interpolated slabs come from, if any do.
        between: whether means from border to border are asked for.
        of_field, of_own: whether cotangents are, by where samples and particles are and what those carry; and of the medium.
    """

    grid: Grid
    lattice: Lattice | None = None
    between: bool = False
    of_field: bool = True
    of_own: bool = True


class RayLimits(NamedTuple):
    """Where rays stop being marched, and slabs being halved; None for neither.

    Attributes:
        min_transmittance: below which a ray ends.
        tolerance: that segments are refined for.
    """

    min_transmittance: Float[Array, ""] | None = None
    tolerance: Float[Array, ""] | None = None
