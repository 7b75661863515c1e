"""The lattice of nodes that neighbouring bundles share: sums over particles, for all samples between to be interpolated from.

Flow: grid -> [lattice] -> control, media.

Sums over particles are as smooth as the kernel, whatever the transfer function makes of their ratio. So nodes are every few
rays and every few fine samples, as far apart as supports allow: a small part of all samples.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.numerics.trees import tree

REACH = 2  # nodes to either side that a fourth difference takes
GAP = REACH + 1  # nodes without anything past the last along each axis: a fourth difference, and the far border of a slab


@dataclasses.dataclass(frozen=True)
class Spacing:
    """How far apart nodes are, static.

    Attributes:
        pixels: across, a divisor of `BUNDLE`.
        samples: fine samples in depth, a divisor of the samples of a slab.
    """

    pixels: int
    samples: int

    @property
    def across(self) -> int:
        """Nodes of a bundle, down and across."""
        return BUNDLE // self.pixels


FINEST = Spacing(4, 2)


@tree(static=("rows", "columns", "spacing"))
class Region:
    """The bundles of a band that have nodes: those around all that is seen, as far as there is room.

    Attributes:
        row, column: of pixels, of the first bundle.
        rows, columns: of bundles; static, as is the spacing.
        spacing: of nodes.
    """

    row: Int[Array, ""]
    column: Int[Array, ""]
    rows: int
    columns: int
    spacing: Spacing

    def place(self, grid: Grid) -> tuple[Int[Array, " bundles"], Int[Array, " bundles"], Bool[Array, " bundles"]]:
        """Row and column in the region of a grid's bundles, and whether they are of the region at all."""
        row, column = (grid.row - self.row) // BUNDLE, (grid.column - self.column) // BUNDLE
        return row, column, (row >= 0) & (row < self.rows) & (column >= 0) & (column < self.columns)


def region_of(grid: Grid, rows: int, columns: int, spacing: Spacing) -> Region:
    """From the first row and column of bundles on that any particle can touch."""
    touched, far = grid.lists.end > grid.lists.start, jnp.iinfo(jnp.int32).max  # none is inside of a region that begins there
    row, column = jnp.where(touched, jnp.stack([grid.row, grid.column]), far).min(1)
    return Region(row, column, rows, columns, spacing)


@tree()
class Lattice:
    """Sums at the nodes of a region, up to one common factor.

    With `REACH` layers of zeros in front and `GAP` zeros past the last node along each axis: one after the other in memory,
    neighbours along any axis are then one shift away.

    Attributes:
        weight: of V W.
        weighted: of (q - reference) V W, for each quantity q.
        references: of each quantity, one amid the particles'.
        region: where the nodes are.
        evaluations: kernel evaluations that the nodes took, for each ray of a bundle of the band.
    """

    weight: Float[Array, "layers rows columns"]
    weighted: tuple[Float[Array, "layers rows columns"], ...]
    references: tuple[Float[Array, ""], ...]
    region: Region
    evaluations: Float[Array, " bundles"]


def node_at(shape: tuple[int, ...], layer: Array, row: Array, column: Array) -> Int[Array, "*any"]:
    """Where in memory nodes are, of a lattice of (layers, rows, columns) in all."""
    _, rows, columns = shape
    return ((REACH + layer) * rows + row) * columns + column
