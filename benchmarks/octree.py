r"""An octree over spheres, built on the host: which of them can be at a place, and which a ray meets, leaf by leaf.

Every leaf lists all spheres that intersect it, and a node is split as long as more than eight of its spheres are no larger than
it (Kaehler, Abel & Hege 2007, section 3.1, who split for any eight: larger spheres are met by nearly all children, and would only
be copied). The uppermost levels are one dense grid. Children of a node are a block of eight; corners follow from whole
coordinates at the finest level, in which every place of the box is in exactly one leaf, whatever rounds.

Coordinates are those of the unit cube that the box stands for: nodes of level l begin at multiples of $2^{-l}$, exactly, and
places are off by some eps, by which radii are widened.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxsph.numerics.faults import CapacityError
from jaxsph.numerics.trees import tree

MOST = 8  # spheres of a leaf that fit into it
INNER = -1  # the length of a node that is split
MAX_TOP, MAX_LEVELS = 6, 14  # of the dense grid, and in all
PAIRS_PER_SPHERE = 5  # of the dense grid at most, and cells
ROUNDING = 32  # eps of the cube's side, and of their own, that radii are widened by
HALVES = np.indices((2, 2, 2)).reshape(3, 8).T  # of a node that children lie in, along each axis


class Leaf(NamedTuple):
    """Leaves: where their entries begin and how many there are, and their side in cells of the finest level."""

    begin: jax.Array
    length: jax.Array
    side: jax.Array


class Rays(NamedTuple):
    """Places `start + t way` of the unit cube, t from `begin` to `end`; none where those are in wrong order."""

    start: list[jax.Array]
    way: list[jax.Array]
    begin: jax.Array
    end: jax.Array

    def at(self, t: jax.Array) -> list[jax.Array]:
        """Places; of rays that have ended any."""
        t = jnp.where(t < jnp.inf, t, 0)
        return [zero + t * part for zero, part in zip(self.start, self.way, strict=True)]

    def to(self, axis: int, low: Any, high: Any) -> tuple[jax.Array, jax.Array]:
        """Where they cross the first and the second of two planes across an axis; of rays along these, infinitely far."""
        moves = jnp.abs(self.way[axis]) > jnp.finfo(self.begin.dtype).tiny ** 0.5
        inverse = 1 / jnp.where(moves, self.way[axis], 1)
        both = (low - self.start[axis]) * inverse, (high - self.start[axis]) * inverse
        inside = (self.start[axis] >= low) & (self.start[axis] <= high)
        first = jnp.where(moves, jnp.minimum(*both), jnp.where(inside, -jnp.inf, jnp.inf))
        return first, jnp.where(moves, jnp.maximum(*both), jnp.inf)

    def in_box(self) -> Rays:
        """Cut where the box begins and ends."""
        begin, end = zip(*(self.to(axis, 0, 1) for axis in range(3)), strict=True)
        return self._replace(
            begin=functools.reduce(jnp.maximum, begin, self.begin), end=functools.reduce(jnp.minimum, end, self.end)
        )


@tree(static=("top", "levels"))
class Octree:
    """Spheres by where they are; `build` makes it.

    Attributes:
        lower, side: of the box, a cube around all spheres.
        node: where entries of leaves begin, and how many there are; of others their first child, and `INNER`.
        entry: numbers of spheres, leaf by leaf.
        before: how many cells of the dense grid that a sphere meets lie before each corner.
        top, levels: of the dense grid, and of the smallest leaf.
    """

    lower: jax.Array
    side: jax.Array
    node: jax.Array
    entry: jax.Array
    before: jax.Array
    top: int
    levels: int

    def cells_at(self, place: list[jax.Array]) -> list[jax.Array]:
        """The cell of the finest level that has a place of the unit cube; of those beside it the nearest."""
        cells = 1 << self.levels
        return [jnp.clip(jnp.floor(jnp.clip(at, 0, 1) * cells).astype(jnp.int32), 0, cells - 1) for at in place]

    def leaf_of(self, cell: list[jax.Array]) -> Leaf:
        """The leaf that holds cells of the finest level."""
        below, (x, y, z) = self.levels - self.top, cell

        def node(row: jax.Array) -> list[jax.Array]:
            both = self.node.at[row].get(mode="promise_in_bounds")  # both numbers, read at once
            return [both[..., 0], both[..., 1]]

        def descend(nth: jax.Array, leaf: Leaf) -> Leaf:
            bit, inner = below - 1 - nth, leaf.length == INNER
            octant = ((x >> bit) & 1) << 2 | ((y >> bit) & 1) << 1 | ((z >> bit) & 1)
            child = Leaf(*node(jnp.where(inner, leaf.begin + octant, 0)), jnp.full_like(x, 1) << bit)
            return jax.tree.map(lambda new, old: jnp.where(inner, new, old), child, leaf)

        top = node((((x >> below) << self.top) + (y >> below) << self.top) + (z >> below))
        return lax.fori_loop(0, below, descend, Leaf(*top, jnp.full_like(x, 1 << below)))

    def along(self, rays: Rays, visit: Callable[[Any, Leaf, Any, Any, Any], Any], found: Any) -> Any:
        """`found = visit(found, leaf, enters, leaves, last)` of all leaves that rays pass in the box, front to back."""
        cells = 1 << self.levels

        def step(state: Any) -> Any:
            t, cell, found = state
            leaf = self.leaf_of(cell)
            corner = [one & ~(leaf.side - 1) for one in cell]
            exits = [rays.to(axis, low / cells, (low + leaf.side) / cells)[1] for axis, low in enumerate(corner)]
            leaves = jnp.clip(functools.reduce(jnp.minimum, exits), t, jnp.maximum(t, rays.end))
            last = leaves >= rays.end
            found = visit(found, leaf._replace(length=jnp.where(t < rays.end, leaf.length, 0)), t, leaves, last)
            crossed = [one <= leaves for one in exits]
            cell, gone = _across(self.cells_at(rays.at(leaves)), corner, leaf.side, rays.way, crossed, cells)
            return jnp.where(gone | last, jnp.inf, leaves), cell, found

        going = lambda state: (state[0] < rays.end).any()  # noqa: E731
        return lax.while_loop(going, step, (rays.begin, self.cells_at(rays.at(rays.begin)), found))[-1]


def _across(cell: Any, corner: Any, side: Any, way: Any, crossed: Any, cells: int) -> tuple[list[jax.Array], jax.Array]:
    """Cells behind the faces that rays cross, else beside them in the leaf; and whether the box ends there."""
    moved = []
    for here, low, part, over in zip(cell, corner, way, crossed, strict=True):
        moved.append(jnp.where(over, jnp.where(part > 0, low + side, low - 1), jnp.clip(here, low, low + side - 1)))
    gone = functools.reduce(jnp.logical_or, ((one < 0) | (one >= cells) for one in moved))
    return [jnp.clip(one, 0, cells - 1) for one in moved], gone


class _Level(NamedTuple):
    """Nodes of side 2^-depth: their corners (3, nodes), counted in nodes; node and sphere of each pair, node by node."""

    depth: int
    corner: np.ndarray
    node: np.ndarray
    sphere: np.ndarray


def build(
    centre: Any, radius: Any, *, most: int = MOST, max_level: int = MAX_LEVELS, room: tuple[int, int] | None = None
) -> Octree:
    """The octree over spheres (N, 3) and (N,), on the host; `CapacityError` of more nodes or entries than `room` has."""
    centre, radius = np.asarray(centre), np.asarray(radius)
    eps = ROUNDING * np.finfo(centre.dtype).eps
    lower, upper = (centre - radius[:, None]).min(0), (centre + radius[:, None]).max(0)
    margin = eps * ((upper - lower).max() + np.maximum(np.abs(lower), np.abs(upper)).max())
    lower, side = lower - margin, (upper - lower).max() + 2 * margin
    balls = (((centre - lower) / side).T.copy(), radius / side * (1 + eps) + eps)
    number = len(radius)
    level = _Level(0, np.zeros((3, 1), centre.dtype), np.zeros(number, np.int32), np.arange(number, dtype=np.int32))
    pairs = PAIRS_PER_SPHERE * number
    while level.depth < min(max_level, MAX_TOP) and max(8 * level.corner.shape[1], 2 * len(level.node)) <= pairs:
        level = _children(balls, level, np.ones(level.corner.shape[1], bool))
    top, nodes, entries, num_nodes, num_entries = level.depth, [], [], 0, 0
    x, y, z = level.corner.astype(int)
    row = ((x << top) + y << top) + z
    corner = np.empty_like(level.corner)
    corner[:, row] = level.corner
    level = _Level(top, corner, *_in_order(row[level.node], level.sphere))
    occupied = np.bincount(level.node, minlength=corner.shape[1]).reshape((1 << top,) * 3) > 0
    before = np.pad(occupied, ((1, 0),) * 3).cumsum(0).cumsum(1).cumsum(2).astype(np.int32)
    while True:
        count = np.bincount(level.node, minlength=level.corner.shape[1])
        fits = balls[1][level.sphere] <= 0.5**level.depth
        split = (np.bincount(level.node[fits], minlength=len(count)) > most) & (level.depth < max_level)
        own = np.where(split, 0, count)
        begin, child = num_entries + np.cumsum(own) - own, num_nodes + len(count) + 8 * (np.cumsum(split) - 1)
        nodes.append(np.stack([np.where(split, child, begin), np.where(split, INNER, count)], 1))
        entries.append(level.sphere[~split[level.node]])
        num_nodes, num_entries = num_nodes + len(count), num_entries + len(entries[-1])
        if not split.any():
            break
        level = _children(balls, level, split)
    packed = [np.concatenate(parts).astype(np.int32) for parts in (nodes, entries)]
    for what, rows, most_rows in zip(("nodes", "entries"), packed, room or map(len, packed), strict=True):
        if len(rows) > most_rows:
            raise CapacityError(f"`room` is for {most_rows} {what}, and these spheres take {len(rows)}; give more room")
    if room is not None:
        packed = [
            np.pad(rows, [(0, size - len(rows))] + [(0, 0)] * (rows.ndim - 1)) for rows, size in zip(packed, room, strict=True)
        ]
    return Octree(*map(jnp.asarray, (lower, side, *packed)), jnp.asarray(before), top, level.depth)


def _children(balls: Any, level: _Level, split: np.ndarray) -> _Level:
    """Those of all nodes that are split, in blocks of eight in their order."""
    some, cells = split[level.node], 1 << level.depth
    node, sphere = level.node[some], level.sphere[some]
    off = []  # squares of the distances from the lower and the upper half of nodes, along each axis
    for at, corner in zip(balls[0], level.corner, strict=True):
        away = at[sphere] * cells - corner[node]
        halves = np.maximum(-away, away - 0.5), np.maximum(0.5 - away, away - 1)
        off.append([np.maximum(half, 0) ** 2 for half in halves])
    reach = (balls[1][sphere] * cells) ** 2
    met = [np.flatnonzero(off[0][x] + off[1][y] + off[2][z] <= reach) for x, y, z in HALVES]
    first = 8 * (np.cumsum(split) - 1)  # of the children of each node
    child = np.concatenate([first[node[pairs]] + octant for octant, pairs in enumerate(met)])
    corner = 2 * level.corner[:, split, None] + HALVES.T[:, None].astype(level.corner.dtype)
    return _Level(level.depth + 1, corner.reshape(3, -1), *_in_order(child, sphere[np.concatenate(met)]))


def _in_order(node: np.ndarray, sphere: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    pair = np.sort((node.astype(np.int64) << 32) | sphere, kind="stable")
    return (pair >> 32).astype(np.int32), pair.astype(np.int32)
