"""The list of work: which slabs of samples every bundle is to march, how widely spaced, and with which particles.

Flow: cells -> (bounds -> levels -> merge) -> [worklist] -> cast.

At full rate there is an item for every slab that a particle can touch. Error control replaces items by wider spaced ones, and
by super-pixels, that need no particles. One cast serves both, so that where control asks for full rate the image is the
reference image bit for bit.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsph.access.cells import Cells, position

COARSEST = 4  # level at which a cell has one sample
CELL = 1 << COARSEST  # fine samples of a cell along depth: D_z of the first paper
SPARSE = 0, 2, 5, 7  # of the rays along either side of a bundle, those that a sparse slab is marched at


@dataclasses.dataclass(frozen=True)
class Worklist:
    """Items by the slab that they begin at; a slab that begins none is not `filled`.

    Attributes:
        filled: whether an item begins here.
        level: its samples are `2**level` fine samples apart; a super-pixel is one sample of the coarsest level.
        begin, length: windows of the bundle's list, for each class of supports.
        count: sum of `length` over classes; 0 for super-pixels.
        origin: quantity that the item's sums are taken relative to, that of a particle near by: so that their rounding is a
            share of how much quantities differ, and a constant is rendered as that constant.
        interpolated: items whose sums are those of the lattice, with `count` 0; None where there is none.
        sparse: items that are marched at `SPARSE` rays, between which their sums are interpolated; None without a lattice.
        paint: red, green, blue and extinction of super-pixels, where `painted`; None where there can be none.
    """

    filled: Bool[Array, "slabs bundles"]
    level: Int[Array, "slabs bundles"]
    begin: Int[Array, "classes slabs bundles"]
    length: Int[Array, "classes slabs bundles"]
    count: Int[Array, "slabs bundles"]
    origin: Float[Array, "slabs bundles"]
    painted: Bool[Array, "slabs bundles"] | None = None
    paint: Float[Array, "4 slabs bundles"] | None = None
    interpolated: Bool[Array, "slabs bundles"] | None = None
    sparse: Bool[Array, "slabs bundles"] | None = None


def full_rate(cells: Cells, origin: Float[Array, "slabs bundles"]) -> Worklist:
    """Every filled slab at level 0: the reference image."""
    return Worklist(cells.count > 0, jnp.zeros_like(cells.count), cells.begin, cells.length, cells.count, origin)


def origins(cells: Cells, rank: Int[Array, " pairs"], quantity: Float[Array, " particles"]) -> Float[Array, "slabs bundles"]:
    """The quantity of the particle in the middle of each slab's window; 0 where there is none."""
    place = position(cells.count // 2, cells.begin, cells.length)
    return jnp.where(cells.count > 0, quantity[rank[jnp.clip(place, 0, rank.shape[0] - 1)]], 0)


jax.tree_util.register_dataclass(Worklist, data_fields=[field.name for field in dataclasses.fields(Worklist)], meta_fields=[])
