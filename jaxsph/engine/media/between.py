r"""Particles between samples: what of each sample's length supports cover, and one sample more where its middle lies outside.

Flow: sums, cover -> [between] -> media; cotangents of shares and sums -> [between] -> transposed.

A sample in the middle of what it stands for counts as far as supports cover that: so a border is where it is, and what is left
is the error of the midpoint rule. Where the middle itself lies outside, another sample is taken in the middle of what is covered,
one for each ray and slab: of the longest such part. Both have cotangents by the borders, which depend on the one particle each
that makes them, and is found again by its place in the windows of its slab.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.view import Ordered
from jaxsph.engine.field.cover import Cover, bordered, cover_of, over_groups, pivot_of, rows_of, with_rows
from jaxsph.engine.field.gather import COLUMNS
from jaxsph.engine.field.means import MeanTables, OverRange, colors_over, extinction_over, mean_light
from jaxsph.engine.field.sums import Sums, by_rays, fetch, particle_at, pull_blocks, sums_of, with_block, with_rows_at
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.particles import ParticleMedium
from jaxsph.engine.media.shown import Band
from jaxsph.model.medium import Cotangents, Places, Stops
from jaxsph.model.particles import kernels
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.numerics.compiled import clamped, fusion_barrier, greater, lesser, ratio
from jaxsph.numerics.trees import tree

GRAZING = 64  # eps of a squared support: a chord shorter than its square root has no derivatives
BLOCK, BLOCK_BACK = 16, 4  # particles met at once
PLACE = 8  # row of `Covered` in which the depth of one sample more is
Columns = tuple[Array, ...]  # x, y, z, scale and size


@tree()
class Covered:
    """Sums in the middles of samples, and what supports cover of rays.

    Attributes:
        sums: at samples.
        rows: of rays: `Cover`, the depth of one sample more, and the sums there; one array, such that it is one XLA kernel.
    """

    sums: Sums
    rows: Float[Array, "tasks rows rays"]

    @property
    def cover(self) -> Cover:
        """Where supports cover rays."""
        return Cover(*(jnp.moveaxis(self.rows[:, k : k + 2], 1, 0) for k in range(0, PLACE, 2)))

    def chosen(self, task: SlabTask) -> tuple[list[Array], Array]:
        """Sums where each sample is taken, and what share of its length counts."""
        found = by_rays(self.sums)
        outer, more = found[0] <= 0, self.rows[:, PLACE + 1 :]
        chosen = [jnp.where(outer, more[:, k, None], own) for k, own in enumerate(found)]
        return chosen, jnp.where(chosen[0] > 0, share_of(self.cover, task), 0)


@tree(static=("kernel", "of_field", "of_own"))
class ParticlesBetween(ParticleMedium):
    """Particles of a band, for means from border to border.

    Attributes:
        tables: of the parts of the transfer function, for means over ranges of them.
    """

    tables: tuple[MeanTables, ...] = ()

    def in_band(self, band: Band) -> ParticlesBetween:
        """With the particles of a band; tables are made once, outside of loops."""
        listed = super().in_band(band)
        fields = {field.name: getattr(listed, field.name) for field in dataclasses.fields(ParticleMedium)}
        return ParticlesBetween(**fields, tables=tuple(map(MeanTables.of, listed.segments)))

    def gather(self, task: SlabTask) -> Covered:
        """Sums at samples, and what supports cover of rays."""
        if not task.between:
            return super().gather(task)
        ordered, rank, sums = self.listed.ordered, self.listed.lists.rank, super().gather(task)
        (weight, *_), edge = by_rays(sums), kernels.by_name(self.kernel).edge
        (tasks, _, rays), far = weight.shape, jnp.finfo(weight.dtype).max
        whole = [-far, far, far, -far, *[0] * (5 + len(ordered.quantities) + 1)]

        def find(items: Array, some: SlabTask, rows: Array) -> Array:
            here = rows_of(weight, items)
            pivot = pivot_of(here, edge, some)
            cover = cover_of(ordered, rank, some, pivot)
            place = place_of(cover, some.border, here > 0)
            found = jnp.concatenate([*cover, place[None], jnp.stack(sums_at(ordered, rank, some, place, self.kernel))])
            return rows.at[items].set(jnp.moveaxis(found, 0, 1), mode="drop")

        start = jnp.broadcast_to(jnp.asarray(whole, weight.dtype)[:, None], (tasks, len(whole), rays))
        return Covered(sums, over_groups(find, start, task, _unbordered(weight, self.kernel)))

    def extinction(self, gathered: Covered, task: SlabTask) -> tuple[Float[Array, "tasks samples rays"], Any]:
        """Means over what supports cover, and over which ranges."""
        if not task.between:
            return super().extinction(gathered, task)
        ranges, share = _ranges_and_shares(gathered, task)
        means = [extinction_over(tables, *ends) for tables, ends in zip(self.tables, ranges, strict=True)]
        return jnp.where(share > 0, share * means[-1].extinction, 0), means[0]._replace(share=share)

    def colors(self, samples: OverRange, task: SlabTask, channels: slice) -> list[Float[Array, "tasks samples rays"]]:
        """Over ranges of the transfer function."""
        if not task.between:
            return super().colors(samples, task, channels)
        return colors_over(self.tables[0], samples, channels)

    def covered(self, samples: OverRange, task: SlabTask) -> Float[Array, "tasks samples rays"] | None:
        """See `Medium.covered`."""
        return samples.share

    def pull(
        self, total: Cotangents, gathered: Covered, task: SlabTask, cotangents: list[Array], of_stops: Stops | None = None
    ) -> tuple[Cotangents, Places]:
        """Through means over ranges, then through the sums that they are made of, and what is covered."""
        always, (sums, _), (*of_colors, of_extinction) = task.slab[0] >= 0, gathered.chosen(task), cotangents
        ranges, share = _ranges_and_shares(gathered, task)

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
        parts = list(zip(ranges, self.transfer.parts(), strict=True))
        lights = [fusion_barrier(always, light, *ends, transfer) for ends, transfer in parts]
        of_light = [*of_colors, of_extinction * share]
        (of_lights,) = fusion_barrier(always, lambda: jax.vjp(optics, lights)[1](of_light))
        pulled = [fusion_barrier(always, pull_light, *one, of_one) for one, of_one in zip(parts, of_lights, strict=True)]
        of_ranges, of_transfers = ([one[k] for one in pulled] for k in (0, 1))
        of_sums, of_share = fusion_barrier(
            always, lambda: jax.vjp(functools.partial(ranges_of, task=task), sums, share)[1](of_ranges)
        )
        of_share = of_share + of_extinction * jnp.where(share > 0, lights[-1][3], 0)
        total = self.with_transfer(total, of_transfers)
        outer = by_rays(gathered.sums)[0] <= 0
        total, places = self.pull_sums(total, task, [jnp.where(outer, 0, one) for one in of_sums])
        if not self.of_field:
            return total, places
        more = [jnp.where(outer, one, 0).sum(1) for one in of_sums]
        table, border, factor = self.pull_covered(total.table, task, gathered, of_share, more)
        return total._replace(table=table), places._replace(border=border, factor=places.factor + factor)

    def pull_covered(
        self, table: Array, task: SlabTask, gathered: Covered, of_share: Array, of_sums: list[Array]
    ) -> tuple[Array, Array, Array]:
        """Add to `table` the cotangents of particles by shares, and by sums at the one sample more of each ray.

        Returns:
            The table, and cotangents of borders of samples and of a common factor of u and v.
        """
        ordered, rank, kernel = self.listed.ordered, self.listed.lists.rank, self.kernel
        (weight, *_), one = by_rays(gathered.sums), jnp.ones((), table.dtype)

        def pull_some(items: Array, some: SlabTask, so_far: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            table, border_so_far, factor_so_far = so_far
            inside, rows, share, sums = rows_of((weight > 0, gathered.rows, of_share, jnp.stack(of_sums, 1)), items)
            real = (items < weight.shape[0])[:, None]
            cover, place = Covered(gathered.sums, rows).cover, rows[:, PLACE]
            of_more = jnp.where(real[:, None], sums, 0)
            table, of_place, factor = _pull_sums(table, ordered, rank, some, place, of_more, kernel)

            def found(front: Array, back: Array, border: Array) -> tuple[Array, Array]:
                moved = cover._replace(front=front, back=back)
                return share_of(moved, dataclasses.replace(some, border=border)), place_of(moved, border, inside)

            pull = jax.vjp(found, cover.front, cover.back, some.border)[1]
            *of_ends, of_border = pull((jnp.where(real[:, None], share, 0), jnp.where(real, of_place, 0)))
            for sign, ends, makers, cotangents in zip((-1, 1), cover[:2], cover[2:], of_ends, strict=True):
                for end, maker, of_end in zip(ends, makers, cotangents, strict=True):
                    met = (jnp.abs(end) < jnp.finfo(end.dtype).max) & real
                    given = jnp.where(met, of_end, 0)
                    # one end of a piece of each ray, made by the particle at a place in the windows
                    begin, length = some.entry.begin[..., None], some.entry.length[..., None]
                    particle, _ = particle_at(rank, begin, length, maker.astype(jnp.int32))
                    columns = tuple(getattr(ordered, name)[particle] for name in COLUMNS[:5])
                    by_factor = jax.vjp(functools.partial(chord_end, task=some, sign=sign), columns, one)[1]
                    of_columns, more = by_factor(given)
                    table, factor = with_rows_at(table, particle, of_columns), factor + more
            return table, with_rows(border_so_far, items, of_border), factor_so_far + factor

        start = table, jnp.zeros_like(task.border), jnp.zeros((), table.dtype)
        return over_groups(pull_some, start, task, _unbordered(weight, kernel))


def _ranges_and_shares(gathered: Covered, task: SlabTask) -> tuple[list[tuple[Array, Array]], Array]:
    """At hand one after the other: what reads one would find it anew."""
    always = task.slab[0] >= 0
    sums, share = fusion_barrier(always, gathered.chosen, task)
    return fusion_barrier(always, ranges_of, sums, share, task), share


def _unbordered(weight: Float[Array, "tasks samples rays"], kernel: str) -> Bool[Array, "tasks samples rays"]:
    """Samples with no border near them."""
    outer, falls, rises = bordered(weight, kernels.by_name(kernel).edge)
    return ~(outer | falls | rises)


def share_of(cover: Cover, task: SlabTask) -> Float[Array, "tasks samples rays"]:
    """What share of each sample's length is covered and, where only a part of it counts, in that."""
    begin, end = task.border[:, :-1, None], task.border[:, 1:, None]
    length, part = end - begin, task.part
    if part is None:
        return ratio(cover.length(begin, end), length)
    inner = cover.length(begin + part.begin * length, begin + part.end * length)
    return ratio(inner, length) * ratio(part.share, part.end - part.begin)


def ranges_of(
    sums: list[Float[Array, "tasks samples rays"]], share: Float[Array, "tasks samples rays"], task: SlabTask
) -> list[tuple[Array, Array]]:
    """Over which range each quantity runs in samples, taken for linear: as in the middle, and as steep as towards neighbours.

    Where one neighbour is known, as at the ends of slabs and at borders, that is towards it.
    """
    (weight, *weighted), known = sums, share > 0
    both = known[:, 1:] & known[:, :-1]
    number = _beside(both.astype(weight.dtype))
    found = []
    for value, reference in zip(weighted, task.entry.references, strict=True):
        quantity = ratio(value, weight)
        rise = _beside(jnp.where(both, quantity[:, 1:] - quantity[:, :-1], 0))
        half = rise * share * jnp.where(number > 1, 0.25, 0.5)
        middle = reference[:, None, None] + quantity
        found.append((middle - half, middle + half))
    return found


def _beside(of_steps: Float[Array, "tasks steps rays"]) -> Float[Array, "tasks samples rays"]:
    """Of steps from sample to sample, the sum on both sides of each."""
    nothing = jnp.zeros_like(of_steps[:, :1])
    return jnp.concatenate([nothing, of_steps], 1) + jnp.concatenate([of_steps, nothing], 1)


def place_of(
    cover: Cover, border: Float[Array, "tasks samples_and_one"], inside: Bool[Array, "tasks samples rays"]
) -> Float[Array, "tasks rays"]:
    """The middle of the longest part that is covered of a sample which is not `inside`; where there is none, of the slab."""
    place = jnp.broadcast_to(0.5 * (border[:, :1] + border[:, -1:]), inside.shape[::2])
    longest = jnp.zeros_like(place)
    for k in range(inside.shape[1]):
        for front, back in zip(cover.front, cover.back, strict=True):
            begin, end = greater(border[:, k, None], front), lesser(border[:, k + 1, None], back)
            better = ~inside[:, k] & (end - begin > longest)
            place = jnp.where(better, 0.5 * (begin + end), place)
            longest = jnp.where(better, end - begin, longest)
    return place


def sums_at(
    ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, place: Float[Array, "tasks rays"], kernel: str
) -> list[Float[Array, "tasks rays"]]:
    """The sums at one place of each ray."""
    sums = sums_of([jnp.zeros_like(place)] * (1 + len(ordered.quantities)))
    blocks = (task.entry.length.sum(0).max() + BLOCK - 1) // BLOCK

    def add(nth: Array, sums: Sums) -> Sums:
        block = fusion_barrier(nth >= 0, lambda: fetch(ordered, *particle_at(rank, *task.nth_block(BLOCK, nth)), task.references))
        columns = block.x, block.y, block.z, block.scale, block.size

        def weighed(k: int) -> tuple[Array, list[Array]]:
            weight = _weight(tuple(column[:, k, None] for column in columns), task, place, kernel)
            return weight, [quantity[:, k, None] for quantity in block.quantities]

        return with_block(sums, [weighed(k) for k in range(BLOCK)])

    return list(lax.fori_loop(0, blocks, add, sums).all)


def _weight(columns: Columns, task: SlabTask, place: Array, kernel: str) -> Float[Array, "tasks rays"]:
    """Of a particle of each slab, at a depth of each ray."""
    (x, y, z, scale, size), (u, v), smooth = columns, task.ray_coordinates(), kernels.by_name(kernel)
    lateral = place if task.perspective else jnp.ones_like(place)
    along = ((place - z) * scale) ** 2 + ((v * lateral - y) * scale) ** 2
    return smooth.weigh(smooth.prepare(along, size), ((u * lateral - x) * scale) ** 2, size, jnp)  # type: ignore[no-any-return]


def _pull_sums(
    table: Array, ordered: Ordered, rank: Array, task: SlabTask, place: Array, of_sums: Array, kernel: str
) -> tuple[Array, Array, Array]:
    """Add to `table` by the sums at a place of each ray; and cotangents of that and of a common factor of u and v."""

    def fetched(nth: Array) -> tuple[Array, tuple[Array, ...], None]:
        particle, inside = particle_at(rank, *task.nth_block(BLOCK_BACK, nth))
        block = fetch(ordered, particle, inside, task.references)
        return particle, (block.x, block.y, block.z, block.scale, block.size, *block.quantities), None

    def sums(columns: Columns, shared: tuple[Array, Array], _: None) -> Array:
        (place, factor), each = shared, [tuple(column[:, k, None] for column in columns) for k in range(BLOCK_BACK)]
        moved = task.stretched(factor)
        weights = [_weight(one[:5], moved, place, kernel) for one in each]
        rows = [[weight, *(weight * quantity for quantity in one[5:])] for weight, one in zip(weights, each, strict=True)]
        return jnp.stack([functools.reduce(jnp.add, terms) for terms in zip(*rows, strict=True)], 1)

    blocks = (task.entry.length.sum(0).max() + BLOCK_BACK - 1) // BLOCK_BACK
    table, of = pull_blocks(sums, fetched, (0, blocks), table, (place, jnp.ones((), place.dtype)), of_sums)
    return table, *of


def chord_end(columns: Columns, factor: Array, task: SlabTask, sign: int) -> Float[Array, "tasks rays"]:
    """Depth at which each ray, at `factor` times its coordinates, enters (`sign` -1) or leaves (1) a support of its own.

    Those are given by x, y, z, scale and size (tasks, rays).
    """
    (x, y, z, scale, size), (u, v) = columns, task.stretched(factor).ray_coordinates()  # not `Piercing`: rows cost 5 % here
    middle = jax.lax.stop_gradient(0.5 * (task.border[:, :1] + task.border[:, -1:]))
    slopes, lateral = ((u, v), middle) if task.perspective else ((jnp.zeros_like(u), jnp.zeros_like(v)), 1.0)
    x, y, z = x - u * lateral, y - v * lateral, z - middle
    inverse = 1 / (1 + slopes[0] ** 2 + slopes[1] ** 2)
    along = x * slopes[0] + y * slopes[1] + z
    square = (size / jnp.where(scale > 0, scale, 1)) ** 2
    inner = square - (x * x + y * y + z * z) + along * along * inverse
    solid = inner > GRAZING * jnp.finfo(square.dtype).eps * square
    half = jnp.where(solid, jnp.sqrt(jnp.where(solid, inner, 1) * inverse), 0)
    return middle + along * inverse + sign * half
