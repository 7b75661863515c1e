"""The sparse perspective grid of a band of the image: where everything is, for control and cast.

Flow: ordering -> lists -> cells -> [grid] -> control, cast.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.lists import BUNDLE, BundleLists
from jaxsph.engine.access.ordering import Ordered
from jaxsph.engine.access.slab_windows import SlabWindows
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.trees import tree


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
