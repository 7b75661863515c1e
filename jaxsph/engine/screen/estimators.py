r"""How wrong each leaf is: an estimate a posteriori, by which the quadtree splits the leaves with the largest errors.

Flow: pyramid -> [estimators] -> marking, canvas.

Errors are in units of colour; the norm $\|\cdot\|_T$ of a leaf is taken over its pixels.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxsph.engine.screen.pyramid import at_nodes, corners_of, halved, of_corners

CAUTION = 0.9  # of the largest difference around, how much a leaf may yet be wrong by: `benchmarks/calibrate_screen.py`
Lattice = Float[Array, "channels rows columns"]
OfLeaves = Float[Array, "rows columns"]
GAUSS = np.polynomial.legendre.leggauss(3)


def leaf_errors(coarser: Lattice, corners: Lattice, shape: tuple[int, int], side: int) -> tuple[OfLeaves, OfLeaves]:
    r"""The difference between two approximations, $\|u_{n-1} - u_n\|_T$ (Kratz et al. 2011, equations 9 and 10).

    Either is bilinear on the leaf, so the square of their difference is a polynomial that Gauss quadrature integrates exactly.

    Args:
        coarser: the image at nodes `2 * side` apart: what it was before the leaves were made.
        corners: at nodes `side` apart.
        shape: of the image, pixels.
        side: of the leaves, pixels.

    Returns:
        The L2 norm over each leaf, of all channels, in colour times pixels; and the largest difference that a pixel of it is
        expected to have, in any channel.
    """
    gain = corners - halved(coarser, shape, side)
    return side * jnp.sqrt(_mean_square(gain)), CAUTION * _largest_around(jnp.abs(gain).max(0))


def _mean_square(gain: Lattice) -> OfLeaves:
    """Of the bilinear function with those values at the corners: by three points of Gauss along either side."""
    upper_left, upper_right, lower_left, lower_right = corners_of(gain)
    place, weight = (GAUSS[0] + 1) / 2, GAUSS[1] / 2
    total = jnp.zeros(upper_left.shape[1:], gain.dtype)
    for y, wy in zip(place, weight, strict=True):
        left, right = upper_left + y * (lower_left - upper_left), upper_right + y * (lower_right - upper_right)
        for x, wx in zip(place, weight, strict=True):
            total = total + wy * wx * ((left + x * (right - left)) ** 2).sum(0)
    return total


def _largest_around(value: Float[Array, "rows columns"]) -> OfLeaves:
    """The largest at the corners of each leaf and at the nodes next to them: what a leaf sees may reach into the next."""
    pads = [(1, 2 if have == 1 else 1) for have in value.shape]
    return lax.reduce_window(value, jnp.zeros((), value.dtype), lax.max, (4, 4), (1, 1), pads)


def allowed(tolerance: Array, bound: Float[Array, "height width"], side: int) -> OfLeaves:
    """What rays leave of a tolerance to the leaves, if they can be wrong by `bound`, a pixel."""
    return tolerance - of_corners(at_nodes(bound, side), jnp.maximum)
