r"""By which rule a particle's column is laid into pixels, and what blocks of particles that follow it add.

Flow: seen -> [rules] -> field.blocks.

A column along a ray is exact there, and says nothing of the rest of the pixel: a support smaller than a pixel is met by chance.
A mean over a pixel is found by what the size of the support allows. *Shares* are differences of corner integrals, which keep
mass however small a support is. Several rays are good to 3e-5 of the peak from 3 pixels a support on. Of large supports the ray
through the middle will do with the curvature there: $w^4 / 1920$ of fourth derivatives are left out, 3e-5 of the peak.
Columns that no depth cuts are read from a fit by the squared distance alone; only those that one cuts need their closed form.

Of a ray the sum is $\sum_j a_j F_j$, with F_j the integral of a kernel of unit integral along the ray between two depths, and a_j
what the particle holds. Shapes, once: (bundles, particles of a block, places down, places across).
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsph.engine.access.lists import BUNDLE
from jaxsph.model.particles.columns import column_between, curvature, pixel_shares, whole_column
from jaxsph.numerics.fusion import fusion_barrier

PIXELS = ("mean", "ray")
SHARES, SMOOTH, WHOLE, CUT = "shares", "smooth", "whole", "cut"
SUBRAYS = 3  # of a pixel on each axis in means
SMALL, LARGE = 3.0, 16.0  # pixels that a support radius has less of for shares, and at least for smooth means
PLACE = 4  # columns of the table that say where a particle is; what it holds comes behind


@dataclasses.dataclass(frozen=True)
class Rule:
    """How columns are found, static.

    Attributes:
        kind: `SHARES`, `SMOOTH`, `WHOLE` or `CUT`.
        kernel: name of the smoothing kernel.
        perspective: whether rays spread with depth.
        subrays: rays of a pixel on each axis.
    """

    kind: str
    kernel: str
    perspective: bool
    subrays: int = 1

    @property
    def block(self) -> int:
        """Particles that are met at once: written out where a column takes a few operations."""
        return 16 if self.kind in (SMOOTH, WHOLE) else self.block_back

    block_back = 8

    def chunk(self, at_once: int) -> int:
        """Bundles that are summed together, where so many bundles of single samples fit."""
        return max(at_once // (self.block_back * self.subrays**2), 1)

    @property
    def places(self) -> Float[np.ndarray, " places"]:
        """Where rays go through the pixels of a bundle, on either axis; of shares, where pixels end."""
        if self.kind == SHARES:
            return np.arange(BUNDLE + 1.0)
        return np.asarray((np.arange(BUNDLE)[:, None] + _nodes(self.subrays)[0]).ravel())

    @property
    def beside(self) -> float:
        """How far from the middle of its pixel a rule looks, in pixels on either axis."""
        return 0.5 if self.kind == SHARES else float(np.max(np.abs(_nodes(self.subrays)[0] - 0.5)))

    def pixels_of(self, sums: Float[Array, "bundles down across"]) -> Float[Array, "bundles 8 8"]:
        """Means over the rays of each pixel, by Gauss-Legendre quadrature on either axis."""
        if self.subrays == 1:
            return sums
        weights = jnp.asarray(_nodes(self.subrays)[1], sums.dtype)
        parts = sums.reshape(-1, BUNDLE, self.subrays, BUNDLE, self.subrays)
        return jnp.einsum("bisjt,s,t->bij", parts, weights, weights, precision="highest")

    def __call__(self, rows: Float[Array, "bundles particles columns"], each: Any, shared: Float[Array, "2"]) -> list[Array]:
        """What particles add to the places of bundles, for each of the amounts that they hold; see `field.blocks.Body`.

        Args:
            rows: for rays x, y, z and reciprocal support; for shares ray coordinates of the centre, and the reciprocals of the
                support in them. Then amounts.
            each: ray coordinates of columns and of rows, or of the edges of pixels, (bundles, places).
            shared: near and far depth.
        """
        amounts = [rows[:, :, k, None, None] for k in range(PLACE, rows.shape[2])]
        place, always = tuple(rows[:, :, k, None, None] for k in range(PLACE)), rows[0, 0, 0] >= 0
        if rows.shape[1] < 16 or self.kind not in (SMOOTH, WHOLE) or rows.dtype != jnp.float32:
            found = fusion_barrier(always, self._columns, place, *each, shared)
            return [(amount * found).sum(1) for amount in amounts]
        part = fusion_barrier(always, self._part, place, *each)
        nth = [jax.tree.map(operator.itemgetter(np.s_[:, k]), part) for k in range(rows.shape[1])]
        columns = [self._column(one, shared) for one in nth]
        return [functools.reduce(jnp.add, [amount[:, k] * one for k, one in enumerate(columns)]) for amount in amounts]

    def _columns(self, place: tuple[Array, ...], across: Array, down: Array, ends: Array) -> Array:
        """Of particles that hold 1, at all places of bundles."""
        if self.kind == SHARES:
            x, y, wide, high = (value[..., 0] for value in place)
            return pixel_shares(self.kernel, (across[:, None] - x) * wide, (y - down[:, None]) * high)
        return self._column(self._part(place, across, down), ends)

    def _part(self, place: tuple[Array, ...], across: Array, down: Array) -> tuple[Array, ...]:
        """What places along rows and along columns have each; of parallel rays squared distances, so that their sums are all."""
        x, y, z, inverse = place
        u, v = across[:, None, None, :], down[:, None, :, None]
        if self.perspective:
            return *place, *(jnp.broadcast_to(side, (*x.shape[:2], *side.shape[2:])) for side in (u, v))
        finer = ((across[:, 1] - across[:, 0])[:, None, None, None] * inverse) ** 2 / 24
        return ((u - x) * inverse) ** 2, ((v - y) * inverse) ** 2, z, inverse, finer

    def _column(self, part: tuple[Array, ...], ends: Array) -> Array:
        if self.perspective:
            x, y, z, inverse, u, v = part
            slant = 1 + u * u + v * v
            x, y = x - u * z, y - v * z  # from the depth of the centre on, as what is small is no difference of what is large
            further = (x * u + y * v) / slant
            square = ((u * further - x) * inverse) ** 2 + ((v * further - y) * inverse) ** 2 + (further * inverse) ** 2
            scale, foot = jnp.sqrt(slant) * inverse, z + further
        else:
            in_row, in_column, foot, scale, finer = part
            square = in_column + in_row
        if self.kind == CUT:
            return column_between(self.kernel, square, (ends[0] - foot) * scale, (ends[1] - foot) * scale)
        column = whole_column(self.kernel, square)
        return column + finer * curvature(self.kernel, square) if self.kind == SMOOTH else column


def rules_of(kernel: str, perspective: bool, pixel: str) -> tuple[Rule, ...]:
    """Those that particles may follow, with values of rays or means over pixels."""
    of = functools.partial(Rule, kernel=kernel, perspective=perspective)
    if pixel == "ray":
        return of(WHOLE), of(CUT)
    smooth = () if perspective else (of(SMOOTH),)
    return of(SHARES), *smooth, of(WHOLE, subrays=SUBRAYS), of(CUT, subrays=SUBRAYS)


def _nodes(subrays: int) -> tuple[Any, Any]:
    """Where rays go through a pixel on one axis, in [0, 1], and the shares of it that they stand for."""
    nodes, weights = np.polynomial.legendre.leggauss(subrays)
    return (nodes + 1) / 2, weights / 2
