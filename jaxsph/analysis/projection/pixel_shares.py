r"""How much of a kernel's column each pixel of an image holds: exact means over pixels, however small a support is.

Flow: columns -> [pixel_shares] -> field.column_sums.

With $G(x, y) = \int_0^x \int_0^y F$, the integral of a column F over a rectangle is a difference of G at its four corners. G is
smooth, symmetric and odd in x and y, so that a few products do: $G(x, y) \approx \sum_k \lambda_k g_k(x) g_k(y)$ with
polynomials $g_k$. Shares of neighbouring pixels are differences of the same numbers, so they add up to what the whole image
holds: mass is kept to rounding, whatever the error of a share.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsph.analysis.projection.columns import whole_column
from jaxsph.numerics.fusion import barriers_kept

TERMS = 24  # odd Chebyshev polynomials that each g_k is made of
PRODUCTS = 8  # with more, the error of the fit by polynomials is larger than that of leaving out the rest
CELLS, NODES = 160, 6  # of the quadrature, on each axis


class Shares(NamedTuple):
    """The products of a kernel.

    Attributes:
        polynomials: coefficients of g_k by odd Chebyshev polynomials.
        factors: lambda_k.
    """

    polynomials: Float[np.ndarray, "terms products"]
    factors: Float[np.ndarray, " products"]


@functools.cache
def shares_of(name: str) -> Shares:
    """Fitted in float64 to quadrature; the density of shares is good to 1e-4 of F(0), and that of the whole plane is 1."""
    edges, corner = _corner_integrals(name)
    odd = np.polynomial.chebyshev.chebvander(edges, 2 * TERMS - 1)[:, 1::2]
    inverse = np.linalg.pinv(odd)
    factors, vectors = np.linalg.eigh(inverse @ corner @ inverse.T)
    largest = np.argsort(-np.abs(factors))[:PRODUCTS]
    factors, polynomials = factors[largest], vectors[:, largest]
    whole = 4 * (factors * polynomials.sum(0) ** 2).sum()  # every polynomial is 1 at 1
    return Shares(polynomials, factors / whole)


def pixel_shares(
    name: str, x: Float[Array, "... edges_across"], y: Float[Array, "... edges_down"]
) -> Float[Array, "... pixels_down pixels_across"]:
    """Integrals of a column of support 1 over the pixels between edges, counted from its centre; signs follow the edges' order.

    What lies outside the support has exactly nothing, and no share is negative.
    """
    shares = shares_of(name)
    of_x, of_y = (_between(shares, edges) for edges in (x, y))
    product = jnp.einsum("...rk,...ck->...rc", of_y * shares.factors.astype(of_y.dtype), of_x, precision="highest")
    nearest = _nearest(y)[..., :, None] ** 2 + _nearest(x)[..., None, :] ** 2
    return jnp.where(nearest < 1, jnp.maximum(product, 0), 0)


def _between(shares: Shares, edges: Array) -> Float[Array, "... pixels products"]:
    """Differences of all g_k between neighbouring edges, upwards."""
    at = jnp.clip(edges, -1, 1)
    values = (_by_product if barriers_kept() else _by_chain)(shares.polynomials.astype(at.dtype), at)
    return values[..., 1:, :] - values[..., :-1, :]


def _by_product(coefficients: Any, at: Array) -> Float[Array, "... edges products"]:
    """All g_k as one product of matrices: on CPUs, where the chain below takes longer."""
    double = 4 * at * at - 2  # T_(n+2) = 2 T_2 T_n - T_(n-2)
    odd = [at, at * (double - 1)]
    for _ in coefficients[2:]:
        odd.append(double * odd[-1] - odd[-2])
    return jnp.matmul(jnp.stack(odd, -1), coefficients, precision="highest")


def _by_chain(coefficients: Any, at: Array) -> Float[Array, "... edges products"]:
    """The same by Clenshaw's recurrence, which accelerators fuse into one chain and hold in registers."""
    at = at[..., None]
    double = 4 * at * at - 2
    last = before = jnp.zeros_like(at * coefficients[0])
    for row in coefficients[::-1]:
        last, before = row + double * last - before, last
    return at * (last - before)


def _nearest(edges: Array) -> Array:
    """Distance of the centre from the span between neighbouring edges, which ascend."""
    return jnp.maximum(jnp.maximum(edges[..., :-1], -edges[..., 1:]), 0)


def _corner_integrals(name: str) -> tuple[Any, Any]:
    """Edges from 0 to 1, dense where the support ends, and G at all pairs of them."""
    edges = np.sin(np.linspace(0, np.pi / 2, CELLS + 1))
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    sizes = np.diff(edges)[:, None]
    at, weight = (edges[:-1, None] + sizes * (nodes + 1) / 2).ravel(), (sizes * weights / 2).ravel()
    cells = whole_column(name, at[:, None] ** 2 + at**2, np) * weight[:, None] * weight
    cells = cells.reshape(CELLS, NODES, CELLS, NODES).sum((1, 3))
    corner = np.zeros((CELLS + 1, CELLS + 1))
    corner[1:, 1:] = cells.cumsum(0).cumsum(1)
    return edges, corner
