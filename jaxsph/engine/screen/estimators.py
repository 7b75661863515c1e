r"""How wrong each leaf is: estimators a posteriori, of which the quadtree splits the leaves with the largest errors.

Flow: pyramid -> [estimators] -> quadtree.

All see the image at the corners of leaves and, one lattice coarser, what it was before they were made. Errors are in units of
colour; the norm $\|\cdot\|_T$ of a leaf is taken over its pixels. `Hierarchical` is that of Kratz et al. 2011, equation 9; the
others are its rivals in their section 7.
"""

from __future__ import annotations

import abc
import dataclasses

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxsph.engine.screen.pyramid import at_nodes, corners_of, halved, num_leaves, of_corners

CAUTION = 0.9  # of the largest difference around, how much a leaf may yet be wrong by: `benchmarks/calibrate_screen.py`
Lattice = Float[Array, "channels rows columns"]
GAUSS = np.polynomial.legendre.leggauss(3)


@dataclasses.dataclass(frozen=True)
class LeafErrors:
    """Of the leaves with sides of one length.

    Attributes:
        norm: the L2 norm over the leaf, of all channels, in colour times pixels.
        largest: the largest difference that a pixel of it is expected to have, in any channel.
    """

    norm: Float[Array, "rows columns"]
    largest: Float[Array, "rows columns"]

    @property
    def both(self) -> tuple[Float[Array, "rows columns"], Float[Array, "rows columns"]]:
        """Norm and largest."""
        return self.norm, self.largest


class Estimator(abc.ABC):
    """How errors of leaves are estimated."""

    @abc.abstractmethod
    def __call__(self, coarser: Lattice, corners: Lattice, shape: tuple[int, int], side: int) -> LeafErrors:
        """Of all leaves whose sides are `side` pixels long.

        Args:
            coarser: the image at nodes `2 * side` apart.
            corners: at nodes `side` apart.
            shape: of the image, pixels.
        """


class Hierarchical(Estimator):
    r"""The difference between two approximations, $\|u_{n-1} - u_n\|_T$ (Kratz et al. 2011, equations 9 and 10).

    Either is bilinear on the leaf, so the square of their difference is a polynomial that Gauss quadrature integrates exactly.
    """

    def __call__(self, coarser: Lattice, corners: Lattice, shape: tuple[int, int], side: int) -> LeafErrors:
        """See `Estimator`."""
        gain = corners - halved(coarser, shape, side)
        size = _leaves(shape, side)
        return LeafErrors(side * jnp.sqrt(_mean_square(gain, size)), CAUTION * _largest_around(jnp.abs(gain).max(0), size))


class CornerVariance(Estimator):
    """How much the colours at the corners of a leaf vary (Levoy 1990, as in Kratz et al. 2011, section 7.3)."""

    def __call__(self, coarser: Lattice, corners: Lattice, shape: tuple[int, int], side: int) -> LeafErrors:
        """See `Estimator`."""
        four = jnp.stack(corners_of(corners))
        return LeafErrors(side * jnp.sqrt(four.var(0).sum(0)), (four.max(0) - four.min(0)).max(0) / 2)


class Uniform(Estimator):
    """No estimate: the larger a leaf, the sooner it is split."""

    def __call__(self, coarser: Lattice, corners: Lattice, shape: tuple[int, int], side: int) -> LeafErrors:
        """See `Estimator`."""
        size = jnp.full(_leaves(shape, side), side, corners.dtype)
        return LeafErrors(size, jnp.full_like(size, jnp.inf))


ESTIMATORS = {"hierarchical": Hierarchical(), "corner_variance": CornerVariance(), "uniform": Uniform()}


def _leaves(shape: tuple[int, int], side: int) -> tuple[int, int]:
    return num_leaves(shape[0], side), num_leaves(shape[1], side)


def _mean_square(gain: Float[Array, "channels rows columns"], leaves: tuple[int, int]) -> Float[Array, "rows columns"]:
    """Of the bilinear function with those values at the corners: by three points of Gauss along either side."""
    upper_left, upper_right, lower_left, lower_right = corners_of(gain)
    place, weight = (GAUSS[0] + 1) / 2, GAUSS[1] / 2
    total = jnp.zeros(leaves, gain.dtype)
    for y, wy in zip(place, weight, strict=True):
        left, right = upper_left + y * (lower_left - upper_left), upper_right + y * (lower_right - upper_right)
        for x, wx in zip(place, weight, strict=True):
            total = total + wy * wx * ((left + x * (right - left)) ** 2).sum(0)
    return total


def _largest_around(value: Float[Array, "rows columns"], leaves: tuple[int, int]) -> Float[Array, "rows columns"]:
    """The largest at the corners of each leaf and at the nodes next to them: what a leaf sees may reach into the next."""
    pads = [(1, count - have + 2) for count, have in zip(leaves, value.shape, strict=True)]
    return lax.reduce_window(value, jnp.zeros((), value.dtype), lax.max, (4, 4), (1, 1), pads)


def allowed(tolerance: Array, bound: Float[Array, "height width"], side: int) -> Float[Array, "rows columns"]:
    """What rays leave of a tolerance to the leaves, if they can be wrong by `bound`, a pixel."""
    return tolerance - of_corners(at_nodes(bound, side), jnp.maximum)
