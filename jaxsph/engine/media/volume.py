"""A volume as a medium: trilinear interpolation, and the transfer function of what it gives.

Flow: volume, camera -> [volume: grid -> look-up] -> integrator.

Between borders the quantity is taken for linear, and the transfer function integrated over its range (Engel, Kraus & Ertl 2001).
Where a ray enters and leaves the box is found, with the quantity there: in a slab that is one place each. Slabs in which the
transfer function shows nothing are not marched, see `access.volume_grid`. What is NaN is not there: nor
is a cell with such a corner. As a medium it shares samples with others, so light
from all of them meets in the right order (Kaehler, Abel & Hege 2007).
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.precision import looks_of, parted
from jaxsph.engine.access.volume_grid import ROUNDING_BETWEEN, MacrocellRanges, VolumeGrid, counted
from jaxsph.engine.field.jumps import Jumps
from jaxsph.engine.field.means import MeanTables, OverRange, colors_over, extinction_over
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.shown import Band
from jaxsph.model.camera.camera import Camera
from jaxsph.model.medium import Cotangents, Medium, Places, Stops
from jaxsph.model.transfer.function import Segments, TransferFunction, find, read
from jaxsph.model.volume import Volume
from jaxsph.numerics import faults
from jaxsph.numerics.compiled import clamped, greater, lesser, ratio
from jaxsph.numerics.trees import tree

COLORS, EXTINCTION = slice(0, 3), slice(3, 4)


@tree()
class VolumeMedium(Medium):
    """A volume in view space.

    Attributes:
        grid: its values, and where they are.
        segments: of the transfer function.
        shown: how many macrocells that the transfer function shows are before each corner, see `counted`.
        jumps: of the transfer function.
        steepest: what neighbouring points differ by at most, along each axis; 0 without jumps.
        fault: fault word: whether any value is infinite.
        tables: of the transfer function for means from border to border; None where none are asked for.
    """

    in_parts = True
    grid: VolumeGrid
    segments: Segments
    shown: Int[Array, "bx_and_one by_and_one bz_and_one"]
    jumps: Jumps
    steepest: Float[Array, "3"]
    fault: Int[Array, ""]
    tables: MeanTables | None = None

    @classmethod
    def seen(cls, volume: Volume, transfer: TransferFunction, camera: Camera) -> VolumeMedium:
        """As a camera sees it.

        Differentiation:
            By the values (where they are floats), `lower`, `spacing`, camera and transfer function. Which macrocells are shown is
            held fixed.
        """
        grid, ranges = VolumeGrid.seen(volume, camera), MacrocellRanges.of(volume.values)
        transfer = jax.tree.map(lambda leaf: leaf.astype(grid.origin.dtype), transfer).joined()
        transfer = dataclasses.replace(transfer, values=parted(transfer.values, transfer.values, looks_of(transfer))[1])
        still, jumps = jax.lax.stop_gradient(transfer), Jumps.of(transfer)

        def differ() -> Float[Array, "3"]:
            values = jax.lax.stop_gradient(volume.values).astype(grid.origin.dtype)
            return jnp.stack([jnp.nanmax(jnp.abs(jnp.diff(values, axis=axis)), initial=0) for axis in range(3)])

        steepest = jax.lax.cond(jumps.some, differ, lambda: jnp.zeros_like(grid.origin))
        placed = jnp.isfinite(grid.origin).all() & jnp.isfinite(grid.cells).all()
        fault = faults.raised(faults.BAD_VOLUME, ~(ranges.finite() & placed))
        return cls(grid, transfer.segments(), counted(ranges.shown_by(still)), jumps, steepest, fault)

    def with_data(self, given: Volume | None) -> VolumeMedium:
        """With the values of the volume that it was made of, or without."""
        return dataclasses.replace(self, grid=self.grid.holding(None if given is None else given.values))

    def in_band(self, band: Band) -> VolumeMedium:
        """With tables of the transfer function, where means are asked for."""
        return dataclasses.replace(self, tables=MeanTables.of(self.segments)) if band.between else self

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Slabs that may meet a macrocell in which there is any extinction."""
        return self.grid.touched(self.shown, slabs)

    def gather(self, task: SlabTask) -> tuple[Array, ...]:
        """The quantity at samples, and whether they are inside the grid; or what lies between them."""
        coordinates = self.grid.coordinates((task.on_borders() if task.between else task).positions())
        if not task.between:
            quantity = self.grid.interpolate(coordinates)
            missing = jnp.isnan(quantity)
            return jnp.where(missing, 0, quantity), self.grid.inside(coordinates) & ~missing
        first, last = ([at[:, k] for at in coordinates] for k in (0, -1))
        entry, leaving = self.grid.clipped(first, last)
        ends = [
            jnp.stack([begin + share * (end - begin) for share in (entry, leaving)], 1)
            for begin, end in zip(first, last, strict=True)
        ]
        places = [jnp.concatenate(pair, 1) for pair in zip(coordinates, ends, strict=True)]
        nearest = [clamped(at, 0, points - 1) for at, points in zip(places, self.grid.values.shape, strict=True)]
        quantity = self.grid.interpolate(nearest)
        return quantity[:, :-2], quantity[:, -2], quantity[:, -1], entry, leaving

    def extinction(self, gathered: tuple[Array, ...], task: SlabTask) -> tuple[Array, Any]:
        """Extinction, and places in the transfer function; or its mean from border to border, and over which range that is."""
        if task.between:
            *ends, share = self._range(gathered, task)
            mean = extinction_over(self._tables, *ends)
            return jnp.where(share > 0, share * mean.extinction, 0), mean
        quantity, inside = gathered
        place = find(self.segments, quantity)
        (extinction,) = read(self.segments, place, EXTINCTION)
        return jnp.where(inside, extinction, 0), place

    def doubtful(self, gathered: tuple[Array, ...], task: SlabTask) -> Bool[Array, "tasks samples rays"]:
        r"""Samples that may be on either side of a jump; where there are none, that takes no time.

        **Theorem.** Where grid coordinates are off by $\delta_k$ cells, the quantity is off by less than $\sum_k \delta_k$ times
        what neighbouring points differ by, and by `ROUNDING_BETWEEN` eps. *Argument.* It is linear along each axis between
        neighbours. $\square$
        """
        quantity, inside = gathered[:2]

        def find_them() -> Bool[Array, "tasks samples rays"]:
            rounding = ROUNDING_BETWEEN * jnp.finfo(quantity.dtype).eps * (jnp.abs(quantity) + self.steepest.sum())
            off = functools.reduce(jnp.add, map(jnp.multiply, self.grid.rounding(task.positions()), self.steepest), rounding)
            return inside & self.jumps.beside(quantity, jnp.where(self.steepest.any(), off, 0), task.path())

        return jax.lax.cond(self.jumps.some, find_them, lambda: jnp.zeros(task.shape, bool))  # type: ignore[no-any-return]

    def colors(self, samples: Any, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Colours at places in the transfer function, or means over ranges, by extinction."""
        over = isinstance(samples, OverRange)
        return colors_over(self._tables, samples, channels) if over else read(self.segments, samples, channels)

    @property
    def _tables(self) -> MeanTables:
        return MeanTables.of(self.segments) if self.tables is None else self.tables

    def _range(self, gathered: tuple[Array, ...], task: SlabTask) -> tuple[Array, Array, Array]:
        """The quantity where what counts of each sample in the box begins and ends, linear between; and what share that is."""
        # the quantity at borders, those outside of the box moved to it, and where rays enter and leave it, or at the ends of the
        # slab; and shares of its length that lie before these two: where a ray misses the box, the latter is not behind
        quantity, at_entry, at_exit, entry, leaving = gathered
        begin, end = task.border[:, :-1, None], task.border[:, 1:, None]
        front, slab = task.border[:, :1, None], (task.border[:, -1:] - task.border[:, :1])[:, :, None]
        inverse = ratio(1.0, end - begin)
        ahead = clamped((entry[:, None] * slab - (begin - front)) * inverse, 0, 1)
        within = clamped((leaving[:, None] * slab - (begin - front)) * inverse, 0, 1)
        near = jnp.where(ahead > 0, at_entry[:, None], quantity[:, :-1])
        far = jnp.where(within < 1, at_exit[:, None], quantity[:, 1:])
        share, part = greater(0, within - ahead), task.part
        # the border of what is not there is taken to lie half way between a place that is and one that is not
        share *= 1 - 0.5 * (jnp.isnan(near).astype(share.dtype) + jnp.isnan(far).astype(share.dtype))
        near, far = jnp.where(jnp.isnan(near), far, near), jnp.where(jnp.isnan(far), near, far)
        near, far = (jnp.where(jnp.isnan(end), 0, end) for end in (near, far))
        if part is None:
            return near, far, share
        starts, stops, inverse = greater(ahead, part.begin), lesser(ahead + share, part.end), ratio(1.0, share)
        first, last = (near + clamped((at - ahead) * inverse, 0, 1) * (far - near) for at in (starts, stops))
        return first, last, greater(0, stops - starts) * ratio(part.share, part.end - part.begin)

    def pull(
        self, total: Cotangents, gathered: Any, task: SlabTask, cotangents: list[Array], of_stops: Stops | None = None
    ) -> tuple[Cotangents, Places]:
        """See `Medium.pull`: tables are made again, such that the transfer function has their cotangents."""
        return super(VolumeMedium, dataclasses.replace(self, tables=None)).pull(total, gathered, task, cotangents)
