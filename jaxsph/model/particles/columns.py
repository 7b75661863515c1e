r"""What projections sum up: amounts that particles hold, and what of a kernel lies along a ray, between depths and in a pixel.

Flow: particles, names or arrays -> [columns] -> project, reference.

Lengths are in supports: a ray passes a particle at the distance b, and t counts from the foot of its centre on the ray. All
kernels are sums of polynomials in r, each inside a radius c of its own, and $r = \sqrt{b^2 + t^2}$. So all integrals follow from

$$I_n(t) = \int_0^t r^n dt = \frac{t r^n + n b^2 I_{n-2}(t)}{n + 1}, \quad I_0 = t, \quad I_{-1} = \mathrm{asinh}(t / b),$$

which is exact for whole chords and for any part of one.

In float32 whole columns are read from a fit, which takes a thirtieth of the time: $F(b) \approx \sum_c (1 - b / c)_+^m P_c(b)$
over the radii c where pieces of the kernel end, with polynomials that are found in float64, and of unit integral as well.

Polynomials of kernels of high order have terms a thousand times their sum. Along a ray these are integrated by Gauss-Legendre
quadrature of the kernel itself, between the radii where its pieces end: in each shell it is smooth, its values are positive, and
rounding stays that of the kernel. Across planes, each of their pieces is a polynomial in the distance $d = c - r$ to its edge,
which is integrated twice in closed form. Functions take `xp`, which is `numpy` or `jax.numpy`.

Means over pixels are exact however small a support is. With $G(x, y) = \int_0^x \int_0^y F$, the integral of a column F over a
rectangle is a difference of G at its four corners. G is smooth, symmetric and odd in x and y, so that a few products do:
$G(x, y) \approx \sum_k \lambda_k g_k(x) g_k(y)$ with polynomials $g_k$. Shares of neighbouring pixels are differences of the same
numbers, so they add up to what the whole image holds: mass is kept to rounding, whatever the error of a share.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.numerics import checks
from jaxsph.numerics.checks import array_of, is_traced

MIN_SQUARE = kernels.MIN_SQUARE  # under roots and logarithms of b^2, whose slopes it keeps finite
ANY_FIT = (10, 4)  # coefficients of the outermost term and of others, where a kernel says nothing: good to 5e-6 of F(0)
FITTED_AT, ROUNDS = 300, 10  # distances of a fit for each radius, and how often those that it is worst at are given more weight
TERMS = 24  # odd Chebyshev polynomials that each g_k is made of
PRODUCTS = 8  # with more, the error of the fit by polynomials is larger than that of leaving out the rest
CELLS, CELL_NODES = 160, 6  # of the quadrature, on each axis
MOST_TERMS = 64  # times its peak that terms of a kernel may be in all, where columns are to be its antiderivatives
NODES, WEIGHTS = ((values + shift) / 2 for values, shift in zip(np.polynomial.legendre.leggauss(16), (1, 0), strict=True))


@dataclasses.dataclass(frozen=True)
class Held:
    """Amounts, or values times weights and weights.

    Attributes:
        amounts: over powers of two, such that float32 holds them; 0 where there is no particle.
        exponents: of those powers, of each channel.
        is_mean: whether there is a weight.
        name: of what was asked for.
    """

    amounts: Float[Array, "particles channels"]
    exponents: tuple[int, ...]
    is_mean: bool
    name: str


def unit_held(particles: Particles, of: Any, weight: Any) -> str:
    """The unit of what is summed up, as far as `of` carries one: of a mean that itself, else of it a unit of area."""
    unit = checks.unit_of(of)
    if unit is None or str(unit) in checks.NO_UNITS:
        return ""
    area = "a unit of area" if particles.length_unit is None else f"/ ({particles.length_unit})**2"
    return str(unit) if weight is not None else f"{unit} {area}"


def held_by(particles: Particles, of: Any, weight: Any) -> Held:
    """What is to be summed up, checked.

    Raises `ValueError`: an unknown name, another length, numbers that are not finite, weights < 0.
    """
    of = ("volume" if weight is None else "quantity") if of is None else of
    name = of if isinstance(of, str) else "values"
    values = values_held(particles, "of", of)
    if weight is None:
        return Held(*_scaled(particles, [values]), False, name)
    weights = values_held(particles, "weight", weight)
    if not is_traced(weights):
        checks.require_positive("weight", weights, "means need weights that are not negative", strict=False)
    return Held(*_scaled(particles, [values * weights, weights]), True, name)


def require_usable(particles: Particles) -> None:
    """Raise `ValueError` that names the first position or support that has no column (host side)."""
    valid = np.asarray(particles.valid)
    support = np.where(valid, particles.support, 1)
    checks.require_finite("particles.position", np.where(valid[:, None], particles.position, 0))
    checks.require_finite("particles.support", support)
    checks.require_positive("particles.support", support, "give the support radius H > 0 of every particle")


def emission_measure(mass: Any, density: Any, coefficient: Any = 1.0, power: float = 2.0) -> Any:
    r"""Amounts whose projection is the integral of $A \rho^n$ along rays: $A_j \rho_j^{n-1} m_j$.

    For n = 1 that is $A$ times the column density, exactly. For others it is the SPH sum of $A \rho^{n-1}$, each particle with
    the density of its own; the power of the summed density at a point is another number, and no sum over particles.

    Args:
        mass, density: of particles, in the order of their arrays.
        coefficient: A, one number or one a particle, such as a cooling function of the temperature.
        power: n.

    Raises:
        ValueError: arrays with units, as the unit of what they give is not worked out here; masked arrays.
    """
    given = {"mass": mass, "density": density, "coefficient": coefficient}
    why = "units are not multiplied here", "and name that of the result yourself"
    mass, density, coefficient = (checks.plain(name, value, *why) for name, value in given.items())
    if any(is_traced(value) for value in (mass, density, coefficient)):
        return coefficient * jnp.asarray(density) ** (power - 1) * mass
    parts = [np.asarray(value, np.float64) for value in (mass, density, coefficient)]
    return parts[2] * parts[1] ** (power - 1) * parts[0]


def values_held(particles: Particles, name: str, given: Any) -> Any:
    """A column of particles: a number for each entry, in float64 where they are known."""
    if isinstance(given, str):
        if given not in ("volume", "quantity"):
            known = "'volume' or 'quantity'"
            raise ValueError(f"`{name}` must be {known}, columns that particles have, or one number a particle; got {given!r}")
        given = getattr(particles, given)
    value = checks.require_real(name, checks.own(name, given))
    value = value if is_traced(value) else np.asarray(value)
    count = None if is_traced(particles.valid) else particles.num_particles
    if value.ndim != 1 or value.shape[0] not in (count, particles.capacity):
        expected = f"({particles.capacity if count is None else count},)"
        raise ValueError(f"`{name}` must have shape {expected}, one number for each particle, got {tuple(value.shape)}")
    valid = None if count is None else np.asarray(particles.valid)
    if valid is not None and value.shape[0] == count and not valid[:count].all():  # some are left out in between
        value = value[np.maximum(np.cumsum(valid) - 1, 0)]
    if is_traced(value):
        return jnp.pad(value, (0, particles.capacity - value.shape[0]))
    if valid is not None:
        checks.require_finite(name, np.where(valid[: len(value)], value, 0))
    return np.pad(value.astype(np.float64), (0, particles.capacity - len(value)))


def _scaled(particles: Particles, channels: list[Any]) -> tuple[Any, tuple[int, ...]]:
    """Channels side by side, over the power of two next to their largest number where that is known."""
    dtype = particles.dtype
    if is_traced(particles.valid, *channels):
        return jnp.stack([jnp.where(particles.valid, one, 0).astype(dtype) for one in channels], 1), (0,) * len(channels)
    known = [np.where(np.asarray(particles.valid), one, 0) for one in channels]
    largest = [float(np.abs(one).max(initial=0)) for one in known]
    exponents = tuple(math.frexp(one)[1] if math.isfinite(one) else 0 for one in largest)
    columns = [np.ldexp(one, -exponent).astype(dtype) for one, exponent in zip(known, exponents, strict=True)]
    return array_of(np.stack(columns, 1)), exponents


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
    if xp is jnp and jnp.result_type(square) == jnp.float32:
        return _fitted(name, "column", square)
    return kernels.by_name(name).norm * xp.maximum(2 * _along_ray(name, square, xp.ones_like(square), xp), 0)


def curvature(name: str, square: Float[Array, "..."]) -> Float[Array, "..."]:
    """The Laplacian of `whole_column` across the line, to 0.2 of F(0).

    A mean over a square of side w differs by $w^2 / 24$ of it from the value in the middle.
    """
    return _fitted(name, "curvature", square)


def _fitted(name: str, what: str, square: Array) -> Array:
    clipped = jnp.clip(square, MIN_SQUARE, 1)
    kernel = kernels.by_name(name)
    if kernel.even and what == "column":
        within, peak = 1 - clipped, float(whole_column(name, np.float64(0), np))
        return peak * (kernels.power(within, kernel.edge) * jnp.sqrt(jnp.maximum(within, MIN_SQUARE)))
    b, total = jnp.sqrt(clipped), jnp.zeros_like(clipped)
    for radius, power, coefficients in fit_of(name, what):
        x, value = b * (2 / radius) - 1, jnp.full_like(b, coefficients[-1])
        for coefficient in coefficients[-2::-1]:
            value = value * x + coefficient
        total = total + kernels.power(1 - b if radius == 1 else jnp.maximum(1 - b / radius, 0), power) * value
    return jnp.maximum(total, 0) if what == "column" else total


@functools.cache
def fit_of(name: str, what: str) -> list[tuple[float, int, list[float]]]:
    """Terms of the `"column"` of a kernel or its `"curvature"`: radius c, power m, and coefficients of powers of 2 b / c - 1."""
    shape = _shape_of(kernels.by_name(name), what)
    at = (1 - np.cos(np.linspace(0, np.pi, FITTED_AT))) / 2
    b = np.unique(np.concatenate([radius * at for radius in kernels.by_name(name).ends]))
    peak = whole_column(name, np.float64(0), np)
    wanted = whole_column(name, b * b, np) if what == "column" else _curvature(name, b)
    terms = [
        np.maximum(1 - b / radius, 0)[:, None] ** power
        * np.polynomial.chebyshev.chebvander(np.minimum(2 * b / radius, 2) - 1, number - 1)
        for radius, power, number in shape
    ]
    matrix, weight = np.concatenate(terms, 1), np.ones_like(b)
    best: tuple[float, Any] = np.inf, None
    for _ in range(ROUNDS):
        found = np.linalg.lstsq(matrix * weight[:, None], wanted * weight, rcond=1e-14)[0]
        off = np.abs(matrix @ found - wanted) / peak
        best = min(best, (float(off.max()), found), key=lambda one: one[0])
        weight = weight * (off / off.max() + 1e-3) ** 0.3
    kept = np.trapezoid(b * (matrix @ best[1]), b) / np.trapezoid(b * wanted, b) if what == "column" else 1  # of the mass
    parts = np.split(best[1] / kept, np.cumsum([number for *_, number in shape])[:-1])
    return [
        (radius, power, np.polynomial.chebyshev.cheb2poly(part).tolist())
        for (radius, power, _), part in zip(shape, parts, strict=True)
    ]


def _shape_of(kernel: kernels.Kernel, what: str) -> list[tuple[float, int, int]]:
    """Where each term of a fit ends, its power there, and how many coefficients it has.

    Of curvatures, whose terms are to be good to 0.2 F(0), a cube has kinks at all of its ends, of others one term will do.
    """
    if what == "column":
        any_fit = [(kernel.edge, ANY_FIT[end < 1]) for end in kernel.ends]
        return [(end, *one) for end, one in zip(kernel.ends, kernel.fit or any_fit, strict=True)]
    ends = kernel.ends if kernel.edge == 3 else kernel.ends[:1]
    power = max(2, kernel.edge - 2 - kernel.edge % 2)
    return [(end, power, 2 if end < 1 else 7 - len(ends)) for end in ends]


def _curvature(name: str, b: np.ndarray) -> np.ndarray:
    """By differences of the closed form."""
    step = 2e-4
    at = np.clip(b, step, 1 - step)
    before, here, after = (whole_column(name, (at + side * step) ** 2, np) for side in (-1, 0, 1))
    return np.asarray((after - 2 * here + before) / step**2 + (after - before) / (2 * step * at))


def column_between(name: str, square: Any, start: Any, end: Any, xp: Any = jnp) -> Any:
    """The same integral from t = `start` to t = `end`, with start <= end; all three broadcast."""
    first, last = (_along_ray(name, square, t, xp) for t in (start, end))
    return kernels.by_name(name).norm * xp.maximum(last - first, 0)


def depth_share(name: str, start: Any, end: Any, xp: Any = jnp) -> Any:
    """How much of a kernel of support 1 lies between two planes at distances `start` <= `end` from its centre, in [0, 1]."""
    return xp.clip(_below(name, end, xp) - _below(name, start, xp), 0, 1)


@functools.cache
def pieces_of(name: str) -> list[tuple[float, list[float]]]:
    """Radii, and polynomials in r inside of them, by coefficients of powers of r from 0 on, without norms.

    None where their terms are so much larger than the kernel that rounding would be too much.
    """
    kernel = kernels.by_name(name)
    if abs(kernel.powers).sum() > MOST_TERMS * kernel.powers[:, 0].sum():
        return []
    return list(zip(kernel.ends, kernel.powers.astype(float).tolist(), strict=True))


def _along_ray(name: str, square: Any, t: Any, xp: Any) -> Any:
    """Integral of a kernel of support 1, unnormed, from the foot of its centre on a ray to t, as far as it reaches; odd in t."""
    pieces, total = pieces_of(name), 0.0
    if not pieces:
        return _along_shells(kernels.by_name(name), square, t, xp)
    for radius, coefficients in pieces:
        half, inside = _half_chord(radius, square, xp)
        total = total + xp.where(inside, _from_foot(coefficients, square, xp.clip(t, -half, half), xp), 0)
    return total


def _half_chord(radius: float, square: Any, xp: Any) -> tuple[Any, Any]:
    """Half of the length inside a radius, and whether there is any. Held fixed, as a kernel ends with the value 0."""
    within = radius**2 - square
    inside = within > 0
    half = xp.sqrt(xp.where(inside, within, 1))
    return (jax.lax.stop_gradient(half) if xp is jnp else half), inside


def _from_foot(coefficients: list[float], square: Any, t: Any, xp: Any) -> Any:
    """Integral of a piece from the foot to t, inside."""
    solid = square + MIN_SQUARE
    r = xp.sqrt(solid + t * t)
    integral, powers = {0: t}, {0: 1.0, 1: r}
    odd = any(coefficients[1::2])
    if odd:
        integral[-1] = xp.sign(t) * (xp.log(abs(t) + r) - 0.5 * xp.log(solid))
    total = coefficients[0] * t
    for n in range(1, len(coefficients)):
        powers[n] = powers[n - 1] * r
        if n % 2 and not odd:
            continue
        integral[n] = (t * powers[n] + n * solid * integral[n - 2]) / (n + 1)
        total = total + coefficients[n] * integral[n]
    return total


def _along_shells(kernel: kernels.Kernel, square: Any, t: Any, xp: Any) -> Any:
    """The same by quadrature. Between shells there is no gap: what one gains the next loses."""
    total, reached = 0.0, xp.zeros_like(square * t)
    for radius in reversed(kernel.ends):
        half, inside = _half_chord(radius, square, xp)
        half = xp.where(inside, half, 0)
        end = xp.where(abs(t) <= half, abs(t), half)  # chosen, not the less of both: where they are alike t has the derivative
        end = xp.where(end > reached, end, reached)
        length = end - reached
        for node, weight in zip(NODES.tolist(), WEIGHTS.tolist(), strict=True):
            at = reached + node * length
            total = total + weight * length * kernel.of_square(square + at * at, xp)
        reached = end
    return xp.sign(t) * total


def _below(name: str, z: Any, xp: Any) -> Any:
    """How much of a kernel of support 1 lies between its centre and a plane at z; negative where z is."""
    kernel, beyond = kernels.by_name(name), 0.0
    for radius, coefficients in zip(kernel.ends, kernel.distances, strict=True):
        d = xp.maximum(radius - abs(z), 0)
        for power in np.flatnonzero(coefficients).tolist():
            n = power + 2
            beyond = beyond + float(coefficients[power]) * d**n * (radius / ((n - 1) * n) - d / (n * (n + 1)))
    return xp.sign(z) * (0.5 - 2 * math.pi * kernel.norm * beyond)


@functools.cache
def shares_of(name: str) -> tuple[Float[np.ndarray, "terms products"], list[float]]:
    """Coefficients of g_k times the root of lambda_k's size, by odd Chebyshev polynomials (terms, products); signs of lambda_k.

    Fitted in float64 to quadrature; the density of shares is good to 1e-4 of F(0), and that of the whole plane is 1.
    """
    edges, corner = _corner_integrals(name)
    odd = np.polynomial.chebyshev.chebvander(edges, 2 * TERMS - 1)[:, 1::2]
    inverse = np.linalg.pinv(odd)
    factors, vectors = np.linalg.eigh(inverse @ corner @ inverse.T)
    largest = np.argsort(-np.abs(factors))[:PRODUCTS]
    factors, polynomials = factors[largest], vectors[:, largest]
    whole = 4 * (factors * polynomials.sum(0) ** 2).sum()  # every polynomial is 1 at 1
    return polynomials * np.sqrt(np.abs(factors / whole)), np.sign(factors).tolist()


def side_shares(
    name: str, edges: Float[Array, "particles edges bundles"]
) -> tuple[Float[Array, "particles products pixels bundles"], Float[Array, "particles pixels bundles"]]:
    """What pixels between edges on one axis, counted from a support's centre in supports, have of each of the products.

    Also their squared distance from the centre. Edges ascend.
    """
    at = jnp.clip(edges, -1, 1)[:, None]
    double = 4 * at * at - 2
    odd = [at, at * (double - 1)]
    for _ in range(TERMS - 2):
        odd.append(double * odd[-1] - odd[-2])  # T_(n+2) = 2 T_2 T_n - T_(n-2), exactly 1 at the edge of a support
    rows = shares_of(name)[0].astype(at.dtype)
    values = functools.reduce(jnp.add, [row[:, None, None] * term for row, term in zip(rows[::-1], odd[::-1], strict=True)])
    nearest = jnp.maximum(jnp.maximum(edges[:, :-1], -edges[:, 1:]), 0)
    return values[:, :, 1:] - values[:, :, :-1], nearest**2


def pixel_shares(
    name: str, across: tuple[Array, Array], down: tuple[Array, Array]
) -> Float[Array, "*particles down across bundles"]:
    """Integrals of a column of support 1 over pixels, of what `side_shares` has on either axis; of one particle or several.

    What lies outside the support has exactly nothing, and no share is negative.
    """
    (of_x, near_x), (of_y, near_y) = across, down
    products = [of_y[..., k, :, None, :] * of_x[..., k, None, :, :] for k in range(PRODUCTS)]
    total = functools.reduce(jnp.add, [product * sign for product, sign in zip(products, shares_of(name)[1], strict=True)])
    return jnp.where(near_y[..., :, None, :] + near_x[..., None, :, :] < 1, jnp.maximum(total, 0), 0)


def _corner_integrals(name: str) -> tuple[Any, Any]:
    """Edges from 0 to 1, dense where the support ends, and G at all pairs of them."""
    edges = np.sin(np.linspace(0, np.pi / 2, CELLS + 1))
    nodes, weights = np.polynomial.legendre.leggauss(CELL_NODES)
    sizes = np.diff(edges)[:, None]
    at, weight = (edges[:-1, None] + sizes * (nodes + 1) / 2).ravel(), (sizes * weights / 2).ravel()
    cells = whole_column(name, at[:, None] ** 2 + at**2, np) * weight[:, None] * weight
    cells = cells.reshape(CELLS, CELL_NODES, CELLS, CELL_NODES).sum((1, 3))
    corner = np.zeros((CELLS + 1, CELLS + 1))
    corner[1:, 1:] = cells.cumsum(0).cumsum(1)
    return edges, corner
