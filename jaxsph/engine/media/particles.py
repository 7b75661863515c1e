r"""Particles as a medium: CSPH sums over them, and the transfer function of what they interpolate.

Flow: grid, schedule -> [particles: methods -> look-up] -> integrator; cotangents -> [particles: look-up -> transposed].

$Q(x) = \sum q_j V_j W_j(x) / \sum V_j W_j(x)$ (Hochstetter et al. 2016, equation 2); where the sum of weights is zero, there is
nothing. Sums are gathered in loops, and a table is read for each sample: those two have a transpose written by hand.

Of particles with two quantities colour is looked up by the first, extinction by the second; both are sums by the same weights.
Whatever there is for each quantity is a tuple here, of which the first is that of colours and the last that of extinction.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.field.gather import gather, pull_gather
from jaxsph.engine.field.jumps import Jumps, beside_jumps
from jaxsph.engine.field.lattice import Lattice
from jaxsph.engine.field.sums import Sums, by_rays
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.shown import Band
from jaxsph.model.medium import Cotangents, Medium, Places, Stops
from jaxsph.model.particles import kernels
from jaxsph.model.transfer.function import SELECT_ALL, Segments, TransferFunction, find, locate, look_up, read
from jaxsph.numerics.compiled import fusion_barrier, ratio
from jaxsph.numerics.trees import tree

EXTINCTION = slice(3, 4)
Look = tuple[list[Array], Array, Array]
"""Of samples, cotangents of optics, and of the quantity that they were looked up by; and that."""


@tree(static=("kernel", "of_field", "of_own"))
class ParticleMedium(Medium):
    """Particles of a band, or of a shard of it.

    Attributes:
        transfer: what they look like.
        kernel: name of the smoothing kernel.
        grid, lattice, of_field, of_own: of a band, see `Band`.
        segments, jumps: of the parts of the transfer function.
    """

    in_parts = True
    transfer: TransferFunction
    kernel: str
    grid: Grid | None = None
    lattice: Lattice | None = None
    segments: tuple[Segments, ...] = ()
    of_field: bool = True
    of_own: bool = True
    jumps: tuple[Jumps, ...] = ()

    def in_band(self, band: Band) -> ParticleMedium:
        """With the particles of a band, and what the transfer function is read by."""
        segments, jumps = zip(*((part.segments(), Jumps.of(part)) for part in self.transfer.parts()), strict=True)
        return ParticleMedium(self.transfer, self.kernel, band.grid, band.lattice, segments, band.of_field, band.of_own, jumps)

    @property
    def listed(self) -> Grid:
        """The grid of its band."""
        if self.grid is None:
            raise ValueError("particles are asked for without the lists of a band; call `in_band` first")
        return self.grid

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Slabs that have any particle."""
        return self.listed.windows.count > 0

    def gather(self, task: SlabTask) -> Any:
        """Sums over particles (tasks, samples, rows, columns), by the method that all of the slabs have in the schedule."""
        particles = self.listed.ordered, self.listed.lists.rank
        dense = functools.partial(gather, *particles, task, self.kernel)
        return dense() if self.lattice is None else self.lattice.sums(self.listed, task, self.kernel, dense)

    def extinction(self, gathered: Any, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], Any]:
        """Extinction, and places in the transfer function."""
        weight, *weighted = by_rays(gathered)
        inside = weight > 0
        quantities = [
            reference[:, None, None] + ratio(value, weight)
            for reference, value in zip(task.entry.references, weighted, strict=True)
        ]
        place = at_extinction = find(self.segments[-1], quantities[-1])
        if len(quantities) > 1:
            place = find(self.segments[0], quantities[0])
        (extinction,) = read(self.segments[-1], at_extinction, EXTINCTION)
        return jnp.where(inside, extinction, 0), place

    def doubtful(self, gathered: Any, task: SlabTask) -> Bool[Array, "tasks samples rays"]:
        """Means that may be on either side of a jump; where there are none, that takes no time."""

        def find() -> Bool[Array, "tasks samples rays"]:
            return beside_jumps(gathered, task, self.listed, kernels.by_name(self.kernel), self.jumps)

        some = functools.reduce(jnp.logical_or, (one.some for one in self.jumps))
        return lax.cond(some, find, lambda: jnp.zeros(task.shape, bool))  # type: ignore[no-any-return]

    def colors(self, samples: Any, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Colours at places in the transfer function."""
        return read(self.segments[0], samples, channels)

    def pull(
        self, total: Cotangents, gathered: Any, task: SlabTask, cotangents: list[Array], of_stops: Stops | None = None
    ) -> tuple[Cotangents, Places]:
        """See `Medium.pull`. What is interpolated has none."""
        of_sums, looks = fusion_barrier(task.slab[0] >= 0, pull_look_up, gathered, self.segments, task, cotangents)
        total = self.with_transfer(total, map(pull_control_points, looks, self.segments))
        return self.pull_sums(total, task, of_sums)

    def with_transfer(self, total: Cotangents, of_parts: Iterable[TransferFunction]) -> Cotangents:
        """With cotangents of the parts of the transfer function, if they are asked for."""
        if not self.of_own:
            return total
        (of_transfer,) = jax.vjp(TransferFunction.parts, self.transfer)[1](tuple(of_parts))
        transfer = jax.tree.map(jnp.add, total.own.transfer, of_transfer)
        return total._replace(own=dataclasses.replace(total.own, transfer=transfer))

    def pull_sums(self, total: Cotangents, task: SlabTask, of_sums: list[Array]) -> tuple[Cotangents, Places]:
        """Through the sums at samples, if that is asked for."""
        if not self.of_field:
            return total, Places.none(task)
        particles = self.listed.ordered, self.listed.lists.rank
        table, places = pull_gather(total.table, *particles, task, tuple(of_sums), self.kernel)
        return total._replace(table=table), places


def pull_look_up(
    sums: Sums, parts: tuple[Segments, ...], task: SlabTask, cotangents: list[Float[Array, "tasks samples rays"]]
) -> tuple[list[Float[Array, "tasks samples rays"]], list[Look]]:
    """From cotangents of optics to those of the sums that they were looked up by, and of how each quantity was looked up."""
    weight, *several = by_rays(sums)
    of_optics = [jnp.where(weight > 0, value, 0) for value in cotangents]
    of_weight, of_weighted, looks = jnp.zeros_like(weight), [], []
    looked_up = (range(4),) if len(parts) == 1 else (range(3), range(3, 4))  # of red, green, blue, extinction by each quantity
    for weighted, reference, segments, channels in zip(several, task.entry.references, parts, looked_up, strict=True):
        value, pull_ratio = jax.vjp(ratio, weighted, weight)
        quantity = reference[:, None, None] + value
        slopes = jax.jvp(functools.partial(look_up, segments), (quantity,), (jnp.ones_like(quantity),))[1]
        own = [value if k in channels else jnp.zeros_like(value) for k, value in enumerate(of_optics)]
        of_quantity = functools.reduce(jnp.add, (own[k] * slopes[k] for k in channels))
        of_own, more = pull_ratio(of_quantity)
        of_weighted.append(of_own)
        of_weight = of_weight + more
        looks.append((own, of_quantity, quantity))
    return [of_weight, *of_weighted], looks


def pull_control_points(samples: Look, segments: Segments) -> TransferFunction:
    """Cotangents of the control points of a transfer function.

    A sample's optics are those of the points at the ends of its segment, in shares that add up to 1. To move an end is to
    move the field the other way by the same share.
    """
    (of_optics, of_quantity, quantity), points = samples, segments.start.shape[0]
    segment, part = locate(segments, quantity)
    values = jnp.stack([*of_optics, -of_quantity]).reshape(5, -1)
    segment, part = segment.reshape(-1), part.reshape(-1)
    if points <= SELECT_ALL:
        each = jnp.arange(points, dtype=jnp.int32)[:, None]
        share = jnp.where(each == segment, 1 - part, jnp.where(each == segment + 1, part, 0))
        of_points = jnp.matmul(values, share.T, precision=lax.Precision.HIGHEST)
    else:
        rows = jnp.concatenate([values * (1 - part), values * part]).T
        added = jnp.zeros((points, 10), values.dtype).at[segment].add(rows, mode="promise_in_bounds").T
        of_points = added[:5] + jnp.pad(added[5:, :-1], ((0, 0), (1, 0)))
    return TransferFunction(of_points[4], of_points[:3].T, of_points[3])
