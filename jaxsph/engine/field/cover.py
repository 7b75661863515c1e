r"""Where rays are inside of supports, between the samples: the ends of the pieces of a ray that any support covers.

Flow: schedule -> [cover] -> intervals -> media.

A ray is inside a support between $t - h$ and $t + h$, with t the depth of the foot of the support's centre on the ray, and
$h = \sqrt{(H^2 - b^2) / |d|^2}$ where it passes at distance b. Between an inner sample and an outer one lies a border: the first
beginning of all such chords, or their last end. A chord lies wholly in front of an outer sample or behind it. So in each slab one
outer sample of each ray is its *pivot*, and the chords in front of it and those behind it are a piece each: where both are
connected, as is all but always so in a few samples, their ends are exact, and what one sample sees of a border is as good as what
a thousand see. Of each end the quantity of the particle that makes it is found, too: close to a border no other particle has a
weight, so that is the field's limit there.

Only slabs with an outer sample are looked at, `GROUP` at a time. Depths are taken relative to the middle of a slab, and positions
to where each ray is there, such that nothing large cancels; and the parts of them that columns and rows share are found once.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.ordering import Ordered
from jaxsph.engine.field.fetch import Block, fetch, known_at, particle_at
from jaxsph.engine.field.sums import apart_of, together_of
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.numerics.extremes import greater, lesser
from jaxsph.numerics.fusion import fusion_barrier

Carry = TypeVar("Carry")
GROUP = 32  # slabs whose chords are held at once
BLOCK = 16  # particles of each, unrolled
EXTREMES = (True, True), (True, False), (False, True), (False, False)  # whether in front of the pivot, and whether a front


class Cover(NamedTuple):
    """The pieces of rays in slabs in front of a pivot, and behind it; where there is none its front is behind its back.

    Attributes:
        front, back: depths between which supports cover rays, cut off at no border of the slab.
        of_front, of_back: quantities of the particles that make them, relative to the slab's reference.
        pivot: depth of an outer sample; infinite where there is none.
        others: of two quantities, what `of_front` and `of_back` are of the second; nothing of one.
        length: of all chords in front of the pivot and behind it, cut off at the borders of the slab; nothing unless `measured`.
    """

    front: Float[Array, "2 tasks rays"]
    back: Float[Array, "2 tasks rays"]
    of_front: Float[Array, "2 tasks rays"]
    of_back: Float[Array, "2 tasks rays"]
    pivot: Float[Array, "tasks rays"]
    others: tuple[Float[Array, "2 tasks rays"], ...] = ()
    length: Float[Array, "2 tasks rays"] | None = None


class Ends(NamedTuple):
    """`Cover` without its pivot, and with labels of particles that may be others than quantities."""

    front: Float[Array, "2 tasks rays"]
    back: Float[Array, "2 tasks rays"]
    of_front: Float[Array, "2 tasks rays"]
    of_back: Float[Array, "2 tasks rays"]


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


def outer_pivot(
    inside: Bool[Array, "tasks samples rays"],
    depth: Float[Array, "tasks samples"],
    looked_at: Bool[Array, "tasks samples rays"] | None = None,
) -> Float[Array, "tasks rays"]:
    """Depth of the outer sample that tells pieces of a ray apart: the first behind an inner one, else the last in front.

    Samples that are not `looked_at` are neither.
    """
    outside = ~inside if looked_at is None else ~inside & looked_at
    inside = inside if looked_at is None else inside & looked_at
    samples = inside.shape[1]
    found = jnp.full(inside.shape[::2], jnp.inf, depth.dtype)
    met = jnp.zeros(inside.shape[::2], bool)
    done = met
    for k in range(samples):
        outer = outside[:, k] & ~done
        found = jnp.where(outer, depth[:, k, None], found)
        met = met | inside[:, k]
        done = done | (outer & met)
    return found


def cover_of(
    ordered: Ordered,
    rank: Int[Array, " pairs"],
    task: SlabTask,
    inside: Bool[Array, "tasks samples rays"],
    label: str = "quantity",
) -> Cover:
    """Find the pieces of all rays that have an outer sample.

    Args:
        label: `"quantity"`, or `"place"` for the number of a particle in the windows of its slab in place of that.
    """
    pivot = outer_pivot(inside, task.depth, None if task.part is None else task.looked_at())
    tasks, rays = pivot.shape
    far = jnp.finfo(pivot.dtype).max
    several = label == "quantity" and len(task.entry.references) > 1
    labels = 2 * len(task.entry.references) if several else 2
    rows = [far, far, -far, -far, *[0] * 2 * labels, *[0] * 2 * task.measured]
    nothing = jnp.asarray(rows, pivot.dtype)[None, :, None]  # to put rows takes long

    def find(items: Array, some: SlabTask, found: Array) -> Array:
        ends, length = ends_of(ordered, rank, some, pivot[jnp.minimum(items, tasks - 1)], "place" if several else label)
        labeled = (*ends[:2], *_quantities_at(ordered, rank, some, ends[2:])) if several else ends
        measured = () if length is None else (length,)
        return found.at[items].set(jnp.moveaxis(jnp.concatenate((*labeled, *measured)), 0, 1), mode="drop")

    found = over_groups(find, jnp.broadcast_to(nothing, (tasks, nothing.size, rays)), task, inside)
    front, back, of_front, of_back, *others = (jnp.moveaxis(found[:, k : k + 2], 1, 0) for k in range(0, nothing.size, 2))
    length = others.pop() if task.measured else None
    return Cover(front, back, of_front, of_back, pivot, tuple(others), length)


def _quantities_at(
    ordered: Ordered, rank: Int[Array, " pairs"], task: SlabTask, places: tuple[Array, ...]
) -> list[Float[Array, "2 tasks rays"]]:
    """Of particles at places in the windows of slabs, all quantities one after the other, relative to the slabs' references."""
    entry = task.entry
    particles = [particle_at(rank, entry.begin[..., None], entry.length[..., None], at.astype(jnp.int32))[0] for at in places]
    both = list(zip(ordered.quantities, entry.references, strict=True))
    return [quantity[particle] - reference[:, None] for quantity, reference in both for particle in particles]


def over_groups(
    function: Callable[[Array, SlabTask, Carry], Carry], carry: Carry, task: SlabTask, inside: Bool[Array, "tasks samples rays"]
) -> Carry:
    """Take all slabs with an outer sample, `GROUP` at a time.

    Args:
        function: `function(items, some, carry)`: numbers of slabs, one past the last for none, and those slabs.
    """
    outer = ~inside if task.part is None else ~inside & task.looked_at()
    tasks, group = outer.shape[0], min(GROUP, outer.shape[0])
    place = jnp.where(outer.any((1, 2)) & (task.entry.count > 0), jnp.arange(tasks, dtype=jnp.int32), tasks)
    order = jnp.concatenate([lax.sort(place), jnp.full(group, tasks, jnp.int32)])

    def some(state: tuple[Array, Carry]) -> tuple[Array, Carry]:
        first, carry = state
        items = lax.dynamic_slice(order, (first,), (group,))
        return first + group, function(items, taken(task, jnp.minimum(items, tasks - 1), items < tasks), carry)

    return lax.while_loop(lambda state: order[state[0]] < tasks, some, (jnp.int32(0), carry))[1]


def rows_of(rows: Carry, items: Int[Array, " some"]) -> Carry:
    """What is known of some slabs: arrays whose first axis is slabs; of numbers past the last, anything."""
    return jax.tree.map(lambda of: known_at(of, jnp.minimum(items, of.shape[0] - 1)), rows)  # type: ignore[no-any-return]


def with_rows(rows: Carry, items: Int[Array, " some"], new: Carry) -> Carry:
    """The same with what became known of some slabs."""
    return jax.tree.map(lambda old, of: old.at[items].set(of, mode="drop", wrap_negative_indices=False), rows, new)  # type: ignore[no-any-return]


def taken(task: SlabTask, items: Int[Array, " some"], real: Bool[Array, " some"]) -> SlabTask:
    """Some slabs of a task; of those that are not `real`, nothing is read."""
    some = task.at(items)
    length, count = jnp.where(real, some.entry.length, 0), jnp.where(real, some.entry.count, 0)
    return dataclasses.replace(some, entry=dataclasses.replace(some.entry, length=length, count=count))


def ends_of(
    ordered: Ordered, rank: Array, task: SlabTask, pivot: Float[Array, "tasks rays"], label: str
) -> tuple[Ends, Float[Array, "2 tasks rays"] | None]:
    """The ends (2, tasks, rays) of all chords in front of the pivot, and behind it, as depths; and see `Cover.length`."""
    entry, lines = task.entry, Lines.of(task)
    windows, references = (entry.begin[..., None], entry.length[..., None]), tuple(one[:, None] for one in entry.references)
    shape = jnp.broadcast_shapes(lines.u.shape, lines.v.shape)
    apart = (pivot.reshape(shape) - lines.middle)[:, None]
    far = jnp.asarray(jnp.finfo(pivot.dtype).max, pivot.dtype)

    def fetched(index: Array) -> tuple[Block, Array]:
        _, block = fetch(ordered, rank, windows, index, references)
        labels = block.quantities[0] if label == "quantity" else jnp.broadcast_to(index, block.x.shape).astype(pivot.dtype)
        return block, labels

    def add_block(nth: Array, so_far: list[Array]) -> list[Array]:
        block, labels = fusion_barrier(nth >= 0, fetched, nth * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32))
        parts = fusion_barrier(nth >= 0, shared_parts, block, lines)
        begin, end = fusion_barrier(nth >= 0, chords, parts, lines)
        found = [
            _extreme(old, begin if front else end, end < apart if ahead else end >= apart, labels, front)
            for old, (ahead, front) in zip(so_far, EXTREMES, strict=False)
        ]
        if not task.measured:
            return found
        inner = greater(0, lesser(end, lines.back[:, None]) - greater(begin, lines.front[:, None]))
        sides = end < apart, end >= apart
        return found + [old + jnp.where(mine, inner, 0).sum(1) for old, mine in zip(so_far[len(EXTREMES) :], sides, strict=True)]

    blocks = (entry.length.sum(0).max() + BLOCK - 1) // BLOCK
    nothing = jnp.zeros(shape, pivot.dtype)
    start = [together_of(nothing + (far if front else -far), nothing) for _, front in EXTREMES]
    after = lax.fori_loop(0, blocks, add_block, start + [nothing] * 2 * task.measured)
    found = [apart_of(one) for one in after[: len(EXTREMES)]]
    length = jnp.stack(after[len(EXTREMES) :]).reshape(2, *pivot.shape) if task.measured else None
    (front, of_front), (back, of_back) = (
        (jnp.stack(pair).reshape(2, *pivot.shape) for pair in zip(*found[first::2], strict=True)) for first in (0, 1)
    )
    middle = lines.middle[:, 0]
    met = front < far
    return Ends(jnp.where(met, front + middle, far), jnp.where(met, back + middle, -far), of_front, of_back), length


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
        value, label = jnp.where(taken, here, value), jnp.where(taken, labels[:, k, None, None], label)
    return together_of(value, label)
