r"""Particles as a medium: CSPH sums over them, and the transfer function of what they interpolate.

Flow: grid, schedule -> [particles: methods -> look-up] -> integrator; cotangents -> [particles: look-up -> transposed].

$Q(x) = \sum q_j V_j W_j(x) / \sum V_j W_j(x)$ (Hochstetter et al. 2016, equation 2); where the sum of weights is zero, there is
nothing. Sums are gathered in loops, and a table is read for each sample: those two have a transpose written by hand.

Of particles with two quantities colour is looked up by the first, extinction by the second; both are sums by the same weights.
Whatever there is for each quantity is a tuple here, of which the first is that of colours and the last that of extinction.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.field.gather import gather, gather_scattered
from jaxsph.engine.field.means import MeanTables, OverRange, colors_over, extinction_over, mean_light
from jaxsph.engine.field.sums import Sums, by_rays
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.field.transposed import WIDTH, pull_gather
from jaxsph.engine.media.between import Covered, covered, pull_covered, ranges_of
from jaxsph.model.medium import Medium, OfPlaces
from jaxsph.model.transfer.function import SELECT_ALL, Segments, TransferFunction, find, locate, look_up, read
from jaxsph.numerics.extremes import clamped, ratio
from jaxsph.numerics.fusion import fusion_barrier
from jaxsph.numerics.trees import tree

if TYPE_CHECKING:  # only the pilot estimator has one
    from jaxsph.engine.field.lattice import Lattice

EXTINCTION = slice(3, 4)


class Wanted(NamedTuple):
    """Which cotangents are asked for: by where samples and particles are and what those carry, and by the transfer function."""

    field: bool = True
    transfer: bool = True


class ParticleCotangents(NamedTuple):
    """Of particles in rank order, `field.transposed.COLUMNS`; and of red, green, blue, extinction and place of control points.

    The latter of each part of a transfer function.
    """

    table: Float[Array, "particles 8"]
    transfer: tuple[Float[Array, "5 points"], ...]

    def with_transfer(self, more: Iterable[Float[Array, "5 points"]]) -> ParticleCotangents:
        """With more, of all parts of the transfer function."""
        return self._replace(transfer=tuple(map(jnp.add, self.transfer, more)))

    def of_transfer(self) -> TransferFunction:
        """Of the control points."""
        first, last = self.transfer[0], self.transfer[-1]
        return TransferFunction(first[4], first[:3].T, last[3], None if len(self.transfer) == 1 else last[4])


@tree(static=("kernel", "wanted"))
class ParticleMedium(Medium):
    """Particles of a band, or of a shard of it.

    Attributes:
        grid: where they are.
        segments: of the parts of the transfer function.
        tables: of the same for means from border to border; None where none are asked for.
        lattice: where the sums of interpolated slabs come from, if any do.
        kernel: name of the smoothing kernel.
        wanted: cotangents that `pull` is to find.
    """

    at_points = False  # lists are of slabs
    in_parts = True
    grid: Grid
    segments: tuple[Segments, ...]
    tables: tuple[MeanTables, ...] | None
    lattice: Lattice | None
    kernel: str
    wanted: Wanted

    def occupied(self, slabs: Any) -> Bool[Array, "slabs bundles"]:
        """Slabs that have any particle."""
        return self.grid.windows.count > 0

    def gather(self, task: SlabTask) -> Sums | Covered:
        """Sums over particles (tasks, samples, rows, columns), by the method that all of the slabs have in the schedule.

        Of a task between borders, moreover what supports cover of its rays.
        """
        if not task.between:
            return self._sums(task)
        return covered(self.grid.ordered, self.grid.lists.rank, task, self._sums(task), self.kernel)

    def _sums(self, task: SlabTask) -> Sums:
        """By the method that slabs which are marched together have in common; without a lattice there is one."""
        particles = self.grid.ordered, self.grid.lists.rank
        dense = functools.partial(gather_scattered if task.scattered else gather, *particles, task, kernel=self.kernel)
        return dense() if self.lattice is None else self.lattice.sums(self.grid, task, self.kernel, dense)

    def extinction(self, gathered: Sums | Covered, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], Any]:
        """Extinction, and places in the transfer function; or means over what supports cover, and over which ranges."""
        if isinstance(gathered, Covered):
            ranges, share = _ranges_and_shares(gathered, task)
            means = [extinction_over(tables, *ends) for tables, ends in zip(self._tables, ranges, strict=True)]
            return jnp.where(share > 0, share * means[-1].extinction, 0), means[0]._replace(share=share)
        weight, *weighted = by_rays(gathered)
        inside = weight > 0
        quantities = [
            reference[:, None, None] + ratio(value, weight)
            for reference, value in zip(task.entry.references, weighted, strict=True)
        ]
        place = at_extinction = find(self.segments[-1], quantities[-1])
        if len(quantities) > 1:
            place = find(self.segments[0], quantities[0])
        (extinction,) = self._optics(self.segments[-1], at_extinction, task, EXTINCTION)
        if task.entry.painted is not None:
            inside |= task.entry.painted[:, None, None]
        return jnp.where(inside, extinction, 0), place

    def colors(self, samples: Any, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Colours at places in the transfer function, or over ranges of it; of super-pixels, what they are painted with."""
        if isinstance(samples, OverRange):
            return colors_over(self._tables[0], samples, channels)
        return self._optics(self.segments[0], samples, task, channels)

    def covered(self, samples: OverRange, task: SlabTask) -> Float[Array, "tasks samples rays"] | None:
        """See `Medium.covered`."""
        return samples.share

    @property
    def _tables(self) -> tuple[MeanTables, ...]:
        if self.tables is None:
            raise ValueError("means from border to border need `tables`, made with `MeanTables.of`")
        return self.tables

    def _optics(self, segments: Segments, place: tuple[Array, ...], task: SlabTask, channels: slice) -> list[Array]:
        optics, entry = read(segments, place, channels), task.entry
        if entry.paint is None or entry.painted is None:
            return optics
        painted, paints = entry.painted[:, None, None], list(entry.paint)[channels]
        return [jnp.where(painted, paint[:, None, None], value) for paint, value in zip(paints, optics, strict=True)]

    def no_cotangents(self) -> ParticleCotangents:
        """None yet."""
        x = self.grid.ordered.x
        of_parts = tuple(jnp.zeros((5, segments.start.shape[0]), x.dtype) for segments in self.segments)
        return ParticleCotangents(jnp.zeros((x.shape[0], WIDTH), x.dtype), of_parts)

    def pull(  # type: ignore[override]
        self, total: ParticleCotangents, gathered: Any, task: SlabTask, cotangents: list[Array]
    ) -> tuple[ParticleCotangents, OfPlaces]:
        """See `Medium.pull`. What is interpolated or painted has none."""
        if isinstance(gathered, Covered):
            return self._pull_covered(total, gathered, task, cotangents)
        samples = fusion_barrier(task.slab[0] >= 0, pull_look_up, gathered, self.segments, task, cotangents)
        if self.wanted.transfer:
            total = total.with_transfer(map(pull_control_points, samples.looks, self.segments))
        if not self.wanted.field:
            return total, OfPlaces.none(task)
        return self._pull_sums(total, task, samples.sums)

    def _pull_sums(self, total: ParticleCotangents, task: SlabTask, of_sums: list[Array]) -> tuple[ParticleCotangents, OfPlaces]:
        """Through the sums at samples."""
        found = pull_gather(total.table, self.grid.ordered, self.grid.lists.rank, task, tuple(of_sums), self.kernel)
        of_depth = found.along
        if task.perspective:  # lateral coordinates are u s and v s
            of_depth = of_depth + found.lateral / task.depth.T
        places = OfPlaces(of_depth.T, jnp.zeros_like(task.border), found.lateral.sum())
        return total._replace(table=found.table), places

    def _pull_covered(
        self, total: ParticleCotangents, gathered: Covered, task: SlabTask, cotangents: list[Array]
    ) -> tuple[ParticleCotangents, OfPlaces]:
        """Through means over ranges, then through the sums that they are made of, and what is covered."""
        always, (sums, _), (*of_colors, of_extinction) = task.slab[0] >= 0, gathered.chosen(task), cotangents
        ranges, share = _ranges_and_shares(gathered, task)
        transfers = [TransferFunction(one.start, one.base[:3].T, one.base[3]) for one in self.segments]

        def light(near: Array, far: Array, transfer: TransferFunction) -> list[Array]:
            return mean_light(MeanTables.of(transfer.segments()), near, far, slice(0, 4))

        def optics(lights: list[list[Array]]) -> list[Array]:
            *emission, extinction = lights[0]
            colors = (clamped(ratio(one, extinction), 0, 1) for one in emission)
            return [*colors, jnp.where(share > 0, lights[-1][3], 0)]

        def pull_light(ends: tuple[Array, Array], transfer: TransferFunction, of_light: list[Array]) -> Any:
            *of_ends, of_transfer = jax.vjp(light, *ends, transfer)[1](of_light)
            return tuple(of_ends), of_transfer

        # each step at hand before the next: XLA would find all that is read anew for whatever it is read by
        parts = list(zip(ranges, transfers, strict=True))
        lights = [fusion_barrier(always, light, *ends, transfer) for ends, transfer in parts]
        of_light = [*of_colors, of_extinction * share]
        (of_lights,) = fusion_barrier(always, lambda: jax.vjp(optics, lights)[1](of_light))
        pulled = [fusion_barrier(always, pull_light, *one, of_one) for one, of_one in zip(parts, of_lights, strict=True)]
        of_ranges, of_transfers = ([one[k] for one in pulled] for k in (0, 1))
        of_sums, of_share = fusion_barrier(
            always, lambda: jax.vjp(functools.partial(ranges_of, task=task), sums, share)[1](of_ranges)
        )
        of_share = of_share + of_extinction * jnp.where(share > 0, lights[-1][3], 0)
        if self.wanted.transfer:
            rows = ((part.colors.T, part.extinction[None], part.values[None]) for part in of_transfers)
            total = total.with_transfer(map(jnp.concatenate, rows))
        if not self.wanted.field:
            return total, OfPlaces.none(task)
        outer, particles = by_rays(gathered.sums)[0] <= 0, (self.grid.ordered, self.grid.lists.rank, task)
        total, places = self._pull_sums(total, task, [jnp.where(outer, 0, one) for one in of_sums])
        more = [jnp.where(outer, one, 0).sum(1) for one in of_sums]
        table, border, factor = pull_covered(total.table, *particles, gathered, of_share, more, self.kernel)
        return total._replace(table=table), places._replace(border=border, factor=places.factor + factor)


def _ranges_and_shares(gathered: Covered, task: SlabTask) -> tuple[list[tuple[Array, Array]], Array]:
    """At hand one after the other: what reads one would find it anew."""
    always = task.slab[0] >= 0
    sums, share = fusion_barrier(always, gathered.chosen, task)
    return fusion_barrier(always, ranges_of, sums, share, task), share


class LookUpCotangents(NamedTuple):
    """Of samples that were looked up by one quantity.

    Attributes:
        optics: of red, green, blue and extinction.
        quantity: of the field; and `found`, the field itself.
    """

    optics: list[Float[Array, "tasks samples rays"]]
    quantity: Float[Array, "tasks samples rays"]
    found: Float[Array, "tasks samples rays"]


class SampleCotangents(NamedTuple):
    """Of the samples of a chunk: of their sums, that of weights first, and of how each quantity was looked up."""

    sums: list[Float[Array, "tasks samples rays"]]
    looks: tuple[LookUpCotangents, ...]


def pull_look_up(
    sums: Sums, parts: tuple[Segments, ...], task: SlabTask, cotangents: list[Float[Array, "tasks samples rays"]]
) -> SampleCotangents:
    """From cotangents of optics to those of the sums that they were looked up by."""
    weight, *several = by_rays(sums)
    of_optics = [jnp.where(weight > 0, value, 0) for value in cotangents]
    of_weight, of_weighted, looks = jnp.zeros_like(weight), [], []
    looked_up = (range(4),) if len(parts) == 1 else (range(3), range(3, 4))  # of red, green, blue, extinction by each quantity
    for weighted, reference, segments, channels in zip(several, task.entry.references, parts, looked_up, strict=True):
        found, pull_ratio = jax.vjp(ratio, weighted, weight)
        quantity = reference[:, None, None] + found
        slopes = jax.jvp(functools.partial(look_up, segments), (quantity,), (jnp.ones_like(quantity),))[1]
        own = [value if k in channels else jnp.zeros_like(value) for k, value in enumerate(of_optics)]
        of_quantity = functools.reduce(jnp.add, (own[k] * slopes[k] for k in channels))
        of_own, more = pull_ratio(of_quantity)
        of_weighted.append(of_own)
        of_weight = of_weight + more
        looks.append(LookUpCotangents(own, of_quantity, quantity))
    return SampleCotangents([of_weight, *of_weighted], tuple(looks))


def pull_control_points(samples: LookUpCotangents, segments: Segments) -> Float[Array, "5 points"]:
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
