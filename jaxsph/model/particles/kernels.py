r"""SPH smoothing kernels, by name, with **support** radius $H$: $W(r, H) = 0$ for $r \ge H$, unit integral in 3D.

Flow: [kernels] -> particles, cast, columns, reference.

Each kernel is $W(r, H) = \sigma H^{-3} w(q, 1)$ with $q = r / H$, and is given by its pieces, as its source prints them:
$w(q, 1) = \sum_p (e_p - q)_+^{k_p} Q_p(q)$ with polynomials $Q_p$. All else follows of these in exact fractions: the norm
$\sigma$, the slope, columns along rays. A new kernel is one entry of `KERNELS`.

w is homogeneous of degree n, $w(cq, c) = c^n w(q, 1)$. So a marcher folds a particle's strength m into its lengths, with
$c = m^{1/n}$, and no weight is multiplied in the inner loop. Squared distances come in two parts, one of which is prepared
outside of it. A kernel that is even in q, as poly6 is, is a power of $c^2 - r^2$, and takes no root.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial, polynomial

from jaxsph.numerics.compiled import greater
from jaxsph.numerics.names import did_you_mean

MIN_SQUARE = 1e-30  # added to (r/H)^2 under a root, whose slope it keeps finite: far under eps, well above underflow
AROUND = {1: 2.0, 2: 2 * math.pi, 3: 4 * math.pi}  # area of the unit sphere, by dimension
NOTHING = 1e-37  # the same for particles of no size, which pad blocks: the least that float32 holds in full
MAX_WHOLE = 7  # power that is taken at once: of a higher one half comes last, as all of it could underflow


@dataclasses.dataclass(frozen=True)
class Kernel:
    r"""A radial kernel of compact support.

    Attributes:
        name: what users call it.
        pieces: of each piece its end e in supports, its power k, and coefficients of Q by powers of q from 0 on. Floats stand for
            the fractions that they are next to. All are of one degree, the outermost comes first and ends at 1; their sum is flat
            at the centre.
        fit: for each piece the power and number of coefficients of what columns are fitted by in float32; tuned for speed.
        nested: K of `projection.columns`; 0 where it is to be computed.
    """

    name: str
    pieces: tuple[tuple[float, int, tuple[float, ...]], ...]
    fit: tuple[tuple[int, int], ...] = ()
    nested: float = 0.0

    @property
    def degree(self) -> int:
        """n, with $w(c q, c) = c^n w(q, 1)$."""
        _, power, factors = self.pieces[0]
        return power + len(factors) - 1

    @property
    def edge(self) -> int:
        """k, with $w(q, 1)$ about $(1 - q)^k$ near the edge of the support."""
        return self.pieces[0][1]

    @property
    def ends(self) -> tuple[float, ...]:
        """Radii in supports where pieces end, from the edge of the support inwards; between them the kernel is smooth."""
        return tuple(end for end, *_ in self.pieces)

    @functools.cached_property
    def exact(self) -> list[tuple[Any, int, Any]]:
        """The pieces in fractions: e - q as a polynomial, k and Q."""
        return [(_fractions(end, -1), power, _fractions(*factors)) for end, power, factors in self.pieces]

    @functools.cached_property
    def powers(self) -> Any:
        """Polynomials in q that pieces are inside of their ends, (pieces, n + 1) coefficients from the power 0 on, exact."""
        return np.array([polynomial.polymul(polynomial.polypow(ahead, power), q) for ahead, power, q in self.exact])

    @functools.cached_property
    def distances(self) -> list[Any]:
        """The same in the distance e - q to the end of a piece."""
        return [np.pad(polynomial.polyval(Polynomial(ahead), q).coef, (power, 0)) for ahead, power, q in self.exact]

    def norm_in(self, dimensions: int) -> float:
        """Of unit integral in so many dimensions."""
        exponents = np.arange(dimensions, dimensions + self.degree + 1, dtype=object)
        ends = np.array([ahead[:1] for ahead, *_ in self.exact])
        return float(1 / (self.powers * ends**exponents / exponents).sum()) / AROUND[dimensions]

    @functools.cached_property
    def norm(self) -> float:
        r"""$\sigma$, so that $\int W dx = 1$."""
        return self.norm_in(3)

    def thickness(self, dimensions: int, support: Any) -> Any:
        """What a kernel of three dimensions is to be multiplied by to be that of so many, of the same shape: its unit integral is
        over a plane or a line then, and an area times it is the volume of a particle that lies in a plane.
        """
        return 1.0 if dimensions == 3 else self.norm_in(dimensions) / self.norm * support ** (3 - dimensions)

    @functools.cached_property
    def even(self) -> float:
        """f, where the kernel is $f (1 - q^2)^k$, else 0: one piece without odd powers, of degree 2 k."""
        is_even = len(self.pieces) == 1 and self.degree == 2 * self.edge and not self.powers[:, 1::2].any()
        return float(self.powers[0, 0]) if is_even else 0.0

    @functools.cached_property
    def terms(self) -> list[Any]:
        """Of the weight, see `_term`."""
        return [_term(*piece) for piece in self.exact]

    @functools.cached_property
    def falls(self) -> tuple[list[Any], list[float]]:
        """Of the slope; and, where its terms are over r, the polynomial that it is inside all ends, as they cancel there."""
        halves = [polynomial.polysub(polynomial.polymul(ahead, polynomial.polyder(q)), k * q) / 2 for ahead, k, q in self.exact]
        inside: Any = polynomial.polyder(self.powers.sum(0))[1:] / 2 if any(half[0] for half in halves) else []
        halves = halves[:-1] if len(inside) else [half[1:] for half in halves]
        terms = [_term(ahead, power - 1, half) for (ahead, power, _), half in zip(self.exact, halves, strict=False)]
        return terms, list(map(float, inside))

    def prepare(self, part: Any, size: Any) -> Any:
        """What the inner loop needs of the first part of $(c q)^2$ and of c."""
        return part + (MIN_SQUARE * (size * size) + NOTHING) if not self.even else size * size - part

    def weigh(self, prepared: Any, rest: Any, size: Any, xp: Any) -> Any:
        """$w(c q, c)$ for $(c q)^2$ = part + rest, and 0 outside the support; `xp` is `numpy` or `jax.numpy`."""
        if self.even:
            return _scaled(self.even, _positive(prepared - rest, xp), self.edge)
        square = prepared + rest
        return _sum_of(self.terms, size, square, xp.sqrt(square), xp)

    def slope(self, prepared: Any, rest: Any, size: Any, xp: Any) -> Any:
        """Its derivative by the square $(c q)^2$; finite, and 0 outside the support."""
        if self.even:
            return _scaled(-self.edge * self.even, _positive(prepared - rest, xp), self.edge - 1)
        (terms, inside), square = self.falls, prepared + rest
        r = xp.sqrt(square)
        total = _sum_of(terms, size, square, r, xp)
        if not inside:
            return total
        return xp.where(r < _times(self.ends[-1], size), _homogeneous(inside, size, square, r), total / r)

    def derived(self) -> Kernel:
        """The kernel, once what follows of its pieces is found that the body of a loop asks for."""
        for name in ("even", "terms", "falls"):
            getattr(self, name)
        return self

    def of_square(self, square: Any, xp: Any) -> Any:
        """The unnormalised kernel $w(q, 1)$ of $q^2$."""
        return self.weigh(self.prepare(square, 1.0), 0.0, 1.0, xp)


def _fractions(*values: float) -> Any:
    return np.array([Fraction(value).limit_denominator() for value in values])


def _term(ahead: Any, power: int, factors: Any) -> tuple[float, int, float, list[float]]:
    """Of $(e - q)^k$ times a polynomial in q: e, k, and the polynomial as a factor times one that begins with 1."""
    lead = next(filter(None, factors))
    return float(ahead[0]), power, float(lead), list(map(float, factors / lead))


def _sum_of(terms: list[Any], size: Any, square: Any, r: Any, xp: Any) -> Any:
    """Of terms that are homogeneous in r and c."""
    values = []
    for end, exponent, lead, factors in terms:
        ahead, last = _positive(_times(end, size) - r, xp), exponent // 2 if exponent > MAX_WHOLE else 0
        value = _scaled(lead, ahead, exponent - last)
        if len(factors) > 1:
            value = value * _homogeneous(factors, size, square, r)
        values.append(_times(power(ahead, last), value))
    return functools.reduce(operator.add, values)


def _homogeneous(factors: list[float], size: Any, square: Any, r: Any) -> Any:
    r"""$\sum_i f_i r^i c^{m-i}$, two terms at a time, as even powers of r take no root."""
    values = []
    for i in range(0, len(factors), 2):
        pair, others = factors[i : i + 2], max(len(factors) - i - 2, 0)
        parts = [_times(one, side) for one, side in zip(pair, (size, r) if len(pair) == 2 else (1.0,), strict=True) if one]
        if parts:
            values.append(_times(power(size, others), _times(power(square, i // 2), functools.reduce(operator.add, parts))))
    return functools.reduce(operator.add, values)


def _scaled(factor: float, value: Any, exponent: int) -> Any:
    """A factor times a power; into a cube it goes first, so that the last product is one that a sum is fused with."""
    return factor * value * value * value if factor != 1 and exponent == 3 else _times(factor, power(value, exponent))


def _times(factor: Any, value: Any) -> Any:
    """The product, and no operation where the factor is the number 1."""
    return value if isinstance(factor, float) and factor == 1 else factor * value


def _positive(value: Any, xp: Any) -> Any:
    """What is above 0."""
    return np.maximum(value, 0) if xp is np else greater(0, value)


def power(value: Any, exponent: int) -> Any:
    """A whole power by multiplications alone."""
    if exponent == 0:
        return 1.0
    result = value
    for digit in f"{exponent:b}"[1:]:
        result = result * result * value if digit == "1" else result * result
    return result


KERNELS = {
    kernel.name: kernel
    for kernel in (
        Kernel("poly6", ((1, 3, (1, 3, 3, 1)),), nested=2.6),
        Kernel("cubic_spline", ((1, 3, (2,)), (1 / 2, 3, (-8,))), ((3, 7), (3, 4)), 6.5),
        Kernel("wendland_c2", ((1, 4, (1, 4)),), ((4, 8),), 14.0),
        Kernel("quartic_spline", ((1, 4, (1,)), (3 / 5, 4, (-5,)), (1 / 5, 4, (10,))), ((4, 9), (4, 2), (4, 1)), 10.0),
        Kernel("quintic_spline", ((1, 5, (1,)), (2 / 3, 5, (-6,)), (1 / 3, 5, (15,))), ((6, 9), (5, 2), (5, 1)), 14.0),
        Kernel("wendland_c4", ((1, 6, (1, 6, 35 / 3)),), ((5, 8),), 17.0),
        Kernel("wendland_c6", ((1, 8, (1, 8, 25, 32)),), ((7, 8),), 24.0),
    )
}  # of Mueller, Charypar & Gross 2003 (equation 20), Monaghan & Lattanzio 1985 (with H = 2h), Dehnen & Aly 2012 (table 1)


def by_name(name: str) -> Kernel:
    """The kernel called `name`; raises `ValueError` listing the known ones."""
    if name not in KERNELS:
        raise ValueError(f"`kernel` must be one of {', '.join(KERNELS)}, got {name!r}{did_you_mean(name, KERNELS)}")
    return KERNELS[name].derived()
