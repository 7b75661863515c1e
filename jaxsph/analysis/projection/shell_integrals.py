r"""The same integrals of kernels of high order, whose polynomials in r have terms a thousand times their sum.

Flow: kernels -> [shell_integrals] -> columns.

Along a ray, Gauss-Legendre quadrature of the kernel itself, between the radii where its pieces end: in each shell it is smooth,
its values are positive, and rounding stays that of the kernel. Across planes, each piece is a polynomial in the distance
$d = c - r$ to its edge, which is integrated twice in closed form.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxsph.model import kernels

NODES, WEIGHTS = ((values + shift) / 2 for values, shift in zip(np.polynomial.legendre.leggauss(16), (1, 0), strict=True))


class Edge(NamedTuple):
    """A polynomial in the distance to a radius, inside of it.

    Attributes:
        radius: where it ends, in supports.
        coefficients: of the powers of the distance, by power.
    """

    radius: float
    coefficients: dict[int, float]


EDGES = {
    "quartic_spline": (Edge(1.0, {4: 1}), Edge(0.6, {4: -5}), Edge(0.2, {4: 10})),
    "quintic_spline": (Edge(1.0, {5: 1}), Edge(2 / 3, {5: -6}), Edge(1 / 3, {5: 15})),
    "wendland_c4": (Edge(1.0, {6: 56 / 3, 7: -88 / 3, 8: 35 / 3}),),
    "wendland_c6": (Edge(1.0, {8: 66, 9: -154, 10: 121, 11: -32}),),
}
"""Without norms."""


def from_foot(name: str, square: Any, t: Any, xp: Any = jnp) -> Any:
    """Integral of a kernel of support 1 from the foot of its centre on a ray to t, as far as the support goes; odd in t."""
    kernel, total, reached = kernels.by_name(name), 0.0, xp.zeros_like(square * t)
    for radius in sorted(edge.radius for edge in EDGES[name]):
        within = radius**2 - square
        half = xp.where(within > 0, xp.sqrt(xp.where(within > 0, within, 1)), 0)
        half = jax.lax.stop_gradient(half) if xp is jnp else half  # what one shell gains the next loses
        end = xp.where(abs(t) <= half, abs(t), half)  # chosen, not the less of both: where they are alike t has the derivative
        end = xp.where(end > reached, end, reached)
        length = end - reached
        for node, weight in zip(NODES.tolist(), WEIGHTS.tolist(), strict=True):
            at = reached + node * length
            total = total + weight * length * kernel.of_square(square + at * at, xp)
        reached = end
    return kernel.norm * xp.sign(t) * total


def below(name: str, z: Any, xp: Any = jnp) -> Any:
    """How much of a kernel of support 1 lies between its centre and a plane at z; negative where z is."""
    total = 0.0
    for radius, coefficients in EDGES[name]:
        for power, factor in coefficients.items():
            whole, beyond = (_tail(radius, power, d) for d in (radius, xp.maximum(radius - abs(z), 0)))
            total = total + 2 * math.pi * factor * (whole - beyond)
    return kernels.by_name(name).norm * xp.sign(z) * total


def _tail(radius: float, power: int, d: Any) -> Any:
    """Of d^power, over all points of the ball that are nearer than d to the plane that touches it."""
    n = power + 2
    return d**n * (radius / ((n - 1) * n) - d / (n * (n + 1)))
