r"""Where rays cross a level of the field, first or each time: between which two depths, and then to some roundings.

Flow: sums on borders -> [crossing: slabs -> intervals -> places -> bracket -> narrowed] -> particle_surface.

The field is known at the borders of what samples stand for. A change of sign between two of them is a crossing. Where it is below
the level at both, particles' largest weights bound it in between (`field.piercing`): a slab in which even their sum is below the
level holds no surface, nor does such an interval; a theorem, but for the rounding of sums that are within some eps of the level.
In what is left the field is asked for at one place more, where it may be largest, and, if the level is not reached there but
nearly so, at the vertex of the parabola through the three: interval by interval from the front on, up to the first crossing.

That is the first crossing of each ray. Where rays go on, every interval is looked into, and two neighbouring depths of all that
are known hold a crossing each.

Each of these looks at those slabs alone that the one before could not settle: of some scenes' slabs in front of a surface 94 of
100 are settled by their first bound, and of those with one a third of all rays cross it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.field.cover import over_groups, rows_of, with_rows
from jaxsph.engine.field.piercing import Piercing
from jaxsph.engine.field.tasks import Part, SlabTask
from jaxsph.model.clips.clips import Clip
from jaxsph.numerics.extremes import clamped
from jaxsph.numerics.trees import tree

NEAR = 0.95  # of the level: where a parabola through what is known reaches that, its vertex is asked for as well
STEPS, FIRST = 64, 2  # of false position, at most, and those after which most rays are done
ENOUGH = 0.5  # power of eps, as a share of the level, at which they end: a step of Newton's squares that
CLOSE = 2.0**7  # eps of the level that the field is off at a root: some times what sums over particles are rounded by
NOWHERE = -1.0  # number of no interval


@tree()
class Bracket:
    """Depths before and behind the first crossing of rays, relative to the middle of a slab, and the field less the level there.

    Attributes:
        interval: which of the slab's it is in, as floating numbers; `NOWHERE` where a ray does not cross.
    """

    interval: Float[Array, "tasks rays"]
    low: Float[Array, "tasks rays"]
    high: Float[Array, "tasks rays"]
    at_low: Float[Array, "tasks rays"]
    at_high: Float[Array, "tasks rays"]

    @property
    def met(self) -> Bool[Array, "tasks rays"]:
        """Rays that cross."""
        return self.interval >= 0

    def secant(self) -> Float[Array, "tasks rays"]:
        """Where a straight line crosses."""
        change = self.at_low - self.at_high
        share = jnp.where(change != 0, self.at_low / jnp.where(change != 0, change, 1), 0.5)
        return self.low + clamped(share, 0, 1) * (self.high - self.low)


class Cut(NamedTuple):
    """A clip, and what it leaves of the intervals of slabs."""

    clip: Clip
    parts: Callable[[SlabTask], Part]


@tree()
class _Search:
    """Brackets of all rays, which end of each moved last, and rays whose brackets still shrink."""

    ends: Bracket
    side: Int[Array, "tasks rays"]
    active: Bool[Array, "tasks rays"]


class _Wanted(NamedTuple):
    """Intervals that are to be looked into, where, and whether that is a clip's face; and which a clip has cut."""

    intervals: Bool[Array, "tasks intervals rays"]
    place: Float[Array, "tasks intervals rays"]
    cut: Bool[Array, "tasks intervals rays"]


def first_crossings(
    rays_of: Callable[[SlabTask], Piercing],
    task: SlabTask,
    weight: Float[Array, "tasks borders rays"],
    level: Float[Array, ""],
    cut: Cut | None,
) -> Bracket:
    """Between which two depths rays first cross the level in slabs with samples on borders, given the field there."""
    inside = weight >= level
    found = _at_first(inside[:, 1:] != inside[:, :-1], (*_ends_of(task, weight), weight[:, :-1] - level, weight[:, 1:] - level))

    def look(items: Array, some: SlabTask, so_far: Bracket) -> Bracket:
        inner, crossing = rows_of((weight, so_far), items)
        return with_rows(so_far, items, _within(rays_of(some), inner, level, cut, crossing))

    return over_groups(look, found, task, ~_looked_at(rays_of, task, inside, level, cut)[:, None])


def all_crossings(
    rays_of: Callable[[SlabTask], Piercing],
    task: SlabTask,
    weight: Float[Array, "tasks borders rays"],
    level: Float[Array, ""],
    cut: Cut | None,
) -> Bracket:
    """Between which two depths rays cross the level each time: of each interval its two parts, on a first axis.

    See `first_crossings`; a part that is not crossed is `NOWHERE`, and an interval that is not looked into is all of its first.
    """
    asked = _ends_of(task, weight)[1], weight[:, 1:]

    def look(items: Array, some: SlabTask, so_far: tuple[Array, Array]) -> tuple[Array, Array]:
        inner, known = rows_of((weight, so_far), items)
        return with_rows(so_far, items, _each_asked(rays_of(some), inner, level, cut, known))

    place, value = over_groups(look, asked, task, ~_looked_at(rays_of, task, weight >= level, level, cut)[:, None])
    begin, end = _ends_of(task, weight)
    parts = []
    for low, high, at_low, at_high in ((begin, place, weight[:, :-1], value), (place, end, value, weight[:, 1:])):
        crossed = (at_low >= level) != (at_high >= level)
        if cut is not None:
            crossed &= cut.clip.contains(rays_of(task).lines.at(0.5 * (low + high)))
        number = jnp.where(crossed, jnp.arange(low.shape[1], dtype=low.dtype)[:, None], NOWHERE)
        parts.append(Bracket(number, low, high, at_low - level, at_high - level))

    def in_order(*both: Array) -> Array:
        tasks, _, rays = both[0].shape
        return jnp.stack(both, 2).transpose(1, 2, 0, 3).reshape(-1, tasks, rays)

    return jax.tree.map(in_order, *parts)  # type: ignore[no-any-return]


def _looked_at(
    rays_of: Callable[[SlabTask], Piercing],
    task: SlabTask,
    inside: Bool[Array, "tasks borders rays"],
    level: Float[Array, ""],
    cut: Cut | None,
) -> Bool[Array, "tasks rays"]:
    """Rays that may cross between two borders at which they are outside: slabs with one are looked into."""
    if cut is not None:
        return ~inside.all(1)
    tasks, _, rays = inside.shape
    below, outside = ~inside[:, 1:] & ~inside[:, :-1], ~inside.any((1, 2))
    bounded = over_groups(_slab_bounds(rays_of), jnp.zeros((tasks, rays), level.dtype), task, ~outside[:, None, None])
    return jnp.where(outside[:, None], bounded >= level, below.any(1))


def _ends_of(task: SlabTask, weight: Float[Array, "tasks borders rays"]) -> tuple[Float[Array, "tasks intervals rays"], ...]:
    """Where the intervals of all rays begin, and where they end."""
    shape = weight[:, 1:].shape
    return tuple(jnp.broadcast_to(at[..., None], shape) for at in (_relative(task)[:, :-1], _relative(task)[:, 1:]))


def _slab_bounds(rays_of: Callable[[SlabTask], Piercing]) -> Callable[[Array, SlabTask, Array], Array]:
    """Of the field in whole slabs."""

    def bound(items: Array, some: SlabTask, so_far: Array) -> Array:
        border = _relative(some)
        upper = rays_of(some).upper(jnp.stack([border[:, 0], border[:, -1]], 1))[:, 0]
        return with_rows(so_far, items, upper)

    return bound


def _within(
    rays: Piercing, weight: Float[Array, "tasks borders rays"], level: Float[Array, ""], cut: Cut | None, found: Bracket
) -> Bracket:
    """First crossings of slabs: those on borders, `found`, or what lies in front of them between two borders."""
    border = _relative(rays.task)
    wanted = _wanted(rays, border, weight, level, cut)
    if cut is not None:  # what a clip has cut is looked into piece by piece
        whole = _ends_of(rays.task, weight)
        crossed = ((weight[:, 1:] >= level) != (weight[:, :-1] >= level)) & ~wanted.cut
        crossed &= cut.clip.contains(rays.lines.at(0.5 * (whole[0] + whole[1])))
        found = _at_first(crossed, (*whole, weight[:, :-1] - level, weight[:, 1:] - level))
    number = wanted.place.shape[1]

    def next_of(carry: tuple[Array, Bracket]) -> tuple[Array, Array]:
        """The first interval to look into of each ray, and whether there is one in front of what was found."""
        left, so_far = carry
        nth = jnp.argmax(left, 1)
        before = jnp.where(so_far.met, so_far.interval, number)
        return nth, left.any(1) & (nth.astype(before.dtype) < before)

    def look(carry: tuple[Array, Bracket]) -> tuple[Array, Bracket]:
        left, so_far = carry
        nth, there = next_of(carry)
        places, values = _asked(rays, weight, level, wanted, nth, there)
        crossed = ((values[:, 1:] >= level) != (values[:, :-1] >= level)) & there[:, None]
        if cut is not None:
            crossed &= cut.clip.contains(rays.lines.at(0.5 * (places[:, 1:] + places[:, :-1])))
        here = _at_first(crossed, (places[:, :-1], places[:, 1:], values[:, :-1] - level, values[:, 1:] - level))
        here = Bracket(nth.astype(values.dtype), here.low, here.high, here.at_low, here.at_high)
        met = crossed.any(1)
        left &= jnp.arange(number)[:, None] != nth[:, None]
        return left, jax.tree.map(lambda new, old: jnp.where(met, new, old), here, so_far)

    return lax.while_loop(lambda carry: next_of(carry)[1].any(), look, (wanted.intervals, found))[1]


def _each_asked(
    rays: Piercing,
    weight: Float[Array, "tasks borders rays"],
    level: Float[Array, ""],
    cut: Cut | None,
    known: tuple[Array, Array],
) -> tuple[Array, Array]:
    """A place in each interval that is to be looked into, and the field there; of others what is `known`."""
    wanted = _wanted(rays, _relative(rays.task), weight, level, cut)

    def look(carry: tuple[Array, tuple[Array, Array]]) -> tuple[Array, tuple[Array, Array]]:
        left, known = carry
        nth, there = jnp.argmax(left, 1), left.any(1)
        places, values = _asked(rays, weight, level, wanted, nth, there)
        here = (jnp.arange(left.shape[1])[:, None] == nth[:, None]) & there[:, None]
        found = tuple(jnp.where(here, of[:, 1:2], old) for of, old in zip((places, values), known, strict=True))
        return left & ~here, found  # type: ignore[return-value]

    return lax.while_loop(lambda carry: carry[0].any(), look, (wanted.intervals, known))[1]


def _asked(
    rays: Piercing, weight: Float[Array, "tasks borders rays"], level: Float[Array, ""], wanted: _Wanted, nth: Array, there: Array
) -> tuple[Float[Array, "tasks three rays"], Float[Array, "tasks three rays"]]:
    """The ends of the `nth` interval of each ray and a place in between, and the field there; for rays where one is `there`."""

    def of_ray(of_intervals: Array) -> Array:
        return jnp.take_along_axis(of_intervals, nth[:, None], 1)[:, 0]

    border = _relative(rays.task)
    at = tuple(jnp.take_along_axis(border, nth + k, 1) for k in (0, 1))
    ends = of_ray(weight[:, :-1]), of_ray(weight[:, 1:])
    place, is_cut = of_ray(wanted.place), of_ray(wanted.cut)
    value = rays.weights(place)
    vertex, peak = _vertex((at[0], place, at[1]), (ends[0], value, ends[1]))
    near = there & ~is_cut & (value < level) & (vertex != place) & (peak >= NEAR * level)
    again = lax.cond(near.any(), lambda: rays.weights(vertex), lambda: value)
    place, value = jnp.where(near, vertex, place), jnp.where(near, again, value)
    return jnp.stack([at[0], place, at[1]], 1), jnp.stack([ends[0], value, ends[1]], 1)


def _wanted(rays: Piercing, border: Array, weight: Array, level: Array, cut: Cut | None) -> _Wanted:
    """What is to be looked into."""
    bound = rays.bound(border, level)
    below = (weight[:, 1:] < level) & (weight[:, :-1] < level)
    intervals, place = below & (bound.upper >= level), bound.place
    if cut is None:
        return _Wanted(intervals, place, jnp.zeros_like(intervals))
    part = cut.parts(rays.task)
    begin, length = border[:, :-1, None], (border[:, 1:] - border[:, :-1])[..., None]
    enters, leaves = (part.begin > 0) & (part.share > 0), (part.end < 1) & (part.share > 0)
    place = jnp.where(enters, begin + part.begin * length, jnp.where(leaves, begin + part.end * length, place))
    return _Wanted(intervals | enters | leaves, place, enters | leaves)


def narrowed(
    rays_of: Callable[[SlabTask], Piercing],
    task: SlabTask,
    bracket: Bracket,
    level: Float[Array, ""],
    active: Bool[Array, "tasks rays"] | None = None,
) -> Bracket:
    """Brackets of the rays that cross by false position: Newton's step from their secant is to some roundings of a root.

    It is the Illinois form (Dahlquist & Bjoerck 1974, section 6.2): an end that stays twice weighs half. Most rays take two
    steps; slabs with one that takes more are looked at again.

    Args:
        active: rays that go on until the secant is the root, `CLOSE`, as those do that graze the surface: where the field has
            hardly a slope, Newton's step leads away. None is all, for that step.
    """
    eps = float(jnp.finfo(level.dtype).eps)
    enough = level * (eps**ENOUGH if active is None else CLOSE * eps)

    def narrow(search: _Search, most: int) -> _Search:
        def of_some(items: Array, some: SlabTask, all_rays: _Search) -> _Search:
            rays = rays_of(some)

            def step(carry: tuple[_Search, Array]) -> tuple[_Search, Array]:
                of, number = carry
                return _stepped(rays, of, level, enough), number + 1

            start = rows_of(all_rays, items), jnp.int32(0)
            here = lax.while_loop(lambda carry: (carry[1] < most) & carry[0].active.any(), step, start)[0]
            return with_rows(all_rays, items, here)

        return over_groups(of_some, search, task, ~search.active[:, None])

    found = _Search(bracket, jnp.zeros(bracket.low.shape, jnp.int32), bracket.met if active is None else active)
    for most in (FIRST, STEPS - FIRST):
        found = narrow(found, most)
    return found.ends


def _stepped(rays: Piercing, search: _Search, level: Array, enough: Array) -> _Search:
    """With the field asked for where a straight line crosses, of the rays whose brackets still shrink."""
    ends, active = search.ends, search.active
    place = ends.secant()
    here = rays.weights(place) - level
    behind = (here >= 0) == (ends.at_low >= 0)  # the crossing lies behind
    side = jnp.where(behind, 1, -1).astype(search.side.dtype)
    kept = jnp.where(side == search.side, 0.5, 1).astype(here.dtype)
    moving = Bracket(
        ends.interval,
        jnp.where(behind, place, ends.low),
        jnp.where(behind, ends.high, place),
        jnp.where(behind, here, kept * ends.at_low),
        jnp.where(behind, kept * ends.at_high, here),
    )
    ends = jax.tree.map(lambda old, new: jnp.where(active, new, old), ends, moving)  # whatever other rays take
    return _Search(ends, side, active & (jnp.abs(here) > enough))


def _relative(task: SlabTask) -> Float[Array, "tasks borders"]:
    """Borders relative to the middle of slabs, as `SlabRays.middle` is."""
    return task.border - 0.5 * (task.border[:, :1] + task.border[:, -1:])


def _at_first(crossed: Bool[Array, "tasks intervals rays"], rows: tuple[Array, ...]) -> Bracket:
    """The first interval that is `crossed`, and of four rows those there; of the last, where none is."""
    number = crossed.shape[1]
    first = jnp.full(crossed.shape[::2], NOWHERE, rows[2].dtype)
    found = [row[:, -1] for row in rows]
    for k in range(number - 1, -1, -1):
        first = jnp.where(crossed[:, k], k, first)
        found = [jnp.where(crossed[:, k], row[:, k], so_far) for row, so_far in zip(rows, found, strict=True)]
    return Bracket(first, *found)


def _vertex(places: tuple[Array, Array, Array], values: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Where a parabola through three points is highest, and how high; the middle one where that is not between the others."""
    (begin, middle, end), (first, value, last) = places, values
    before, behind = middle - begin, end - middle
    rise, fall = (value - first) * behind, (value - last) * before
    bent = (before > 0) & (behind > 0) & (rise + fall > 0)
    total = jnp.where(bent, rise + fall, 1)
    move = jnp.where(bent, 0.5 * (rise * behind - fall * before) / total, 0)
    between = (-before < move) & (move < behind)
    curve = jnp.where(bent, total / jnp.where(bent, before * behind * (end - begin), 1), 0)
    return jnp.where(between, middle + move, middle), jnp.where(between, value + curve * move**2, value)
