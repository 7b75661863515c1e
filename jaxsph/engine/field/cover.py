r"""Where rays are inside of supports, between the samples: the ends of the pieces of a ray that any support covers.

Flow: schedule, sums -> [cover] -> media.

A ray is inside a support between $t - h$ and $t + h$, with t the depth of the foot of the support's centre on the ray, and
$h = \sqrt{(H^2 - b^2) / |d|^2}$ where it passes at distance b. Between an inner sample and an outer one lies a border: the first
beginning of all such chords, or their last end. A chord lies wholly in front of an outer sample or behind it. So in each slab one
outer sample of each ray is its *pivot*, or where there may be a gap between two inner ones; and the chords in front of it and
those behind it are a piece each, or one where they overlap. Where both are connected, as is all but always so in a few samples,
their ends are exact, and what one sample sees of a border is as good as what a thousand see.

Only slabs are looked at that have an outer sample or one that may lie within half a sample of a border (`bordered`), `GROUP` at a
time; of others all counts. Depths are taken relative to the middle of a slab, and positions to where each ray is there, such that
nothing large cancels; and the parts of them that columns and rows share are found once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.view import Ordered
from jaxsph.engine.field.sums import Block, fetch, known_at, particle_at
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.numerics.compiled import apart_of, fusion_barrier, greater, lesser, together_of

Carry = TypeVar("Carry")
GROUP = 32  # slabs whose chords are held at once
BLOCK = 16  # particles of each, unrolled
BESIDE = 0.4  # see `bordered`
EXTREMES = (True, True), (True, False), (False, True), (False, False)  # whether in front of the pivot, and whether a front


class Cover(NamedTuple):
    """The pieces of rays in slabs in front of a pivot, and behind it; where there is none its front is behind its back.

    Attributes:
        front, back: depths between which supports cover rays, cut off at no border of the slab.
        of_front, of_back: which particles make them: places in the windows of slabs, as floating numbers.
    """

    front: Float[Array, "2 tasks rays"]
    back: Float[Array, "2 tasks rays"]
    of_front: Float[Array, "2 tasks rays"]
    of_back: Float[Array, "2 tasks rays"]

    def length(self, begin: Float[Array, "..."], end: Float[Array, "..."]) -> Float[Array, "..."]:
        """How much is covered of each of some parts of rays, (tasks, parts, rays)."""
        first, second = (
            greater(0, lesser(end, back[:, None]) - greater(begin, front[:, None]))
            for front, back in zip(self.front, self.back, strict=True)
        )
        return first + second


class Lines(NamedTuple):
    """Rays of slabs, by columns (tasks, 1, columns) and rows (tasks, rows, 1) that broadcast.

    Attributes:
        u, v: lateral coordinates at the middle of the slab; `slope_u`, `slope_v`: a unit of depth.
        middle: its depth; `front`, `back`: of the slab's borders relative to it or, where only a part counts, of that.
        inverse: 1 / (length of the rays a unit of depth, squared).
    """

    u: Array
    v: Array
    slope_u: Array
    slope_v: Array
    middle: Array
    front: Array
    back: Array
    inverse: Array

    @classmethod
    def of(cls, task: SlabTask) -> Lines:
        """Of the slabs of a task."""
        u, v = task.u[:, None, :], task.v[:, None, :] if task.scattered else task.v[:, :, None]
        first, last = task.border[:, 0, None, None], task.border[:, -1, None, None]
        middle = 0.5 * (first + last)
        slope_u, slope_v = (u, v) if task.perspective else (jnp.zeros_like(u), jnp.zeros_like(v))
        scale = middle if task.perspective else jnp.ones_like(middle)
        inverse = 1 / (1 + slope_u**2 + slope_v**2)
        front, back = first, last
        if task.part is not None:
            shape = jnp.broadcast_shapes(u.shape, v.shape)
            front, back = (end.reshape(shape) for end in lax.stop_gradient(task.part_ends()))
        return cls(u * scale, v * scale, slope_u, slope_v, middle, front - middle, back - middle, inverse)


def bordered(weight: Float[Array, "tasks samples rays"], edge: int) -> tuple[Bool[Array, "tasks samples rays"], ...]:
    """Samples that are outer ones; that may lie within half a sample of a border behind them; and of one in front of them.

    Near a border, weights fall with their distance to it to the power of `edge` (`Kernel.edge`): from one sample to the next,
    that lies within half a step of it, to a third to that power at least. `BESIDE` is more, for supports of few samples. A gap
    between two inner samples has a border within half a sample of one of them.
    """
    outer, most = weight <= 0, BESIDE**edge
    if weight.shape[1] == 1:
        return outer, ~outer, ~outer
    none = jnp.zeros_like(outer[:, :1])
    falls = jnp.concatenate([none, weight[:, 1:] <= most * weight[:, :-1]], 1)
    rises = jnp.concatenate([weight[:, :-1] <= most * weight[:, 1:], none], 1)
    return outer, falls & ~outer, rises & ~outer


def pivot_of(weight: Float[Array, "tasks samples rays"], edge: int, task: SlabTask) -> Float[Array, "tasks rays"]:
    """Depth that tells pieces of a ray apart: the first outer sample behind an inner one, else the last in front.

    Where all are inner ones, the middle between two that may have a gap between them, or an end of the slab that may have one in
    front; infinite where there are none. Samples of which no part counts are neither inner nor outer.
    """
    (outer, falls, rises), depth, ends = bordered(weight, edge), task.depth, task.border[:, :: task.border.shape[1] - 1, None]
    outside, inside = (one if task.part is None else one & (task.part.share > 0) for one in (outer, ~outer))
    found = jnp.where(falls[:, -1], ends[:, 1], jnp.where(rises[:, 0], ends[:, 0], jnp.inf))
    for k in range(weight.shape[1] - 1, 0, -1):  # the first is what is left
        gap = (falls[:, k - 1] | rises[:, k]) & inside[:, k - 1] & inside[:, k]
        found = jnp.where(gap, 0.5 * (depth[:, k - 1, None] + depth[:, k, None]), found)
    met = jnp.zeros(found.shape, bool)
    done = met
    for k in range(weight.shape[1]):
        outer_one = outside[:, k] & ~done
        found = jnp.where(outer_one, depth[:, k, None], found)
        met = met | inside[:, k]
        done = done | (outer_one & met)
    return found


def over_groups(
    function: Callable[[Array, SlabTask, Carry], Carry],
    carry: Carry,
    task: SlabTask,
    inside: Bool[Array, "tasks samples rays"],
    most: int = GROUP,
) -> Carry:
    """Take all slabs with a ray that has a sample which is not `inside`, so many at a time.

    Args:
        function: `function(items, some, carry)`: numbers of slabs, one past the last for none, and those slabs.
    """
    outer = ~inside if task.part is None else ~inside & (task.part.share > 0)
    tasks, group = outer.shape[0], min(most, outer.shape[0])
    place = jnp.where(outer.any((1, 2)) & (task.entry.count > 0), jnp.arange(tasks, dtype=jnp.int32), tasks)
    order = jnp.concatenate([lax.sort(place), jnp.full(group, tasks, jnp.int32)])

    def take(state: tuple[Array, Carry]) -> tuple[Array, Carry]:
        first, carry = state
        items = lax.dynamic_slice(order, (first,), (group,))
        some = task.at(jnp.minimum(items, tasks - 1))
        length, count = (jnp.where(items < tasks, value, 0) for value in (some.entry.length, some.entry.count))
        some = dataclasses.replace(some, entry=dataclasses.replace(some.entry, length=length, count=count))
        return first + group, function(items, some, carry)

    return lax.while_loop(lambda state: order[state[0]] < tasks, take, (jnp.int32(0), carry))[1]


def rows_of(rows: Carry, items: Int[Array, " some"]) -> Carry:
    """What is known of some slabs: arrays whose first axis is slabs; of numbers past the last, anything."""
    return jax.tree.map(lambda of: known_at(of, jnp.minimum(items, of.shape[0] - 1)), rows)  # type: ignore[no-any-return]


def with_rows(rows: Carry, items: Int[Array, " some"], new: Carry) -> Carry:
    """The same with what became known of some slabs."""
    return jax.tree.map(lambda old, of: old.at[items].set(of, mode="drop", wrap_negative_indices=False), rows, new)  # type: ignore[no-any-return]


def cover_of(ordered: Ordered, rank: Array, task: SlabTask, pivot: Float[Array, "tasks rays"]) -> Cover:
    """The ends (2, tasks, rays) of all chords with their middles in front of the pivot, and behind it, as depths."""
    entry, lines = task.entry, Lines.of(task)
    shape = jnp.broadcast_shapes(lines.u.shape, lines.v.shape)
    apart = (pivot.reshape(shape) - lines.middle)[:, None]
    limit = float(jnp.finfo(pivot.dtype).max)
    far = jnp.asarray(limit, pivot.dtype)

    def add_block(nth: Array, so_far: list[Array]) -> list[Array]:
        index = nth * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)
        block = fusion_barrier(nth >= 0, lambda: fetch(ordered, *particle_at(rank, *task.nth_block(BLOCK, nth)), task.references))
        parts = fusion_barrier(nth >= 0, shared_parts, block, lines)
        begin, end = fusion_barrier(nth >= 0, chords, parts, lines)
        in_front = 0.5 * begin + 0.5 * end < apart
        return [
            _extreme(old, begin if front else end, in_front if ahead else ~in_front, index.astype(pivot.dtype), front)
            for old, (ahead, front) in zip(so_far, EXTREMES, strict=True)
        ]

    blocks = (entry.length.sum(0).max() + BLOCK - 1) // BLOCK
    nothing = jnp.zeros(shape, pivot.dtype)
    start = [together_of(nothing + (far if front else -far), nothing) for _, front in EXTREMES]
    found = [apart_of(one) for one in lax.fori_loop(0, blocks, add_block, start)]
    (front, of_front), (back, of_back) = (
        (jnp.stack(pair).reshape(2, *pivot.shape) for pair in zip(*found[first::2], strict=True)) for first in (0, 1)
    )
    middle = lines.middle[:, 0]
    met = front < far
    cover = Cover(jnp.where(met, front + middle, far), jnp.where(met, back + middle, -far), of_front, of_back)
    # pieces that reach over the pivot are the first, and there is none behind
    joined = cover.front[1] < cover.back[0]
    sooner, later = joined & (cover.front[1] < cover.front[0]), joined & (cover.back[1] > cover.back[0])
    ends = [jnp.where(which, one[1], one[0]) for which, one in zip((sooner, later, sooner, later), cover, strict=True)]
    rest = [jnp.where(joined, none, one[1]) for none, one in zip((limit, -limit, 0.0, 0.0), cover, strict=True)]
    return Cover(*(jnp.stack(pair) for pair in zip(ends, rest, strict=True)))


def shared_parts(block: Block, lines: Lines) -> tuple[Array, ...]:
    """What chords of a block of particles (tasks, block, rows, columns) have in common, by column and by row."""
    x, y, z, scale, size = (value[..., None, None] for value in (block.x, block.y, block.z, block.scale, block.size))
    x, y, z = x - lines.u[:, None], y - lines.v[:, None], z - lines.middle[:, None]
    solid = (scale > 0) & (size > 0)
    square = jnp.where(solid, (size / jnp.where(solid, scale, 1)) ** 2, -1)  # nothing is in a ball of less than no radius
    return x * lines.slope_u[:, None], y * lines.slope_v[:, None] + z, x * x, square - (y * y + z * z)


def chords(parts: tuple[Array, ...], lines: Lines) -> tuple[Array, Array]:
    """Where rays enter and leave particles, relative to the middle; far away in the wrong order where not in the slab."""
    along_u, along_v, x_square, rest = parts
    along = along_u + along_v
    foot = along * lines.inverse[:, None]
    inner = (rest - x_square) + along * foot
    half = jnp.sqrt(greater(0, inner) * lines.inverse[:, None])
    begin, end = foot - half, foot + half
    valid = (inner > 0) & (end > lines.front[:, None]) & (begin < lines.back[:, None])
    far = jnp.finfo(foot.dtype).max
    return jnp.where(valid, begin, far), jnp.where(valid, end, -far)


def _extreme(so_far: Any, ends: Array, mine: Array, labels: Array, front: bool) -> Any:
    """The first or last of a block's ends that are `mine`, and its label, or those so far."""
    value, label = apart_of(so_far)
    for k in range(BLOCK):
        here = ends[:, k]
        taken = mine[:, k] & (here < value if front else here > value)
        value, label = jnp.where(taken, here, value), jnp.where(taken, labels[k], label)
    return together_of(value, label)
