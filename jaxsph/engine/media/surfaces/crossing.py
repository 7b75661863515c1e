r"""Where rays first cross a level of the field: between which two depths, and then to some roundings.

Flow: sums on borders -> [crossing: slabs -> intervals -> places -> bracket -> root] -> particle_surface.

The field is known at the borders of what samples stand for. A change of sign between two of them is a crossing. Where it is below
the level at both, particles' largest weights bound it in between (`field.piercing`): a slab in which even their sum is below the
level holds no surface, nor does such an interval; a theorem, but for the rounding of sums that are within some eps of the level.
In what is left the field is asked for at one place more, where it may be largest, and, if the level is not reached there but
nearly so, at the vertex of the parabola through the three: interval by interval from the front on, up to the first crossing.

Each of these looks at those slabs alone that the one before could not settle. Surfaces of volumes share `secant` and `newton`:
their field is read, not summed up, so they take the same few steps for all rays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from jaxsph.engine.field.cover import over_groups, rows_of, with_rows
from jaxsph.engine.field.piercing import Piercing, nth_row
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.shown import parts_of
from jaxsph.model.clips import Clip
from jaxsph.numerics.compiled import clamped
from jaxsph.numerics.trees import tree

NEAR = 0.95  # of the level: where a parabola through what is known reaches that, its vertex is asked for as well
TURNS = 2, 62, 0  # steps of false position: those after which most rays are done, then as many as there may be; and the look
ENOUGH = 0.5  # power of eps, as a share of the level, at which they end: a step of Newton's squares that
CLOSE = 2.0**7  # eps of the level that the field is off at a root: some times what sums over particles are rounded by
NOWHERE = -1.0  # number of no interval
GROUP = 16  # slabs that are searched at once: with 32, a tenth more time, as most groups are not full
DONE = 2.0  # in place of a side
ByPoint = Sequence[Float[Array, "..."]]


def secant(low: Array, high: Array, at_low: Array, at_high: Array) -> Array:
    """Where a straight line crosses zero, that has two values at two places."""
    change = at_low - at_high
    return low + clamped(jnp.where(change != 0, at_low / jnp.where(change != 0, change, 1), 0.5), 0, 1) * (high - low)


def newton(place: Array, off: Array, slope: Array) -> Array:
    """A step of Newton's to where nothing is `off` the level, by the slope at a place; none where that is 0."""
    return place - jnp.where(slope != 0, off / jnp.where(slope != 0, slope, 1), 0)


@tree()
class Bracket:
    """Depths before and behind the first crossing of rays, relative to the middle of a slab, and the field less the level there.

    Attributes:
        rows: what follows, one array such that it is one XLA kernel.
        interval: which of the slab's it is in, as floating numbers; `NOWHERE` where a ray does not cross.
        low, high, at_low, at_high: those depths, and the field there.
        side: which end moved last, -1 or 1, 0 at first; `DONE` where it shrinks no more.
    """

    rows: Float[Array, "tasks 6 rays"]
    interval, low, high, at_low, at_high, side = map(nth_row, range(6))

    @classmethod
    def between(cls, interval: Array, nth: Array, places: ByPoint, values: ByPoint) -> Bracket:
        """From the `nth` to the next of some points (each "... rays") of rays, with the field less the level there.

        Chosen point by point: of rows put side by side each would have a loop of its own in the XLA kernel.
        """
        row, dtype = np.arange(6)[:, None], values[0].dtype  # rows are known when compiling
        point, rows = nth[:, None] + (row + 1) % 2, jnp.zeros((), dtype)
        for k, (place, value) in enumerate(zip(places, values, strict=True)):
            rows = jnp.where(point == k, jnp.where(row < 3, place[:, None], value[:, None]), rows)
        interval = interval[:, None].astype(dtype)
        return cls(jnp.where(row == 0, interval, jnp.where(row == 5, jnp.where(interval >= 0, 0, DONE), rows)))

    @property
    def met(self) -> Bool[Array, "tasks rays"]:
        """Rays that cross."""
        return self.interval >= 0

    def secant(self) -> Float[Array, "tasks rays"]:
        """Where a straight line crosses."""
        return secant(self.low, self.high, self.at_low, self.at_high)


def first_crossings(
    rays_of: Callable[[SlabTask], Piercing],
    meets: Callable[[SlabTask], Bool[Array, " tasks"]],
    task: SlabTask,
    weight: Float[Array, "tasks borders rays"],
    level: Float[Array, ""],
    clip: Clip | None,
    exact: bool,
) -> Bracket:
    """Between which two depths rays first cross the level in slabs with samples on borders, given the field there.

    Where that need not be `exact`, nothing is looked for between two of them, unless a clip cuts what there is.

    Args:
        meets: slabs that may reach the level, by a bound of all of their rays.
    """
    inside = weight >= level
    found = _at_first(inside[:, 1:] != inside[:, :-1], relative(task), weight - level)
    if not exact and clip is None:
        return found

    def look(items: Array, some: SlabTask, so_far: Bracket) -> Bracket:
        inner, crossing = rows_of((weight, so_far), items)
        return with_rows(so_far, items, _within(rays_of(some), inner, level, clip, crossing))

    if clip is not None:
        unsettled = ~inside.all(1)
    else:  # what may cross between two borders at which it is outside; of slabs outside at all borders, by a bound of all
        below, outside = ~inside[:, 1:] & ~inside[:, :-1], ~inside.any((1, 2))
        unsettled = jnp.where(outside, meets(task), below.any((1, 2)))[:, None]
    return over_groups(look, found, task, ~unsettled[:, None], GROUP)


def _within(
    rays: Piercing, weight: Float[Array, "tasks borders rays"], level: Float[Array, ""], clip: Clip | None, found: Bracket
) -> Bracket:
    """First crossings of slabs: those on borders, `found`, or what lies in front of them between two borders."""
    border = relative(rays.task)
    upper, place = rays.bound(border, level)
    wanted = (weight[:, 1:] < level) & (weight[:, :-1] < level) & (upper >= level)
    cut = jnp.zeros_like(wanted)
    if clip is not None:  # what it has cut is looked into piece by piece, at its faces
        part = parts_of(rays.task, clip, rays.task.border, jnp.ones((), border.dtype))
        begin, length = border[:, :-1, None], (border[:, 1:] - border[:, :-1])[..., None]
        enters, leaves = (part.begin > 0) & (part.share > 0), (part.end < 1) & (part.share > 0)
        place = jnp.where(enters, begin + part.begin * length, jnp.where(leaves, begin + part.end * length, place))
        cut = enters | leaves
        wanted |= cut
        middle = jnp.broadcast_to(0.5 * (border[:, :-1] + border[:, 1:])[..., None], cut.shape)
        crossed = ((weight[:, 1:] >= level) != (weight[:, :-1] >= level)) & ~cut & clip.contains(rays.at(middle))
        found = _at_first(crossed, border, weight - level)
    number, ends = wanted.shape[1], border[..., None]
    of_intervals = ends[:, :-1], ends[:, 1:], weight[:, :-1], weight[:, 1:], place, cut
    known = jnp.stack([jnp.broadcast_to(of, cut.shape).astype(level.dtype) for of in of_intervals], 2)

    def next_of(carry: tuple[Array, Bracket]) -> tuple[Array, Array]:
        """The first interval to look into of each ray, and whether there is one in front of what was found."""
        left, so_far = carry
        nth = jnp.argmax(left, 1)
        before = jnp.where(so_far.met, so_far.interval, number)
        return nth, left.any(1) & (nth.astype(before.dtype) < before)

    def look(carry: tuple[Array, Bracket]) -> tuple[Array, Bracket]:
        left, so_far = carry
        nth, there = next_of(carry)
        places, values = _asked(rays, known, level, nth, there)
        halves = [((values[k] >= level) != (values[k + 1] >= level)) & there for k in (0, 1)]
        if clip is not None:
            middles = [rays.at(0.5 * (places[k] + places[k + 1])[:, None]) for k in (0, 1)]
            halves = [half & clip.contains(middle)[:, 0] for half, middle in zip(halves, middles, strict=True)]
        here = Bracket.between(nth, jnp.where(halves[0], 0, 1), places, [of - level for of in values])
        left &= jnp.arange(number)[:, None] != nth[:, None]
        return left, Bracket(jnp.where((halves[0] | halves[1])[:, None], here.rows, so_far.rows))

    return lax.while_loop(lambda carry: next_of(carry)[1].any(), look, (wanted, found))[1]


def _asked(rays: Piercing, known: Array, level: Array, nth: Array, there: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """The ends of the `nth` interval of each ray and a place in between, and the field there; for rays where one is `there`.

    Args:
        known: of intervals their ends, the field there, which place is to be asked for, and whether that is a clip's face.
    """
    *given, wanted, cut = jnp.moveaxis(jnp.take_along_axis(known, nth[:, None, None], 1)[:, 0], 1, 0)
    at, ends, uncut = given[:2], given[2:], there & (cut == 0)

    def ask(carry: tuple[Array, Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array, Array]:
        at_first, asked, new, place, value = carry
        place, value = jnp.where(asked, new, place), jnp.where(asked, rays.weights(new), value)
        # where the parabola through three points is highest, and how high; the middle one where that is not between the others
        before, behind = place - at[0], at[1] - place
        rise, fall = (value - ends[0]) * behind, (value - ends[1]) * before
        bent = (before > 0) & (behind > 0) & (rise + fall > 0)
        total = jnp.where(bent, rise + fall, 1)
        move = jnp.where(bent, 0.5 * (rise * behind - fall * before) / total, 0)
        between = (-before < move) & (move < behind)
        curve = jnp.where(bent, total / jnp.where(bent, before * behind * (at[1] - at[0]), 1), 0)
        vertex, peak = jnp.where(between, place + move, place), jnp.where(between, value + curve * move**2, value)
        near = at_first & uncut & (value < level) & (vertex != place) & (peak >= NEAR * level)
        return jnp.zeros((), bool), near, vertex, place, value

    nothing = jnp.zeros_like(ends[0])
    *_, place, value = lax.while_loop(lambda carry: carry[1].any(), ask, (jnp.ones((), bool), there, wanted, nothing, nothing))
    return (at[0], place, at[1]), (ends[0], value, ends[1])


def at_crossings(
    rays_of: Callable[[SlabTask], Piercing],
    task: SlabTask,
    bracket: Bracket,
    level: Float[Array, ""],
    look: Callable[[Bracket, Piercing, Array], Float[Array, "tasks rows rays"]],
    num_rows: int,
    exact: bool,
) -> Float[Array, "tasks rows rays"]:
    """What a look finds where rays cross, once their brackets are narrowed; 0 for those that do not.

    By false position, in the Illinois form (Dahlquist & Bjoerck 1974, section 6.2): an end that stays twice weighs half. Newton's
    step from their secant is then to some roundings of a root. Most rays take two steps; slabs with one that takes more are taken
    again, then all are looked at. Rays that graze the surface are not at a root by that: where the field has hardly a slope,
    Newton's step leads away. For them all is done once more, until the secant is the root, `CLOSE`. It is one loop of six turns,
    each for slabs chosen anew: six loops would be compiled six times.

    Args:
        look: `look(bracket, rays, again)`: rows, the last of which says how far the field is off the level there; `again` where
            the secant is the root.
        exact: whether brackets are narrowed at all.
    """
    eps = float(jnp.finfo(level.dtype).eps)

    def off(found: Array) -> Array:
        return jnp.abs(lax.stop_gradient(found[:, -1])) > CLOSE * eps * level

    def turn(nth: Array, carry: tuple[Bracket, Array]) -> tuple[Bracket, Array]:
        again, steps = nth >= len(TURNS), jnp.asarray(2 * TURNS if exact else TURNS[-1:])[nth]
        looks, enough = steps == 0, level * jnp.where(again, CLOSE * eps, eps**ENOUGH)

        def asked(search: Bracket, found: Array) -> Array:
            return jnp.where(looks, jnp.where(again, off(found), search.met), search.side < DONE)

        def of_some(items: Array, some: SlabTask, carry: tuple[Bracket, Array]) -> tuple[Bracket, Array]:
            (here, found), rays = rows_of(carry, items), rays_of(some)
            still = lax.stop_gradient(rays)

            def step(state: tuple[Bracket, Array]) -> tuple[Bracket, Array]:
                return _stepped(still, state[0], level, enough), state[1] + 1

            here = lax.while_loop(lambda state: (state[1] < steps) & (state[0].side < DONE).any(), step, (here, jnp.int32(0)))[0]
            there = asked(here, found)[:, None]
            found = lax.cond(looks, lambda: jnp.where(there, look(here, rays, again), found), lambda: found)
            side = jnp.where(looks, jnp.where(off(found), 0, DONE), here.side)
            return with_rows(carry, items, (Bracket(here.rows.at[:, 5].set(side)), found))

        return over_groups(of_some, carry, task, ~asked(*carry)[:, None], GROUP)

    tasks, _, rays = bracket.rows.shape
    start = bracket, jnp.zeros((tasks, num_rows, rays), level.dtype)
    return lax.fori_loop(0, 2 * len(TURNS) if exact else 1, turn, start)[1]


def _stepped(rays: Piercing, ends: Bracket, level: Array, enough: Array) -> Bracket:
    """With the field asked for where a straight line crosses, of the rays whose brackets still shrink."""
    place = ends.secant()
    here = rays.weights(place) - level
    behind = (here >= 0) == (ends.at_low >= 0)  # the crossing lies behind
    side = jnp.where(behind, 1, -1).astype(here.dtype)
    kept = jnp.where(side == ends.side, 0.5, 1).astype(here.dtype)
    row = np.arange(6)[:, None]
    places, moved = row < 3, (row % 2 == 1) == behind[:, None]
    rows = jnp.where(moved, jnp.where(places, place[:, None], here[:, None]), jnp.where(places, 1, kept[:, None]) * ends.rows)
    rows = jnp.where(row == 5, jnp.where(jnp.abs(here) > enough, side, DONE)[:, None], rows)
    return Bracket(jnp.where((ends.side < DONE)[:, None] & (row > 0), rows, ends.rows))  # whatever other rays take


def relative(task: SlabTask) -> Float[Array, "tasks borders"]:
    """Borders relative to the middle of slabs, as depths of `Piercing` are."""
    return task.border - 0.5 * (task.border[:, :1] + task.border[:, -1:])


def _at_first(
    crossed: Bool[Array, "tasks intervals rays"], border: Float[Array, "tasks borders"], value: Float[Array, "tasks borders rays"]
) -> Bracket:
    """The first interval that is `crossed`; where none is, at the ends of the last."""
    number, first = crossed.shape[1], jnp.full(crossed.shape[::2], int(NOWHERE))
    for k in range(number - 1, -1, -1):
        first = jnp.where(crossed[:, k], k, first)
    places, values = ([of[:, k] for k in range(number + 1)] for of in (border[..., None], value))
    return Bracket.between(first, jnp.where(first >= 0, first, number - 1), places, values)
