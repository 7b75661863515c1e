r"""SPH smoothing kernels, by name, with **support** radius $H$: $W(r, H) = 0$ for $r \ge H$, unit integral in 3D.

Flow: [kernels] -> particles, cast, reference.

Each kernel is $W(r, H) = \sigma H^{-3} w(q, 1)$ with $q = r / H$ and a polynomial $w(q, c)$ that is homogeneous of degree n:
$w(cq, c) = c^n w(q, 1)$. So a marcher folds a particle's strength m into its lengths, with $c = m^{1/n}$, and no weight is
multiplied in the inner loop. Squared distances come in two parts, one of which is prepared outside of it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.numerics.compiled import greater
from jaxsph.numerics.names import did_you_mean

MIN_SQUARE = 1e-30  # added to (r/H)^2 under a root, whose slope it keeps finite: far under eps, well above underflow
CELLS = 30  # of a support: pieces of kernels end at halves, thirds and fifths
AROUND = {1: 2.0, 2: 2 * math.pi, 3: 4 * math.pi}  # area of the unit sphere, by dimension
NOTHING = 1e-37  # the same for particles of no size, which pad blocks: the least that float32 holds in full


@dataclasses.dataclass(frozen=True)
class Kernel:
    r"""A radial kernel of compact support.

    Attributes:
        name: what users call it.
        norm: $\sigma$, so that $\int W dx = 1$.
        degree: n, with $w(c q, c) = c^n w(q, 1)$.
        edge: k, with $w(q, 1)$ about $(1 - q)^k$ near the edge of the support.
        prepare: `prepare(part, size)`: what the inner loop needs of the first part of $(c q)^2$ and of c.
        weigh: `weigh(prepared, rest, size, xp)`: $w(c q, c)$ for $(c q)^2$ = part + rest, and 0 outside the support; `xp` is
            `numpy` or `jax.numpy`.
        slope: `slope(prepared, rest, size, xp)`: its derivative by the square $(c q)^2$; finite, and 0 outside the support.
    """

    name: str
    norm: float
    degree: int
    edge: int
    prepare: Callable[[Any, Any], Any]
    weigh: Callable[[Any, Any, Any, Any], Any]
    slope: Callable[[Any, Any, Any, Any], Any]

    def thickness(self, dimensions: int, support: Any) -> Any:
        """What a kernel of three dimensions is to be multiplied by to be that of so many, of the same shape: its unit integral is
        over a plane or a line then, and an area times it is the volume of a particle that lies in a plane.
        """
        return 1.0 if dimensions == 3 else _norm(self, dimensions) / self.norm * support ** (3 - dimensions)

    def of_square(self, square: Any, xp: Any) -> Any:
        """The unnormalised kernel $w(q, 1)$ of $q^2$."""
        return self.weigh(self.prepare(square, 1.0), 0.0, 1.0, xp)


@functools.cache
def _norm(kernel: Kernel, dimensions: int) -> float:
    """Of unit integral in so many dimensions, by quadrature between radii of which some are where pieces of all kernels end."""
    node, weight = np.polynomial.legendre.leggauss(8)
    radius = ((np.arange(CELLS)[:, None] + (node + 1) / 2) / CELLS).ravel()
    shells = AROUND[dimensions] * radius ** (dimensions - 1) * kernel.of_square(radius**2, np)
    return float(1 / (np.tile(weight, CELLS) @ shells * 0.5 / CELLS))


def _poly6(margin: Any, rest: Any, size: Any, xp: Any) -> Any:
    t = _positive(margin - rest, xp)
    return t * t * t


def _poly6_slope(margin: Any, rest: Any, size: Any, xp: Any) -> Any:
    t = _positive(margin - rest, xp)
    return -3 * (t * t)


def _cubic(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    r = xp.sqrt(part + rest)
    outer, inner = _positive(size - r, xp), _positive(0.5 * size - r, xp)
    return 2 * outer * outer * outer - 8 * inner * inner * inner


def _cubic_slope(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    r = xp.sqrt(part + rest)
    outer, inner = _positive(size - r, xp), _positive(0.5 * size - r, xp)
    return (12 * inner * inner - 3 * outer * outer) / r


def _wendland(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    r = xp.sqrt(part + rest)
    outer = _positive(size - r, xp)
    square = outer * outer
    return square * square * (size + 4 * r)


def _wendland_slope(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    outer = _positive(size - xp.sqrt(part + rest), xp)
    return -10 * (outer * outer * outer)


def _quartic(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    r = xp.sqrt(part + rest)
    outer, middle, inner = (power(_positive(end * size - r, xp), 4) for end in (1.0, 0.6, 0.2))
    return outer - 5 * middle + 10 * inner


def _quartic_slope(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    """Of the innermost piece as a polynomial of the square: its parts cancel at the centre."""
    square = part + rest
    r = xp.sqrt(square)
    outer, middle = (power(_positive(end * size - r, xp), 3) for end in (1.0, 0.6))
    return xp.where(r < 0.2 * size, 12 * square - 2.4 * (size * size), -_positive(2 * outer - 10 * middle, xp) / r)


def _quintic(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    r = xp.sqrt(part + rest)
    outer, middle, inner = (power(_positive(end * size - r, xp), 5) for end in (1.0, 2 / 3, 1 / 3))
    return outer - 6 * middle + 15 * inner


def _quintic_slope(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    """As `_quartic_slope`."""
    square = part + rest
    r = xp.sqrt(square)
    outer, middle = (power(_positive(end * size - r, xp), 4) for end in (1.0, 2 / 3))
    inside = 20 * size * square - 25 * square * r - 20 / 9 * power(size, 3)
    return xp.where(r < 1 / 3 * size, inside, -_positive(2.5 * outer - 15 * middle, xp) / r)


def _wendland_c4(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    square = part + rest
    r = xp.sqrt(square)
    return power(_positive(size - r, xp), 6) * (size * size + 6 * size * r + 35 / 3 * square)


def _wendland_c4_slope(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    r = xp.sqrt(part + rest)
    return -28 / 3 * power(_positive(size - r, xp), 5) * (size + 5 * r)


def _wendland_c6(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    square = part + rest
    r = xp.sqrt(square)
    outer = power(_positive(size - r, xp), 4)  # half of the power first, half last: all of it could underflow
    return outer * (size * size * (size + 8 * r) + square * (25 * size + 32 * r)) * outer


def _wendland_c6_slope(part: Any, rest: Any, size: Any, xp: Any) -> Any:
    square = part + rest
    r = xp.sqrt(square)
    return -11 * power(_positive(size - r, xp), 7) * (size * size + 7 * size * r + 16 * square)


def _positive(value: Any, xp: Any) -> Any:
    """What is above 0."""
    return np.maximum(value, 0) if xp is np else greater(0, value)


def power(value: Any, exponent: int) -> Any:
    """A whole power by multiplications alone."""
    half = value * value if exponent < 4 else power(value, exponent // 2)
    if exponent < 4:
        return half * value if exponent == 3 else half
    return half * half * value if exponent % 2 else half * half


def _margin(part: Any, size: Any) -> Any:
    return size * size - part


def _under_root(part: Any, size: Any) -> Any:
    return part + (MIN_SQUARE * (size * size) + NOTHING)


KERNELS = {
    kernel.name: kernel
    for kernel in (
        Kernel("poly6", 315 / (64 * math.pi), 6, 3, _margin, _poly6, _poly6_slope),
        Kernel("cubic_spline", 8 / math.pi, 3, 3, _under_root, _cubic, _cubic_slope),
        Kernel("wendland_c2", 21 / (2 * math.pi), 5, 4, _under_root, _wendland, _wendland_slope),
        Kernel("quartic_spline", 5**6 / (512 * math.pi), 4, 4, _under_root, _quartic, _quartic_slope),
        Kernel("quintic_spline", 3**7 / (40 * math.pi), 5, 5, _under_root, _quintic, _quintic_slope),
        Kernel("wendland_c4", 495 / (32 * math.pi), 8, 6, _under_root, _wendland_c4, _wendland_c4_slope),
        Kernel("wendland_c6", 1365 / (64 * math.pi), 11, 8, _under_root, _wendland_c6, _wendland_c6_slope),
    )
}  # of Mueller, Charypar & Gross 2003 (equation 20), Monaghan & Lattanzio 1985 (with H = 2h), Dehnen & Aly 2012 (table 1)


def by_name(name: str) -> Kernel:
    """The kernel called `name`; raises `ValueError` listing the known ones."""
    if name not in KERNELS:
        raise ValueError(f"`kernel` must be one of {', '.join(KERNELS)}, got {name!r}{did_you_mean(name, KERNELS)}")
    return KERNELS[name]
