r"""The leaves along rays, one after the other, and what is between them skipped.

Flow: octree, rays -> [leaves_along] -> octree.

Where a ray leaves a leaf follows from the leaf's borders, which follow from its level (Kaehler, Abel & Hege 2007, section 3.2).
The next leaf is not looked for a little behind the border, where it may be missed: the integer coordinate of the axis that is
crossed is set from the border itself, and the others stay within the leaf and never go back. So every step advances at least
one integer coordinate, whatever rounds, and a ray ends after $3 \cdot 2^\mathrm{levels}$ steps at most.

No sphere is missed: coordinates along the ray, taken from where it enters the box, are off by some 8 eps of the box at most (a
quotient, a product and a sum of numbers that the box bounds, twice as the order of crossings may be swapped), 14 eps in distance.
So the exact point of the ray is no further than that from the leaf that is found for it, and spheres are in all leaves that
are less than `octree.ROUNDING` eps away from them. Where a ray enters the box is itself off by rounding, by eps of its distance
from the origin: as are all positions of samples on it.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.octree import Leaf, Octree

Cell = tuple[Int[Array, " rays"], ...]
Coordinates = list[Float[Array, " rays"]]


@dataclasses.dataclass(frozen=True)
class LeavesAlong:
    """Leaves along rays in their order.

    Attributes:
        entry, exit: of each leaf, as parameters of the ray: a position is origin + parameter * direction. Both are the same where
            less of the ray is in the leaf than rounding leaves of it.
        begin, length: its entries in `Octree.entry`; of length 0 past the last.
        level: its own.
        number: leaves of each ray.
        reached: up to which parameter a ray was followed: to its end, if there was room.
        ended: whether it was.
    """

    entry: Float[Array, "leaves rays"]
    exit: Float[Array, "leaves rays"]
    begin: Int[Array, "leaves rays"]
    length: Int[Array, "leaves rays"]
    level: Int[Array, "leaves rays"]
    number: Int[Array, " rays"]
    reached: Float[Array, " rays"]
    ended: Bool[Array, " rays"]


class _Walk(NamedTuple):
    """Where rays are: in which cell of the finest level, how far from where they entered the box, and what they met."""

    cell: Cell
    along: Float[Array, " rays"]
    active: Bool[Array, " rays"]
    number: Int[Array, " rays"]
    met: tuple[Array, ...]


def clip_to_box(
    octree: Octree, origin: Coordinates, direction: Coordinates, first: Array, last: Array
) -> tuple[Float[Array, " rays"], Float[Array, " rays"]]:
    """The part of rays between parameters `first` and `last` that lies in the box; empty where the first is not less."""
    for start, way, lower in zip(origin, direction, octree.lower, strict=True):
        moves = way != 0
        safe = jnp.where(moves, way, 1)
        sides = (lower - start) / safe, (lower + octree.side - start) / safe
        beside = ~moves & ((start < lower) | (start > lower + octree.side))
        first = jnp.where(moves, jnp.maximum(first, jnp.minimum(*sides)), jnp.where(beside, jnp.inf, first))
        last = jnp.where(moves, jnp.minimum(last, jnp.maximum(*sides)), last)
    return first, last


def leave(octree: Octree, cell: Cell, leaf: Leaf, start: Coordinates, way: Coordinates) -> tuple[Array, list[Array]]:
    """Where rays leave the leaf that holds a cell: the parameter, and that at which they cross its border along each axis.

    Rays are given in cells of the finest level: `start` and `way` are origin and direction.
    """
    side = 1 << (octree.levels - leaf.level)
    border = [(at & -side) + jnp.where(step > 0, side, 0) for at, step in zip(cell, way, strict=True)]
    crossed = [
        jnp.where(step != 0, (to - zero) / jnp.where(step != 0, step, 1), jnp.inf)
        for to, zero, step in zip(border, start, way, strict=True)
    ]
    return jnp.minimum(jnp.minimum(crossed[0], crossed[1]), crossed[2]), crossed


def step_out(octree: Octree, cell: Cell, leaf: Leaf, start: Coordinates, way: Coordinates) -> tuple[Array, Cell]:
    """The parameter at which rays leave a leaf, and the cell of the finest level behind; beside the box where they leave it."""
    exit, crossed = leave(octree, cell, leaf, start, way)
    side = 1 << (octree.levels - leaf.level)
    chosen, behind = jnp.zeros(exit.shape, bool), []
    for at, zero, step, when in zip(cell, start, way, crossed, strict=True):
        low = at & -side
        high = low + side - 1
        here = jnp.floor(jnp.clip(zero + jnp.where(jnp.isfinite(exit), exit, 0) * step, low, high)).astype(at.dtype)
        here = jnp.where(step > 0, jnp.maximum(here, at), jnp.where(step < 0, jnp.minimum(here, at), at))
        crosses = (when == exit) & jnp.isfinite(exit) & ~chosen
        chosen |= crosses
        behind.append(jnp.where(crosses, jnp.where(step > 0, high + 1, low - 1), here))
    return exit, tuple(behind)


def leaves_along(
    octree: Octree,
    origin: Coordinates,
    direction: Coordinates,
    first: Float[Array, " rays"],
    last: Float[Array, " rays"],
    max_leaves: int,
    *,
    with_empty: bool = False,
) -> LeavesAlong:
    """Leaves that rays pass between two parameters, in order, those without spheres left out.

    Args:
        octree: in whose space the rays are.
        origin, direction: coordinates x, y and z; directions of any length. A position is origin + parameter * direction.
        first, last: least and greatest parameter of each ray.
        max_leaves: that there is room for a ray; where there are more, `ended` is false, and one can go on from `reached`.
        with_empty: keep leaves without spheres too.

    Differentiation:
        None: which leaves are passed is held fixed, and so is where.
    """
    octree, origin, direction, first, last = lax.stop_gradient((octree, origin, direction, first, last))
    near, far = clip_to_box(octree, origin, direction, first, last)
    inside = near < far
    begun = jnp.where(inside, near, 0)
    cells = 1 << octree.levels
    at = octree.coordinates(*(start + begun * way for start, way in zip(origin, direction, strict=True)))
    start, way = [part * cells for part in at], [part * octree.rate * cells for part in direction]
    cell = tuple(jnp.clip(jnp.clip(jnp.floor(part), 0, cells - 1).astype(jnp.int32), 0, cells - 1) for part in start)
    span = jnp.where(inside, far - near, 0)
    shape, each = (max_leaves + 1, *inside.shape), jnp.arange(inside.size, dtype=jnp.int32).reshape(inside.shape)

    def turn(walk: _Walk) -> _Walk:
        leaf = octree.leaf_of(*walk.cell)
        exit, behind = step_out(octree, walk.cell, leaf, start, way)
        outside = [(place < 0) | (place >= cells) for place in behind]
        exit = jnp.where(outside[0] | outside[1] | outside[2], span, jnp.clip(exit, walk.along, span))
        wanted = walk.active & (exit > walk.along) & (with_empty | (leaf.length > 0))
        slot = jnp.where(wanted, walk.number, max_leaves)
        found = walk.along, exit, leaf.begin, leaf.length, leaf.level
        met = tuple(old.at[slot, each].set(value) for old, value in zip(walk.met, found, strict=True))
        number, goes_on = walk.number + wanted, walk.active & (exit < span)
        cell = tuple(jnp.where(goes_on, new, old) for new, old in zip(behind, walk.cell, strict=True))
        along = jnp.where(walk.active, exit, walk.along)
        return _Walk(cell, along, goes_on & (number < max_leaves), number, met)

    nothing = tuple(jnp.zeros(shape, kind) for kind in (span.dtype,) * 2 + (jnp.int32,) * 3)
    walk = _Walk(cell, jnp.zeros_like(span), inside, jnp.zeros(inside.shape, jnp.int32), nothing)
    walk = lax.while_loop(lambda walk: walk.active.any(), turn, walk)
    number = walk.number
    there = jnp.arange(max_leaves)[:, None] < number
    entry, exit, begin, length, level = (jnp.where(there, value[:max_leaves], 0) for value in walk.met)
    ended = walk.along >= span
    exit = jnp.where(exit >= span, far, near + exit)
    reached = jnp.where(inside, jnp.where(ended, far, near + walk.along), last)
    return LeavesAlong(
        jnp.where(there, near + entry, 0), jnp.where(there, exit, 0), begin, length, level, number, reached, ended | ~inside
    )


jax.tree_util.register_dataclass(
    LeavesAlong, data_fields=[field.name for field in dataclasses.fields(LeavesAlong)], meta_fields=[]
)
