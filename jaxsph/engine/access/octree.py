r"""An octree over spheres: which of them can be at a point. Built on the host, in NumPy; looked up under `jit`.

Flow: spheres -> [octree] -> media.

Every leaf has an entry for each sphere that it intersects (Kaehler, Abel & Hege 2007, section 3.1), so a point needs to look at
its own leaf alone. The uppermost levels are one dense grid. Below, the children of a node are a block of eight, and neither
corners nor parents are stored: they follow from integer coordinates at the finest level, in which every point of the box is in
exactly one leaf, whatever rounds. It is built level by level: the (node, sphere) pairs of nodes that are split become pairs of
their children, put in order by one sort.

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

Particles may also be put in order along a curve (`prepare`): neighbours in space are then neighbours in memory. A Morton key
interleaves the binary digits of x, y and z (Morton 1966, "A computer oriented geodetic data base"; for particles, Warren & Salmon
1993, section 2.1).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.volume_grid import MACROCELL, Occupancy
from jaxsph.engine.runtime.programs import stage
from jaxsph.engine.runtime.tuning import MEMORY
from jaxsph.model.particles.particles import Particles, capacity_class
from jaxsph.numerics.checks import array_of, as_usual
from jaxsph.numerics.trees import tree

INNER = -1  # the length of a node that is split
ROUNDING = 32  # eps of the cube's side that radii are widened by, and the box on either side
MAX_TOP = 6  # levels of the dense grid: 64 cells an axis
MAX_LEVELS = 16  # such that a node is wider than what float32 coordinates are widened by
PAIRS_PER_SPHERE = 5  # of the dense grid at most: more of it would copy large spheres rather than separate small ones
BYTES_PER_PAIR = 24  # of a level, that its split holds at once
OCTANTS = 8
HALVES = np.indices((2, 2, 2)).reshape(3, OCTANTS).T  # of a node that children lie in, the lower or the upper along each axis
DIGITS = 10  # binary ones of each coordinate: three times as many fit into a word
NOWHERE = 1 << (3 * DIGITS)  # the key of particles without a place, past all others; that of padding is past it
SPREAD = ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249))  # shifts and masks that leave gaps of two digits


class Leaf(NamedTuple):
    """Leaves, as queries find them: where their entries begin in `Octree.entry`, and how many there are; 0 outside of the box."""

    begin: Int[Array, "*any"]
    length: Int[Array, "*any"]


@tree(static=("top", "levels"))
class Octree:
    """Spheres by where they are; `build_octree` makes it.

    Attributes:
        lower, side: of the box, a cube around all spheres, in length units.
        node: of each node, for a leaf where its entries begin and how many there are; else its first child and `INNER`. Those
            of the dense grid come first, x slowest. Padded, as is `entry`, to a capacity class.
        entry: indices of spheres, leaf by leaf.
        occupancy: cells of the dense grid that any sphere meets.
        top: levels of the dense grid: it has 2^top cells along each axis.
        levels: that of the smallest leaf, whose side is that of the box over 2^levels.
    """

    lower: Float[Array, "3"]
    side: Float[Array, ""]
    node: Int[Array, "nodes 2"]
    entry: Int[Array, " entries"]
    occupancy: Occupancy
    top: int
    levels: int

    @property
    def occupancy_cells(self) -> int:
        """Cells along an axis of the grid whose macrocells `occupancy` counts."""
        return MACROCELL << self.top

    def leaf_at(self, coordinates: list[Float[Array, "*any"]]) -> Leaf:
        """The leaf that holds each position, of which x, y and z are given in the unit cube that the box stands for."""
        cells, below = 1 << self.levels, self.levels - self.top
        whole = (jnp.floor(jnp.clip(at, 0, 1) * cells).astype(jnp.int32) for at in coordinates)
        x, y, z = (jnp.clip(at, 0, cells - 1) for at in whole)  # in range even for NaN

        def node(row: Array) -> Leaf:
            found = self.node.at[row].get(mode="promise_in_bounds")  # both numbers, read at once
            return Leaf(found[..., 0], found[..., 1])

        def descend(nth: Array, leaf: Leaf) -> Leaf:
            bit, inner = below - 1 - nth, leaf.length == INNER
            octant = ((x >> bit) & 1) << 2 | ((y >> bit) & 1) << 1 | ((z >> bit) & 1)
            child = node(jnp.where(inner, leaf.begin + octant, 0))
            return jax.tree.map(lambda new, old: jnp.where(inner, new, old), child, leaf)  # type: ignore[no-any-return]

        top = node((((x >> below) << self.top) + (y >> below) << self.top) + (z >> below))
        leaf = lax.fori_loop(0, below, descend, top)
        x_inside, y_inside, z_inside = ((at >= 0) & (at < 1) for at in coordinates)
        return leaf._replace(length=jnp.where(x_inside & y_inside & z_inside, leaf.length, 0))


class Spheres(NamedTuple):
    """Those that there are, in the unit cube: x, y and z, (3, spheres), the widened radius, and which of those given they are."""

    at: np.ndarray
    radius: np.ndarray
    number: np.ndarray


class Level(NamedTuple):
    """Nodes of side 2^-depth, and the spheres that they intersect.

    Attributes:
        depth: 0 for the cube itself.
        corner: lower corners of nodes, (3, nodes), in nodes from that of the cube.
        node, sphere: of each pair, node by node.
    """

    depth: int
    corner: np.ndarray
    node: np.ndarray
    sphere: np.ndarray


def build_octree(
    centre: Any, radius: Any, live: Any, *, most: int = 8, ratio: float = 2.0, max_level: int = MAX_LEVELS, memory: int = MEMORY
) -> Octree:
    """The octree over spheres; those that are not finite, or of a radius below 0, are left out.

    Args:
        centre, radius: of spheres, (N, 3) and (N,), length units.
        live: those that there are, (N,).
        most, ratio: what nodes are split by, see above.
        max_level: the smallest leaf has a side of the box over 2^max_level.
        memory: bytes that a level may take; where the next one would take more, nodes are left as they are.
    """
    spheres, lower, side = _placed(np.asarray(centre), np.asarray(radius), np.asarray(live))
    level = _dense(spheres, min(max_level, MAX_TOP))
    top, nodes, entries, num_nodes, num_entries = level.depth, [], [], 0, 0
    occupied = np.bincount(level.node, minlength=level.corner.shape[1]).reshape((1 << top,) * 3) > 0
    while True:
        count = np.bincount(level.node, minlength=level.corner.shape[1])
        small = ratio * spheres.radius[level.sphere] < 0.5**level.depth
        split = np.bincount(level.node[small], minlength=len(count)) > most
        wanted = split.any() and level.depth < max_level
        below = _children(spheres, level, split, memory // BYTES_PER_PAIR) if wanted else None
        split &= below is not None
        kept = np.where(split, 0, count)
        begin, child = num_entries + np.cumsum(kept) - kept, num_nodes + len(count) + OCTANTS * (np.cumsum(split) - 1)
        nodes.append(np.stack([np.where(split, child, begin), np.where(split, INNER, count)], 1))
        entries.append(spheres.number[level.sphere[~split[level.node]]])
        if below is None:
            break
        num_nodes, num_entries, level = num_nodes + len(count), num_entries + len(entries[-1]), below
    before = np.pad(occupied, ((1, 0),) * 3).cumsum(0).cumsum(1).cumsum(2)
    parts = _padded(nodes), _padded(entries), Occupancy(array_of(before, np.int32))
    return Octree(array_of(lower), array_of(side), *parts, top, level.depth)


def _placed(centre: np.ndarray, radius: np.ndarray, live: np.ndarray) -> tuple[Spheres, np.ndarray, np.ndarray]:
    """Spheres in the unit cube; lower corner and side of the box that it stands for."""
    index = np.flatnonzero(live & np.isfinite(centre).all(1) & np.isfinite(radius) & (radius >= 0))
    centre, radius = centre[index], radius[index]
    eps = ROUNDING * np.finfo(centre.dtype).eps
    lower = (centre - radius[:, None]).min(0) if len(index) else np.zeros(3, centre.dtype)
    upper = (centre + radius[:, None]).max(0) if len(index) else lower
    span = (upper - lower).max()
    margin = eps * (span + np.maximum(np.abs(lower), np.abs(upper)).max())
    lower, side = lower - margin, span + 2 * margin
    side = side if side > 0 else np.ones_like(side)
    at = np.ascontiguousarray(((centre - lower) * (1 / side)).T)
    return Spheres(at, radius * (1 / side) * (1 + eps) + eps, index.astype(np.int32)), lower, side


def _dense(spheres: Spheres, max_top: int) -> Level:
    """A level of which all nodes are there, x slowest: the finest with few nodes and pairs for these spheres."""
    number = len(spheres.number)
    level = Level(0, np.zeros((3, 1), spheres.at.dtype), np.zeros(number, np.int32), np.arange(number, dtype=np.int32))
    room = PAIRS_PER_SPHERE * max(number, 1)
    while level.depth < max_top and OCTANTS ** (level.depth + 1) <= room:
        below = _children(spheres, level, np.ones(level.corner.shape[1], bool), room)
        if below is None:
            break
        level = below
    x, y, z = level.corner.astype(np.int32)
    row = (((x << level.depth) + y) << level.depth) + z
    corner = np.empty_like(level.corner)
    corner[:, row] = level.corner
    return Level(level.depth, corner, *_in_order(row[level.node], level.sphere))


def _children(spheres: Spheres, level: Level, split: np.ndarray, room: int) -> Level | None:
    """Those of all nodes that are split, in blocks of eight in their order; None if there is no room for their pairs."""
    some, cells = split[level.node], 1 << level.depth
    node, sphere = level.node[some], level.sphere[some]
    off = []  # squares of the distances from the lower and the upper half of nodes, along each axis
    for at, corner in zip(spheres.at, level.corner, strict=True):
        away = at[sphere] * cells - corner[node]
        halves = np.maximum(-away, away - 0.5), np.maximum(0.5 - away, away - 1)
        off.append([np.maximum(half, 0) ** 2 for half in halves])
    reach = (spheres.radius[sphere] * cells) ** 2
    met = [np.flatnonzero(off[0][x] + off[1][y] + off[2][z] <= reach) for x, y, z in HALVES]
    if sum(map(len, met)) > room:
        return None
    first = OCTANTS * (np.cumsum(split) - 1)  # of the children of each node
    child = np.concatenate([first[node[pairs]] + octant for octant, pairs in enumerate(met)])
    corner = 2 * level.corner[:, split, None] + HALVES.T[:, None].astype(level.corner.dtype)
    return Level(level.depth + 1, corner.reshape(3, -1), *_in_order(child, sphere[np.concatenate(met)]))


def _in_order(node: np.ndarray, sphere: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs by node, then sphere: one sort of both in a word, which merges eight runs, as those of each octant come in order."""
    pair = np.sort((node.astype(np.int64) << 32) | sphere, kind="stable")
    return (pair >> 32).astype(np.int32), pair.astype(np.int32)


def _padded(parts: list[np.ndarray]) -> Int[Array, "rows ..."]:
    """One after the other, as int32, with room for those of similar sets, so that programs are shared."""
    rows = np.concatenate(parts)
    missing = capacity_class(len(rows)) - len(rows)
    return array_of(np.pad(rows, [(0, missing)] + [(0, 0)] * (rows.ndim - 1)), np.int32)


@as_usual()
def prepare(particles: Particles) -> Particles:
    """Do once what depends on particles alone: the same particles in an order in which frames find them faster.

    Worth it where particles that came in any order are rendered more than once. Frames need no preparation: an image is that
    of the particles as given but for rounding, as particles of the same depth are added up in another order.

    Args:
        particles: any, with their padding.

    Returns:
        As many entries, of which those that are particles come first, along a Morton curve through their bounding box.
        Preparing them again changes nothing.

    Differentiation:
        A permutation: what is differentiated by the particles given has the derivatives that it would have without; what by
        those returned, the same ones in their order. The order itself is held fixed.
    """
    return _prepared(particles)  # type: ignore[no-any-return]


@stage(quickly=True)
def _prepared(particles: Particles) -> Particles:
    order = jnp.argsort(lax.stop_gradient(morton_keys(particles)), stable=True)
    return particles.at(order)


def morton_keys(particles: Particles) -> Int[Array, " particles"]:
    """Morton keys of 3 x `DIGITS` binary digits, within the box around all particles that have a place."""
    position = particles.position
    placed = particles.valid & jnp.isfinite(position).all(1)
    largest = jnp.finfo(position.dtype).max
    lower = jnp.where(placed[:, None], position, largest).min(0, initial=largest)
    upper = jnp.where(placed[:, None], position, -largest).max(0, initial=-largest)
    middle, half = 0.5 * lower + 0.5 * upper, 0.5 * upper - 0.5 * lower
    share = (0.5 * position - 0.5 * middle) / jnp.where(half > 0, half, 1) + 0.5
    place = jnp.clip(share * (1 << DIGITS), 0, (1 << DIGITS) - 1)
    digits = jnp.where(placed[:, None], place, 0).astype(jnp.uint32)
    for shift, mask in SPREAD:
        digits = (digits | (digits << shift)) & mask
    key = digits[:, 0] | (digits[:, 1] << 1) | (digits[:, 2] << 2)
    return jnp.where(placed, key, jnp.where(particles.valid, NOWHERE, NOWHERE + 1).astype(jnp.uint32))
