r"""An octree over spheres: which of them can be at a point, in a box.

Flow: spheres -> octree_build -> [octree] -> media.

Every leaf has an entry for each sphere that it intersects (Kaehler, Abel & Hege 2007, section 3.1), so a point needs to look at
its own leaf alone. The uppermost levels are one dense grid. Below, the children of a node are a block of eight, and neither
corners nor parents are stored: they follow from integer coordinates at the finest level, in which every point of the box is in
exactly one leaf, whatever rounds.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.macrocells import MACROCELL, Occupancy

INNER = -1  # the length of a node that is split
ROUNDING = 32  # eps of the cube's side that radii are widened by, and the box on either side


class Leaf(NamedTuple):
    """Leaves, as queries find them.

    Attributes:
        begin: where its entries begin in `Octree.entry`.
        length: how many there are; 0 outside of the box.
        level: its side is that of the box over 2^level.
        inside: whether the position is in the box at all; what is not is taken to the nearest leaf.
    """

    begin: Int[Array, "*any"]
    length: Int[Array, "*any"]
    level: Int[Array, "*any"]
    inside: Bool[Array, "*any"]


@dataclasses.dataclass(frozen=True)
class Octree:
    """Spheres by where they are; `octree_build.build_octree` makes it.

    Attributes:
        lower, side: of the box, a cube around all spheres, in length units.
        node: of each node, for a leaf where its entries begin and how many there are; else its first child and `INNER`. Those
            of the dense grid come first, x slowest.
        entry: indices of spheres, leaf by leaf.
        occupancy: cells of the dense grid that any sphere meets.
        num_leaves, num_entries, deepest: that there are; `deepest` is the level of the smallest leaf.
        crowded: leaves that would have been split but for the maximal level.
        fault: fault word: whether the plan was too small, so that spheres are missing.
        top: levels of the dense grid: it has 2^top cells along each axis.
        levels: that there may be, of the smallest leaf there is room for.
    """

    lower: Float[Array, "3"]
    side: Float[Array, ""]
    node: Int[Array, "nodes 2"]
    entry: Int[Array, " entries"]
    occupancy: Occupancy
    num_leaves: Int[Array, ""]
    num_entries: Int[Array, ""]
    deepest: Int[Array, ""]
    crowded: Int[Array, ""]
    fault: Int[Array, ""]
    top: int
    levels: int

    @property
    def rate(self) -> Float[Array, ""]:
        """Boxes a length unit: coordinates in the box lie in [0, 1)."""
        return 1 / self.side

    def coordinates(self, *place: Float[Array, "*any"]) -> list[Float[Array, "*any"]]:
        """Of positions x, y and z in length units, in the unit cube."""
        return [(at - zero) * self.rate for at, zero in zip(place, self.lower, strict=True)]

    def leaf_at(self, x: Float[Array, "*any"], y: Float[Array, "*any"], z: Float[Array, "*any"]) -> tuple[Leaf, list[Array]]:
        """The leaf that holds each position, and integer coordinates of the position at the finest level."""
        return self.leaf_in_cube(self.coordinates(x, y, z))

    def leaf_in_cube(self, coordinates: list[Float[Array, "*any"]]) -> tuple[Leaf, list[Int[Array, "*any"]]]:
        """The same for coordinates in the unit cube."""
        cells = [finest(at, self.levels) for at in coordinates]
        within = [(at >= 0) & (at < 1) for at in coordinates]
        leaf = self.leaf_of(*cells)
        inside = within[0] & within[1] & within[2]
        return leaf._replace(inside=inside, length=jnp.where(inside, leaf.length, 0)), cells

    def leaf_of(self, x: Int[Array, "*any"], y: Int[Array, "*any"], z: Int[Array, "*any"]) -> Leaf:
        """The leaf that holds integer coordinates at the finest level, each from 0 to 2^levels - 1."""
        below = self.levels - self.top
        row = (((x >> below) << self.top) + (y >> below) << self.top) + (z >> below)
        begin, length = _row(self.node, row)

        def descend(nth: Array, found: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            begin, length, level = found
            bit, inner = below - 1 - nth, length == INNER
            octant = ((x >> bit) & 1) << 2 | ((y >> bit) & 1) << 1 | ((z >> bit) & 1)
            child = _row(self.node, jnp.where(inner, begin + octant, 0))
            return jnp.where(inner, child[0], begin), jnp.where(inner, child[1], length), level + inner

        steps = jnp.clip(self.deepest - self.top, 0, below)
        begin, length, level = lax.fori_loop(0, steps, descend, (begin, length, jnp.full_like(begin, self.top)))
        return Leaf(begin, length, level, jnp.ones(begin.shape, bool))

    def may_meet(self, lower: list[Float[Array, "*any"]], upper: list[Float[Array, "*any"]]) -> Bool[Array, "*any"]:
        """Whether any sphere may be in boxes, from their least and greatest coordinates x, y and z in length units.

        Conservative: where it is false, no point of the box is in any sphere.
        """
        eps = ROUNDING * jnp.finfo(self.side.dtype).eps
        ends = []
        for corner, off in ((lower, -eps), (upper, eps)):
            scaled = self.coordinates(*corner)
            ends.append([(at + off * (1 + jnp.abs(at))) * self.occupancy_cells for at in scaled])
        return self.occupancy.any_in(*ends)

    @property
    def occupancy_cells(self) -> int:
        """Cells along an axis of the grid whose macrocells `occupancy` counts."""
        return MACROCELL << self.top


def finest(coordinate: Float[Array, "*any"], levels: int) -> Int[Array, "*any"]:
    """Integer coordinate at the finest level; in range even for NaN."""
    cells = 1 << levels
    whole = jnp.floor(jnp.clip(coordinate, 0, 1) * cells)
    return jnp.clip(whole.astype(jnp.int32), 0, cells - 1)


def _row(node: Int[Array, "nodes 2"], row: Int[Array, "*any"]) -> tuple[Array, Array]:
    """Both numbers of nodes, read at once."""
    found = node.at[row].get(mode="promise_in_bounds")
    return found[..., 0], found[..., 1]


jax.tree_util.register_dataclass(
    Octree,
    data_fields=[field.name for field in dataclasses.fields(Octree) if field.name not in ("top", "levels")],
    meta_fields=["top", "levels"],
)
