r"""What of a kernel lies along a ray, and what lies between two depths: integrals in closed form.

Flow: kernels -> [columns] -> field.column_sums, model.pixel_shares.

Lengths are in supports: a ray passes a particle at the distance b, and t counts from the foot of its centre on the ray. All
kernels are sums of polynomials in r, each inside a radius c of its own, and $r = \sqrt{b^2 + t^2}$. So all integrals follow from

$$I_n(t) = \int_0^t r^n dt = \frac{t r^n + n b^2 I_{n-2}(t)}{n + 1}, \quad I_0 = t, \quad I_{-1} = \mathrm{asinh}(t / b),$$

which is exact for whole chords and for any part of one. Kernels of high order are summed shell by shell instead
(`shell_integrals`). All functions take `xp`, which is `numpy` or `jax.numpy`.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxsph.analysis.projection import shell_integrals
from jaxsph.model import kernels

MIN_SQUARE = kernels.MIN_SQUARE  # under roots and logarithms of b^2, whose slopes it keeps finite


class Piece(NamedTuple):
    """A polynomial in r inside a radius.

    Attributes:
        radius: where it ends, in supports.
        coefficients: of the powers of r, from 0 on.
    """

    radius: float
    coefficients: tuple[float, ...]


PIECES = {
    "poly6": (Piece(1.0, (1, 0, -3, 0, 3, 0, -1)),),
    "cubic_spline": (Piece(1.0, (2, -6, 6, -2)), Piece(0.5, (-1, 6, -12, 8))),
    "wendland_c2": (Piece(1.0, (1, 0, -10, 20, -15, 4)),),
}
"""Of some kernels of `model.kernels`, without their norms. Of others rounding would be too much; see `shell_integrals`."""


def whole_column(name: str, square: Any, xp: Any = jnp) -> Any:
    r"""Integral of a kernel along a whole line, $F(b) = \int W(\sqrt{b^2 + t^2}, 1) dt$.

    Of a support H it is $H^{-2} F(b / H)$. It is zero for $b \ge 1$, and of unit integral over the plane.

    Args:
        name: of the kernel.
        square: $b^2$.
        xp: `numpy` or `jax.numpy`.

    Returns:
        Exact in float64 to 64 eps of F(0); in float32 to 1e-5 of it, and never negative.

    Differentiation:
        Finite everywhere.
    """
    if kernels.by_name(name).name not in PIECES:
        return 2 * shell_integrals.from_foot(name, square, xp.ones_like(square), xp)
    total = 0.0
    for piece in PIECES[name]:
        half, inside = _half_chord(piece, square, xp)
        total = total + 2 * xp.where(inside, _from_foot(piece, square, half, xp), 0)
    return kernels.by_name(name).norm * xp.maximum(total, 0)


def column_between(name: str, square: Any, start: Any, end: Any, xp: Any = jnp) -> Any:
    """The same integral from t = `start` to t = `end`, with start <= end; all three broadcast."""
    if kernels.by_name(name).name not in PIECES:
        first, last = (shell_integrals.from_foot(name, square, t, xp) for t in (start, end))
        return xp.maximum(last - first, 0)
    total = 0.0
    for piece in PIECES[name]:
        half, inside = _half_chord(piece, square, xp)
        ends = (_from_foot(piece, square, xp.clip(t, -half, half), xp) for t in (end, start))
        total = total + xp.where(inside, next(ends) - next(ends), 0)
    return kernels.by_name(name).norm * xp.maximum(total, 0)


def depth_share(name: str, start: Any, end: Any, xp: Any = jnp) -> Any:
    """How much of a kernel of support 1 lies between two planes at distances `start` <= `end` from its centre, in [0, 1]."""
    if kernels.by_name(name).name not in PIECES:
        return xp.clip(shell_integrals.below(name, end, xp) - shell_integrals.below(name, start, xp), 0, 1)
    total = 0.0
    for radius, coefficients in PIECES[name]:
        low, high = xp.clip(start, -radius, radius), xp.clip(end, -radius, radius)
        for power, factor in enumerate(coefficients):
            n = power + 2
            ends = [radius**n * z - z * abs(z) ** n / (n + 1) for z in (high, low)]
            total = total + 2 * math.pi * factor / n * (ends[0] - ends[1])
    return xp.clip(kernels.by_name(name).norm * total, 0, 1)


def _half_chord(piece: Piece, square: Any, xp: Any) -> tuple[Any, Any]:
    """Half of the length inside a piece, and whether there is any. Held fixed, as a kernel ends with the value 0."""
    within = piece.radius**2 - square
    inside = within > 0
    half = xp.sqrt(xp.where(inside, within, 1))
    return (jax.lax.stop_gradient(half) if xp is jnp else half), inside


def _from_foot(piece: Piece, square: Any, t: Any, xp: Any) -> Any:
    """Integral of a piece from the foot to t, inside."""
    solid = square + MIN_SQUARE
    r = xp.sqrt(solid + t * t)
    integral, powers = {0: t}, {0: 1.0, 1: r}
    odd = any(factor for factor in piece.coefficients[1::2])
    if odd:
        integral[-1] = xp.sign(t) * (xp.log(abs(t) + r) - 0.5 * xp.log(solid))
    total = piece.coefficients[0] * t
    for n in range(1, len(piece.coefficients)):
        powers[n] = powers[n - 1] * r
        if n % 2 and not odd:
            continue
        integral[n] = (t * powers[n] + n * solid * integral[n - 2]) / (n + 1)
        total = total + piece.coefficients[n] * integral[n]
    return total
