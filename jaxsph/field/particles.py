r"""Particles as a medium: CSPH sums over them, and the transfer function of what they interpolate.

Flow: grid, schedule -> [particles: methods -> look-up] -> integrator; cotangents -> [particles: look-up -> transposed].

$Q(x) = \sum q_j V_j W_j(x) / \sum V_j W_j(x)$ (Hochstetter et al. 2016, equation 2); where the sum of weights is zero, there is
nothing. Sums are gathered in loops, and a table is read for each sample: those two have a transpose written by hand.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.access.grid import Grid
from jaxsph.field.between import SumsBetween, intervals_between, pull_cover, pull_means
from jaxsph.field.cover import cover_of
from jaxsph.field.intervals import Intervals, means_of
from jaxsph.field.lattice import Lattice
from jaxsph.field.methods import methods_of
from jaxsph.field.sums import Sums, by_rays, least_weight
from jaxsph.field.tasks import SlabTask
from jaxsph.field.transposed import COLUMNS, WIDTH, pull_gather
from jaxsph.model.medium import Medium, OfPlaces
from jaxsph.model.transfer import SELECT_ALL, Segments, TransferFunction, find, locate, look_up, read
from jaxsph.model.transfer_means import MeanTables
from jaxsph.numerics.fusion import fusion_barrier

EXTINCTION = slice(3, 4)


class Wanted(NamedTuple):
    """Which cotangents are asked for: by where samples and particles are and what those carry, and by the transfer function."""

    field: bool = True
    transfer: bool = True


class ParticleCotangents(NamedTuple):
    """Of particles in rank order, `field.transposed.COLUMNS`; and of red, green, blue, extinction and place of control points."""

    table: Float[Array, "particles 8"]
    transfer: Float[Array, "5 points"]

    def columns(self) -> dict[str, Float[Array, " particles"]]:
        """Of particles, by name."""
        return {name: self.table[:, k] for k, name in enumerate(COLUMNS)}

    def of_transfer(self) -> TransferFunction:
        """Of the control points."""
        return TransferFunction(self.transfer[4], self.transfer[:3].T, self.transfer[3])


@dataclasses.dataclass(frozen=True)
class ParticleMedium(Medium):
    """Particles of a band, or of a shard of it.

    Attributes:
        grid: where they are.
        segments: of the transfer function.
        tables: of the same for means between samples; None where none are asked for.
        lattice: where the sums of interpolated slabs come from, if any do.
        kernel: name of the smoothing kernel.
        wanted: cotangents that `pull` is to find.
    """

    at_points = False  # lists are of slabs
    in_parts = True
    grid: Grid
    segments: Segments
    tables: MeanTables | None
    lattice: Lattice | None
    kernel: str
    wanted: Wanted

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Slabs that have any particle."""
        return self.grid.windows.count > 0

    def gather(self, task: SlabTask) -> Any:
        """Sums over particles (tasks, samples, rows, columns), by the method that all of the slabs have in the schedule.

        Of a task between samples, moreover what supports cover of its rays.
        """
        if not task.between:
            return self._sums(task)
        sums = self._sums(task)
        return SumsBetween(sums, cover_of(self.grid.ordered, self.grid.lists.rank, task, by_rays(sums)[0] > 0))

    def _sums(self, task: SlabTask) -> Sums:
        methods = methods_of(self.grid, self.kernel, self.lattice, task.scattered)
        if len(methods) == 1 or task.entry.method is None:
            return methods[0](task)
        # a dummy has any method, and drops what it finds
        method = jnp.where(task.slab < self.grid.windows.count.shape[0], task.entry.method, 0).max()
        return lax.switch(method, [functools.partial(one, task) for one in methods])

    def extinction(self, gathered: Sums, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], tuple[Array, ...]]:
        """Extinction, and places in the transfer function."""
        weight, weighted = by_rays(gathered)
        inside = weight > 0
        ratio = jnp.where(inside, weighted / jnp.where(inside, weight, 1), 0)
        place = find(self.segments, task.entry.reference_quantity[:, None, None] + ratio)
        (extinction,) = self._optics(place, task, EXTINCTION)
        if task.entry.painted is not None:
            inside |= task.entry.painted[:, None, None]
        return jnp.where(inside, extinction, 0), place

    def colors(self, samples: tuple[Array, ...], task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Colours at places in the transfer function; of super-pixels, what they are painted with."""
        return self._optics(samples, task, channels)

    def intervals(self, gathered: SumsBetween, task: SlabTask) -> Intervals:
        """Ends of the intervals between samples, in units of the quantity."""
        return fusion_barrier(task.slab[0] >= 0, intervals_between, gathered, task)  # type: ignore[no-any-return]

    def means(self, intervals: Intervals, task: SlabTask, channels: slice) -> list[Float[Array, "tasks intervals rays"]]:
        """See `Medium.means`: of the transfer function, over the range of the quantity in each interval."""
        if self.tables is None:
            raise ValueError("means between samples need `tables`, made with `MeanTables.of`")
        return means_of(self.tables, intervals, channels)

    def every_other(self, gathered: SumsBetween) -> SumsBetween:
        """Every other of the sums; borders stay where they are."""
        return SumsBetween(jax.tree.map(lambda value: value[:, ::2], gathered.sums), gathered.cover)

    def _optics(self, place: tuple[Array, ...], task: SlabTask, channels: slice) -> list[Array]:
        optics, entry = read(self.segments, place, channels), task.entry
        if entry.paint is None or entry.painted is None:
            return optics
        painted, paints = entry.painted[:, None, None], list(entry.paint)[channels]
        return [jnp.where(painted, paint[:, None, None], value) for paint, value in zip(paints, optics, strict=True)]

    def no_cotangents(self) -> ParticleCotangents:
        """None yet."""
        x = self.grid.ordered.x
        control_points = self.segments.start.shape[0]
        return ParticleCotangents(jnp.zeros((x.shape[0], WIDTH), x.dtype), jnp.zeros((5, control_points), x.dtype))

    def pull(  # type: ignore[override]
        self, total: ParticleCotangents, gathered: Any, task: SlabTask, cotangents: list[Array]
    ) -> tuple[ParticleCotangents, OfPlaces]:
        """See `Medium.pull`. What is interpolated or painted has none."""
        if task.between:
            return self._pull_between(total, gathered, task, cotangents)
        samples = fusion_barrier(task.slab[0] >= 0, pull_look_up, gathered, self.segments, task, cotangents)
        if self.wanted.transfer:
            total = total._replace(transfer=total.transfer + pull_control_points(samples, self.segments))
        if not self.wanted.field:
            return total, OfPlaces.none(task)
        ordered, of_sums = self.grid.ordered, (samples.weight, samples.weighted)
        found = pull_gather(total.table, ordered, self.grid.lists.rank, task, of_sums, self.kernel)
        of_depth = found.along
        if task.perspective:  # lateral coordinates are u s and v s
            of_depth = of_depth + found.lateral / task.depth.T
        places = OfPlaces(of_depth.T, jnp.zeros_like(task.border), found.lateral.sum())
        return total._replace(table=found.table), places

    def _pull_between(
        self, total: ParticleCotangents, gathered: SumsBetween, task: SlabTask, cotangents: list[Array]
    ) -> tuple[ParticleCotangents, OfPlaces]:
        """Through the means of intervals, then through sums and borders."""
        ordered, rank = self.grid.ordered, self.grid.lists.rank
        found = fusion_barrier(task.slab[0] >= 0, pull_means, gathered, self.segments, task, cotangents)
        if self.wanted.transfer:
            transfer = jnp.concatenate([found.transfer.colors.T, found.transfer.extinction[None], found.transfer.values[None]])
            total = total._replace(transfer=total.transfer + transfer)
        if not self.wanted.field:
            return total, OfPlaces.none(task)
        of_sums = pull_gather(total.table, ordered, rank, task, (found.weight, found.weighted), self.kernel)
        of_depth = of_sums.along + (of_sums.lateral / task.depth.T if task.perspective else 0)
        table, factor = pull_cover(of_sums.table, ordered, rank, task, gathered, found.cover)
        places = OfPlaces(of_depth.T + found.depth, jnp.zeros_like(task.border), of_sums.lateral.sum() + factor)
        return total._replace(table=table), places


@dataclasses.dataclass(frozen=True)
class SampleCotangents:
    """Of the samples of a chunk.

    Attributes:
        weight, weighted: of their sums.
        optics: of red, green, blue and extinction.
        quantity: of the field; and `found`, the field itself.
    """

    weight: Float[Array, "tasks samples rays"]
    weighted: Float[Array, "tasks samples rays"]
    optics: list[Float[Array, "tasks samples rays"]]
    quantity: Float[Array, "tasks samples rays"]
    found: Float[Array, "tasks samples rays"]


def pull_look_up(sums: Sums, segments: Segments, task: SlabTask, cotangents: list[Array]) -> SampleCotangents:
    """From cotangents of optics to those of the sums that they were looked up by."""
    weight, weighted = by_rays(sums)
    inside = weight > 0
    inverse = 1 / jnp.where(inside, weight, 1)
    ratio = jnp.where(inside, weighted * inverse, 0)
    quantity = task.entry.reference_quantity[:, None, None] + ratio
    slopes = jax.jvp(lambda q: look_up(segments, q), (quantity,), (jnp.ones_like(quantity),))[1]
    of_optics = [jnp.where(inside, value, 0) for value in cotangents]
    of_quantity = sum(value * slope for value, slope in zip(of_optics, slopes, strict=True))
    solid = weight > least_weight(weight.dtype)
    of_weighted = jnp.where(solid, of_quantity * inverse, 0)
    return SampleCotangents(-ratio * of_weighted, of_weighted, of_optics, of_quantity, quantity)


def pull_control_points(samples: SampleCotangents, segments: Segments) -> Float[Array, "5 points"]:
    """Cotangents of the control points of a transfer function: red, green, blue, extinction, and where the points lie.

    A sample's optics are those of the points at the ends of its segment, in shares that add up to 1. To move an end is to
    move the field the other way by the same share.
    """
    points = segments.start.shape[0]
    segment, part = locate(segments, samples.found)
    values = jnp.stack([*samples.optics, -samples.quantity]).reshape(5, -1)
    segment, part = segment.reshape(-1), part.reshape(-1)
    if points <= SELECT_ALL:
        each = jnp.arange(points, dtype=jnp.int32)[:, None]
        share = jnp.where(each == segment, 1 - part, jnp.where(each == segment + 1, part, 0))
        return jnp.matmul(values, share.T, precision=lax.Precision.HIGHEST)
    rows = jnp.concatenate([values * (1 - part), values * part]).T
    added = jnp.zeros((points, 10), values.dtype).at[segment].add(rows, mode="promise_in_bounds").T
    return added[:5] + jnp.pad(added[5:, :-1], ((0, 0), (1, 0)))


jax.tree_util.register_dataclass(
    ParticleMedium, data_fields=["grid", "segments", "tables", "lattice"], meta_fields=["kernel", "wanted"]
)
jax.tree_util.register_dataclass(
    SampleCotangents, data_fields=[field.name for field in dataclasses.fields(SampleCotangents)], meta_fields=[]
)
