r"""Build an octree over spheres, level by level: every leaf has an entry for each sphere that it intersects.

Flow: spheres -> [octree_levels] -> octree_build -> octree.

As in Kaehler, Abel & Hege 2007, section 3.1, but from a dense grid downwards and without recursion: (sphere, cell) pairs are put
in order by one sort, and then the pairs of those nodes of a level that are split become pairs of their children, by running sums.

A node of side s is split if more than `most` of its spheres are smaller than it: of a radius below s / `ratio`. Spheres that
are not are met by most children alike, and splitting would copy rather than separate them: supports that overlap thirty deep
everywhere would be split without end. Of spheres of radius $\rho s$, spread evenly, a node has entries in proportion to
$E(\rho) = 1 + 6 \rho + 3 \pi \rho^2 + 4 \pi \rho^3 / 3$. To split multiplies all entries by $m = E(2 \rho) / E(\rho)$, and leaves
a point with $m / 8$ of those that it had to look at: so the factor won in time is greater than the one lost in memory as long
as $m < \sqrt 8$, which is $\rho < 0.44$. Hence a `ratio` of 2: nodes are split as long as spheres fit into them.

Coordinates are those of the unit cube, so that nodes of level l begin at whole multiples of $2^{-l}$, exactly. A coordinate is
computed as (x - lower) rate, which is monotone in x and off by at most eps, as no point of the box is beyond 1. So two points
that are r apart come to lie at most $r \, \mathrm{rate} \, (1 + 2 \epsilon) + 2 \sqrt 3 \epsilon$ apart, and the distance to a
box is computed to some 4 eps. Radii are widened by `ROUNDING` eps of themselves and of the cube, which covers these and the
roundings of positions along rays.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.octree import ROUNDING
from jaxsph.numerics.fusion import fusion_barrier
from jaxsph.numerics.sums import running_sum

OCTANTS = 8


class Placed(NamedTuple):
    """Spheres in the unit cube, and the box that it stands for.

    Attributes:
        sphere: x, y, z and widened radius, side by side.
        live: those that there are.
        lower, side: of the box, in length units.
    """

    sphere: Float[Array, "spheres 4"]
    live: Bool[Array, " spheres"]
    lower: Float[Array, "3"]
    side: Float[Array, ""]


class Level(NamedTuple):
    """Nodes of one level and the spheres that they intersect, node by node.

    Attributes:
        corner: lower corner of each node, in nodes of this level from that of the cube.
        begin: where the pairs of each node begin, and where the last end.
        sphere, node: of each pair; past the last, the node is their number.
    """

    corner: Int[Array, "nodes 3"]
    begin: Int[Array, " nodes_and_one"]
    sphere: Int[Array, " pairs"]
    node: Int[Array, " pairs"]


class Found(NamedTuple):
    """What is known of a level before it is split.

    Attributes:
        wanted: nodes that are to be split.
        met: of each pair, the children that the sphere intersects, a bit each; none if the node is not split.
    """

    wanted: Bool[Array, " nodes"]
    met: Int[Array, " pairs"]


def place(centre: Float[Array, "spheres 3"], radius: Float[Array, " spheres"], live: Bool[Array, " spheres"]) -> Placed:
    """Spheres in the unit cube around all of them; those that are not finite, or of a radius below 0, are left out."""
    live = live & jnp.isfinite(centre).all(1) & jnp.isfinite(radius) & (radius >= 0)
    eps, largest = ROUNDING * jnp.finfo(centre.dtype).eps, jnp.finfo(centre.dtype).max
    lower = jnp.where(live[:, None], centre - radius[:, None], largest).min(0, initial=largest)
    upper = jnp.where(live[:, None], centre + radius[:, None], -largest).max(0, initial=-largest)
    lower, upper = (jnp.where(live.any(), corner, 0) for corner in (lower, upper))
    span = (upper - lower).max(initial=0)
    margin = eps * (span + jnp.maximum(jnp.abs(lower), jnp.abs(upper)).max(initial=0))
    lower, side = lower - margin, span + 2 * margin
    side = jnp.where(side > 0, side, 1)
    rate = 1 / side
    away = (centre - lower) * rate
    wide = radius * rate * (1 + eps) + eps
    return Placed(jnp.concatenate([away, wide[:, None]], 1), live, lower, side)


def top_ranges(sphere: Float[Array, "*any 4"], top: int) -> tuple[Int[Array, "*any 3"], Int[Array, "*any 3"]]:
    """The first cell of the dense grid that each sphere may meet, and how many there are, along each axis."""
    cells, middle, wide = 1 << top, sphere[..., :3], sphere[..., 3:]
    first, last = (jnp.clip((middle + side) * cells, 0, cells - 1).astype(jnp.int32) for side in (-wide, wide))
    return first, last - first + 1


@functools.partial(jax.jit, static_argnames=("top", "capacity"))
def top_level(placed: Placed, *, top: int, capacity: int) -> tuple[Level, Bool[Array, ""]]:
    """The dense grid of 2^top cells an axis, with room for so many pairs before they are tested; and whether that is too few."""
    number = jnp.where(placed.live, top_ranges(placed.sphere, top)[1].prod(1), 0)
    up_to = running_sum(number)
    begin = up_to - number
    marks = jnp.zeros(capacity + 1, jnp.int32).at[jnp.minimum(begin, capacity)].add(1)
    each = jnp.arange(capacity, dtype=jnp.int32)
    sphere = running_sum(marks)[:-1] - 1
    cell = fusion_barrier(placed.live[0], _cells, placed.sphere, begin, sphere, top)
    cell = jnp.where(each < up_to[-1], cell, 1 << (3 * top))
    cell, sphere = _sorted(cell, sphere)
    nodes = jnp.arange(1 << (3 * top), dtype=jnp.int32)
    corner = jnp.stack([nodes >> (2 * top), (nodes >> top) & ((1 << top) - 1), nodes & ((1 << top) - 1)], 1)
    bounds = jnp.searchsorted(cell, jnp.arange((1 << (3 * top)) + 1, dtype=jnp.int32)).astype(jnp.int32)
    return Level(corner, bounds, sphere, cell), up_to[-1] > capacity


def _cells(spheres: Array, begin: Array, sphere: Array, top: int) -> Int[Array, " pairs"]:
    """The cell of each candidate; of those that the sphere does not meet, one past the last."""
    cells, here = 1 << top, spheres[sphere]
    first, (_, deep, high) = (part.T for part in top_ranges(here, top))
    nth = jnp.arange(sphere.shape[0], dtype=jnp.int32) - begin[sphere]
    x, y, z = nth // (deep * high), nth // high % deep, nth % high
    corner = [start + step for start, step in zip(first, (x, y, z), strict=True)]
    away = [here[:, k] * cells - corner[k] for k in range(3)]
    off = [jnp.maximum(jnp.maximum(-side, side - 1), 0) for side in away]
    meets = off[0] ** 2 + off[1] ** 2 + off[2] ** 2 <= (here[:, 3] * cells) ** 2
    return jnp.where(meets, (corner[0] * cells + corner[1]) * cells + corner[2], cells**3)


def _sorted(cell: Int[Array, " pairs"], sphere: Int[Array, " pairs"]) -> tuple[Array, Array]:
    """Both by cell, then sphere: one packed sort."""
    with jax.enable_x64(True):
        packed = lax.sort((cell.astype(jnp.uint64) << 32) | sphere.astype(jnp.uint64))
        return (packed >> 32).astype(jnp.int32), packed.astype(jnp.uint32).astype(jnp.int32)


@functools.partial(jax.jit, static_argnames=("depth", "most", "ratio"))
def look(placed: Placed, level: Level, *, depth: int, most: int, ratio: float) -> Found:
    """Which nodes of a level of side 2^-depth are to be split, and which children their spheres meet."""
    wanted = crowded(placed, level, depth=depth, most=most, ratio=ratio)

    def test() -> Int[Array, " pairs"]:
        split = jnp.append(wanted, False).at[level.node].get(mode="promise_in_bounds")
        return jnp.where(split, _children_met(placed.sphere, level, depth), 0)

    return Found(wanted, lax.cond(wanted.any(), test, lambda: jnp.zeros_like(level.node)))


def crowded(placed: Placed, level: Level, *, depth: int, most: int, ratio: float) -> Bool[Array, " nodes"]:
    """Nodes that more than `most` spheres intersect which are smaller than the node."""
    small = ratio * placed.sphere[:, 3].at[level.sphere].get(mode="promise_in_bounds") < 0.5**depth
    before = jnp.pad(running_sum((small & (level.node < level.corner.shape[0])).astype(jnp.int32)), (1, 0))
    return before[level.begin[1:]] - before[level.begin[:-1]] > most


def _children_met(spheres: Float[Array, "spheres 4"], level: Level, depth: int) -> Int[Array, " pairs"]:
    corner = jnp.pad(level.corner, ((0, 1), (0, 0))).at[level.node].get(mode="promise_in_bounds")
    scaled = spheres.at[level.sphere].get(mode="promise_in_bounds") * (1 << depth)
    away, square = scaled[:, :3] - corner, scaled[:, 3] ** 2
    low, high = jnp.maximum(-away, away - 0.5), jnp.maximum(0.5 - away, away - 1)
    sides = [[jnp.maximum(off[:, k], 0) ** 2 for off in (low, high)] for k in range(3)]
    met = jnp.zeros_like(level.node)
    for octant in range(OCTANTS):
        x, y, z = (sides[k][(octant >> (2 - k)) & 1] for k in range(3))
        met |= (x + y + z <= square).astype(jnp.int32) << octant
    return met


def sizes_of(level: Level, found: Found) -> tuple[Int[Array, ""], Int[Array, ""], Int[Array, ""]]:
    """How many nodes are split, pairs that their children will have, and pairs of nodes that are not."""
    count = level.begin[1:] - level.begin[:-1]
    return found.wanted.sum(), lax.population_count(found.met).sum(), jnp.where(found.wanted, 0, count).sum()


@functools.partial(jax.jit, static_argnames=("blocks", "pairs"))
def split(level: Level, found: Found, *, blocks: int, pairs: int) -> Level:
    """The children of all nodes that are split, in blocks of 8 in their order; what there is no room for is left out."""
    nodes = level.corner.shape[0]
    nth = running_sum(found.wanted.astype(jnp.int32))
    block = jnp.where(found.wanted, jnp.minimum(nth - 1, blocks), blocks)
    parent = jnp.full(blocks + 1, nodes, jnp.int32).at[block].set(jnp.arange(nodes, dtype=jnp.int32)).at[-1].set(nodes)[:-1]
    there = parent < nodes
    ends = jnp.append(level.begin, level.begin[-1])
    octants = jnp.arange(OCTANTS, dtype=jnp.int32)
    up_to = fusion_barrier(nodes >= ends[0], lambda met: running_sum((met >> octants[:, None]) & 1, 1), found.met)
    before = jnp.pad(up_to, ((0, 0), (1, 0)))
    zero = before[:, ends[parent]].T
    count = before[:, ends[parent + 1]].T - zero
    total = running_sum(count.ravel())
    begin = total - count.ravel()
    shift = jnp.append(begin.reshape(blocks, OCTANTS) - zero - 1, jnp.full((1, OCTANTS), pairs, jnp.int32), 0)
    shift = jnp.append(shift[block], shift[-1:], 0)
    sphere = jnp.zeros(pairs + 1, jnp.int32)
    for k in range(OCTANTS):
        target = shift[:, k].at[level.node].get(mode="promise_in_bounds") + up_to[k]
        target = jnp.where((found.met >> k) & 1 == 1, target, pairs)
        sphere = sphere.at[jnp.clip(target, 0, pairs)].set(level.sphere, mode="promise_in_bounds")
    sphere = sphere[:-1]
    begin, last = jnp.minimum(begin, pairs), jnp.minimum(total[-1], pairs)
    node = running_sum(jnp.zeros(pairs + 1, jnp.int32).at[begin].add(1))[:-1] - 1
    node = jnp.where(jnp.arange(pairs, dtype=jnp.int32) < last, node, blocks * OCTANTS)
    offset = jnp.stack([octants >> 2, (octants >> 1) & 1, octants & 1], 1)
    corner = 2 * level.corner[jnp.minimum(parent, nodes - 1)][:, None] + offset
    corner = jnp.where(there[:, None, None], corner, 0)
    return Level(corner.reshape(-1, 3), jnp.append(begin, last), sphere, node)
