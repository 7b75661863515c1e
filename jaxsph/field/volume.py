"""A volume as a medium: trilinear interpolation, and the transfer function of what it gives.

Flow: volume, camera -> [volume: grid -> look-up] -> integrator.

Slabs in which the transfer function shows nothing are not marched, see `access.macrocells`. As a medium it shares samples with
others, so light from all of them meets in the right order (Kaehler, Abel & Hege 2007).
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.access.macrocells import MacrocellRanges, Occupancy
from jaxsph.field.tasks import SlabTask
from jaxsph.field.volume_grid import VolumeGrid
from jaxsph.model.camera import Camera
from jaxsph.model.medium import Medium
from jaxsph.model.transfer import Segments, TransferFunction, find, read
from jaxsph.model.volume import Volume
from jaxsph.numerics import faults

COLORS, EXTINCTION = slice(0, 3), slice(3, 4)


@dataclasses.dataclass(frozen=True)
class VolumeMedium(Medium):
    """A volume in view space.

    Attributes:
        grid: its values, and where they are.
        segments: of the transfer function.
        shown: macrocells that the transfer function shows.
        fault: fault word: whether any value is no finite number.
    """

    grid: VolumeGrid
    segments: Segments
    shown: Occupancy
    fault: Int[Array, ""]

    @classmethod
    def seen(cls, volume: Volume, transfer: TransferFunction, camera: Camera) -> VolumeMedium:
        """As a camera sees it.

        Differentiation:
            By the values (where they are floats), `lower`, `spacing`, camera and transfer function. Which macrocells are shown is
            held fixed.
        """
        grid, ranges = VolumeGrid.seen(volume, camera), MacrocellRanges.of(volume.values)
        transfer = jax.tree.map(lambda leaf: leaf.astype(grid.origin.dtype), transfer)
        still = jax.tree.map(jax.lax.stop_gradient, transfer)
        placed = jnp.isfinite(grid.origin).all() & jnp.isfinite(grid.cells).all()
        fault = faults.raised(faults.BAD_VOLUME, ~(ranges.finite() & placed))
        return cls(grid, transfer.segments(), Occupancy.of(ranges.shown_by(still)), fault)

    def without_data(self) -> VolumeMedium:
        """Without values."""
        return dataclasses.replace(self, grid=self.grid.holding(None))

    def with_data(self, given: Volume) -> VolumeMedium:
        """With the values of the volume that it was made of."""
        return dataclasses.replace(self, grid=self.grid.holding(given.values))

    def faults(self) -> Int[Array, ""]:
        """Whether the values are usable."""
        return self.fault

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Slabs that may meet a macrocell in which there is any extinction."""
        return self.grid.touched(self.shown, slabs)

    def gather(self, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], Bool[Array, "tasks samples rays"]]:
        """The quantity at samples, and whether they are inside the grid."""
        coordinates = self.grid.coordinates(task.positions())
        return self.grid.interpolate(coordinates), self.grid.inside(coordinates)

    def extinction(self, gathered: tuple[Array, Array], task: SlabTask) -> tuple[Array, tuple[Array, ...]]:
        """Extinction, and places in the transfer function."""
        quantity, inside = gathered
        place = find(self.segments, quantity)
        (extinction,) = read(self.segments, place, EXTINCTION)
        return jnp.where(inside, extinction, 0), place

    def colors(self, samples: tuple[Array, ...], task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Colours at places in the transfer function."""
        return read(self.segments, samples, channels)


jax.tree_util.register_dataclass(VolumeMedium, data_fields=["grid", "segments", "shown", "fault"], meta_fields=[])
