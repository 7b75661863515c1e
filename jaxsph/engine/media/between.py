"""Particles between samples: from their sums at samples, and borders of supports, to the ends of intervals; and back.

Flow: gather, cover -> [between] -> intervals -> media; cotangents of means -> [between] -> transposed.

What is made of the ends of intervals has cotangents by the sums at samples, and by the borders: those depend on the one particle
that makes each of them, which is found again by its place in the windows of its slab.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.ordering import Ordered
from jaxsph.engine.field.cover import Cover, Ends, Lines, ends_of, over_groups
from jaxsph.engine.field.fetch import particle_at
from jaxsph.engine.field.intervals import BESIDE, EXTINCTION, Intervals, intervals_of, looked_up, means_by
from jaxsph.engine.field.sums import Sums, by_rays
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.field.transposed import COLUMNS, WIDTH
from jaxsph.engine.lookups.means import MeanTables, mean_light
from jaxsph.model.transfer.function import Segments, TransferFunction
from jaxsph.numerics.extremes import greater, lesser, ratio

GRAZING = 64  # eps of a squared support: a chord shorter than its square root has no derivatives


class SumsBetween(NamedTuple):
    """Sums at samples, and what supports cover of rays."""

    sums: Sums
    cover: Cover

    def at(self, items: Int[Array, " some"]) -> SumsBetween:
        """Those of some tasks."""
        by_task = self.cover._replace(pivot=self.cover.pivot[None])
        cover = jax.tree.map(lambda value: value[:, items], by_task)
        return SumsBetween(jax.tree.map(lambda value: value[items], self.sums), cover._replace(pivot=cover.pivot[0]))


class MeanCotangents(NamedTuple):
    """Of sums and depths of samples, of borders, and of the parts of the transfer function."""

    sums: list[Float[Array, "tasks samples rays"]]
    cover: Cover
    depth: Float[Array, "tasks samples"]
    transfers: list[TransferFunction]


def intervals_between(gathered: SumsBetween, task: SlabTask) -> list[Intervals]:
    """Ends of the intervals between samples, in units of the quantity; of each quantity."""
    return _intervals(by_rays(gathered.sums), gathered.cover, task.depth, task)


def missed_length(gathered: SumsBetween, task: SlabTask) -> Float[Array, "tasks rays"]:
    """How much more or less of each ray intervals take to be inside of supports than is, as far as lengths of chords tell.

    What supports cover is no longer than all chords together, nor than from the first end of them to the last. Where chords
    do not lie over one another it is as long as they are. Slabs that no cover was found of tell nothing.
    """
    cover = gathered.cover
    assert cover.length is not None
    lines = Lines.of(dataclasses.replace(task, part=None))
    first, last = ((lines.middle + end)[:, 0] for end in (lines.front, lines.back))
    taken = (intervals_between(gathered, task)[-1].share * (task.depth[:, 1:] - task.depth[:, :-1])[..., None]).sum(1)
    hull = greater(0, lesser(cover.back, last) - greater(cover.front, first))
    covered = lesser(cover.length, hull).sum(0)
    known = covered > 0
    over = jnp.where(known, greater(0, taken - covered), 0)
    if task.part is not None:
        return over
    apart = (cover.length <= (1 + BESIDE) * hull).all(0)
    return over + jnp.where(known & apart, greater(0, covered - taken), 0)


def missed_thickness(gathered: SumsBetween, task: SlabTask, tables: MeanTables) -> Float[Array, "tasks rays"]:
    """The same, as optical thickness: of the larger mean extinction between the ends of the two pieces."""
    cover, reference = gathered.cover, task.entry.references[-1][:, None]
    near, far = (reference + end for end in cover.others or (cover.of_front, cover.of_back))
    (extinction,) = mean_light(tables, near, far, slice(EXTINCTION, EXTINCTION + 1))
    length = task.border[:, -1:] - task.border[:, :1]
    slant = task.path().sum(1) / jnp.where(length > 0, length, 1)
    return jnp.where(cover.front < cover.back, extinction, 0).max(0) * slant * missed_length(gathered, task)


def _intervals(sums: list[Array], cover: Cover, depth: Array, task: SlabTask) -> list[Intervals]:
    weight, *several = sums
    covers = [cover, cover._replace(of_front=cover.others[0], of_back=cover.others[1])] if cover.others else [cover]
    found = []
    for weighted, own, of_entry in zip(several, covers, task.entry.references, strict=True):
        near, far, share = intervals_of(ratio(weighted, weight), weight > 0, own, depth, task.part)
        reference = of_entry[:, None, None]
        found.append(Intervals(reference + near, reference + far, share))
    return found


def pull_means(gathered: SumsBetween, parts: tuple[Segments, ...], task: SlabTask, cotangents: list[Array]) -> MeanCotangents:
    """From cotangents of means of emission and extinction to those of what they were made of."""

    def means(sums: list[Array], cover: Cover, depth: Array, transfers: list[TransferFunction]) -> list[Array]:
        tables = tuple(MeanTables.of(transfer.segments()) for transfer in transfers)
        return means_by(tables, looked_up(tables, _intervals(sums, cover, depth, task)), slice(0, 4))

    transfers = [TransferFunction(segments.start, segments.base[:3].T, segments.base[3]) for segments in parts]
    given = by_rays(gathered.sums), gathered.cover, task.depth, transfers
    return MeanCotangents(*jax.vjp(means, *given)[1](cotangents))


def pull_cover(
    table: Float[Array, "particles 8"],
    ordered: Ordered,
    rank: Int[Array, " pairs"],
    task: SlabTask,
    gathered: SumsBetween,
    of_cover: Cover,
) -> tuple[Float[Array, "particles 8"], Float[Array, ""]]:
    """Add to `table` the cotangents of particles by the borders that they make; and that of a common factor of u and v."""
    inside = by_rays(gathered.sums)[0] > 0

    def pull_some(items: Array, some: SlabTask, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        table, factor = carry
        here = jnp.minimum(items, inside.shape[0] - 1)
        places, _ = ends_of(ordered, rank, some, gathered.cover.pivot[here], "place")
        for piece in range(2):
            mine = Ends(*(value[piece] for value in places))
            cotangent = Ends(*(value[piece, here] for value in of_cover[:4]))
            others = [value[piece, here] for value in of_cover.others]
            of_front = [cotangent.front, cotangent.of_front, *others[:1]]
            of_back = [cotangent.back, cotangent.of_back, *others[1:]]
            for sign, end, place, of_end in ((-1, mine.front, mine.of_front, of_front), (1, mine.back, mine.of_back, of_back)):
                found = (jnp.abs(end) < jnp.finfo(end.dtype).max) & (items < inside.shape[0])[:, None]
                given = tuple(jnp.where(found, value, 0) for value in of_end)
                table, more = _pull_end(table, ordered, rank, some, place.astype(jnp.int32), sign, given)
                factor = factor + more
        return table, factor

    return over_groups(pull_some, (table, jnp.zeros((), table.dtype)), task, inside)


def _pull_end(
    table: Array, ordered: Ordered, rank: Array, task: SlabTask, place: Array, sign: int, cotangents: tuple[Array, ...]
) -> tuple[Array, Array]:
    """The same of one end of a piece of each ray, made by the particle at a `place` in the windows."""
    entry = task.entry
    particle, _ = particle_at(rank, entry.begin[..., None], entry.length[..., None], place)
    columns = tuple(getattr(ordered, name)[particle] for name in COLUMNS[:5])

    def end(columns: tuple[Array, ...], factor: Array) -> Array:
        return chord_end(columns, dataclasses.replace(task, u=task.u * factor, v=task.v * factor), sign)

    of_end, *of_quantities = cotangents
    of_columns, factor = jax.vjp(end, columns, jnp.ones((), table.dtype))[1](of_end)
    found = [*of_columns, *of_quantities]
    row = jnp.stack([*found, *[jnp.zeros_like(of_end)] * (WIDTH - len(found))], -1)
    return table.at[particle.ravel()].add(row.reshape(-1, WIDTH), mode="promise_in_bounds"), factor


def chord_end(columns: tuple[Array, ...], task: SlabTask, sign: int) -> Float[Array, "tasks rays"]:
    """Depth at which each ray enters (`sign` -1) or leaves (1) a support of its own: x, y, z, scale and size (tasks, rays)."""
    (x, y, z, scale, size), (u, v) = columns, task.ray_coordinates()
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
