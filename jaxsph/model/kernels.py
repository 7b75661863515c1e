r"""SPH smoothing kernels, by name, with **support** radius $H$: $W(r, H) = 0$ for $r \ge H$, unit integral in 3D.

Flow: [kernels] -> particles, cast, reference.

Each kernel is $W(r, H) = \sigma H^{-3} w(t)$ with the *margin* $t = 1 - (r/H)^2$: the squared distance is what a marcher has
at hand, poly6 needs no root, and near the edge of the support $t$ is exact where $1 - r/H$ would cancel.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

SMALLEST_SQUARE = 1e-30  # (r/H)^2 below this is the particle itself: far under eps of any kernel value, well above underflow


def _poly6(t: Any, xp: Any) -> Any:
    t = xp.maximum(t, 0)
    return t * t * t


def _distance(t: Any, xp: Any) -> Any:
    """Q = r / H from the margin; the floor keeps the root's derivative finite at the particle."""
    return xp.sqrt(xp.maximum(1 - xp.maximum(t, 0), SMALLEST_SQUARE))


def _cubic_spline(t: Any, xp: Any) -> Any:
    q = _distance(t, xp)
    outer, inner = 1 - q, xp.maximum(0.5 - q, 0)
    return 2 * outer * outer * outer - 8 * inner * inner * inner


def _wendland_c2(t: Any, xp: Any) -> Any:
    q = _distance(t, xp)
    outer = (1 - q) * (1 - q)
    return outer * outer * (1 + 4 * q)


@dataclasses.dataclass(frozen=True)
class Kernel:
    r"""A radial kernel of compact support.

    Attributes:
        name: what users call it.
        norm: $\sigma$, so that $\int W dx = 1$.
        shape: `shape(t, xp)` gives $w(t)$, 0 for $t \le 0$; `xp` is `numpy` or `jax.numpy`.
        homogeneous: the degree $n$ if $w(c t) = c^n w(t)$, else `None`: lets a marcher fold a weight into `t`.
        source: where the formula is from.
    """

    name: str
    norm: float
    shape: Callable[[Any, Any], Any]
    homogeneous: int | None
    source: str


KERNELS = {
    "poly6": Kernel("poly6", 315 / (64 * math.pi), _poly6, 3, "Mueller, Charypar & Gross 2003, equation 20"),
    "cubic_spline": Kernel("cubic_spline", 8 / math.pi, _cubic_spline, None, "Monaghan & Lattanzio 1985, with H = 2h"),
    "wendland_c2": Kernel("wendland_c2", 21 / (2 * math.pi), _wendland_c2, None, "Dehnen & Aly 2012, MNRAS 425, table 1"),
}


def by_name(name: str) -> Kernel:
    """The kernel called `name`; raises `ValueError` listing the known ones."""
    if name not in KERNELS:
        raise ValueError(f"`kernel` must be one of {', '.join(KERNELS)}, got {name!r}")
    return KERNELS[name]


def evaluate(name: str, r: Float[Array, "..."], support: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""Kernel value $W(r, H)$.

    Poly6: $\frac{315}{64\pi H^3} (1 - q^2)^3$; cubic spline: $\frac{8}{\pi H^3} (2 (1-q)^3 - 8 (1/2 - q)_+^3)$;
    Wendland C2: $\frac{21}{2\pi H^3} (1 - q)^4 (1 + 4q)$; with $q = r/H$, and 0 for $q \ge 1$.

    Args:
        name: `"poly6"`, `"cubic_spline"` or `"wendland_c2"`.
        r: distance to the particle, `>= 0`, in length units.
        support: support radius $H > 0$ (**not** the smoothing length), same units as `r`.

    Returns:
        Kernel value, length units to the power -3; error at most 16 `eps` of the peak $W(0, H)$.

    Raises:
        ValueError: for an unknown `name`.

    References:
        Mueller, Charypar & Gross 2003; Monaghan & Lattanzio 1985; Dehnen & Aly 2012.
    """
    kernel = by_name(name)
    r, support = jnp.asarray(r), jnp.asarray(support)
    q = r / support
    return kernel.norm / support**3 * kernel.shape((1 - q) * (1 + q), jnp)
