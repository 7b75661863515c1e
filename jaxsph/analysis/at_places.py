r"""What particles are at any places in space, in their dtype and with derivatives; and at the points of a grid.

Flow: Particles, places -> ParticleField -> [at_places] -> sample; resample -> Volume.

What is known is summed up by `model.particles.field`; what has derivatives by JAX, over the same pairs; what is traced over all
pairs, as which are near is not known then.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from jaxsph.analysis.cell_means import cell_means
from jaxsph.engine.request import times
from jaxsph.model.particles import kernels
from jaxsph.model.particles.columns import held_by
from jaxsph.model.particles.field import EvenSamples, ParticleField
from jaxsph.model.particles.particles import Particles, sides_of, two_sum
from jaxsph.model.volume import Volume
from jaxsph.numerics import checks
from jaxsph.numerics.checks import array_of, in_unit, is_traced
from jaxsph.numerics.compiled import ratio
from jaxsph.numerics.trees import fitting, on_host

ON_FACE = 1e-6  # of a spacing, that points of a grid may lie outside of a periodic box
ALL_PAIRS = 1 << 18  # of a block where all are summed up: some MB of offsets
MOST_POINTS = 1 << 28  # of a grid: 2 GiB of float64
ALONG = 0.9  # cosine of the angle to x or y, from which a normal is along it


@checks.typed
def sample(particles: Particles, points: Any, of: Any = None, normalised: bool = True) -> Float[Array, " points"]:
    r"""The field at points, $Q(x) = \sum_j q_j V_j W_j(x) / \sum_j V_j W_j(x)$, or the plain sum $\sum_j a_j W_j(x)$.

    Args:
        particles: kernel and supports are theirs; of a periodic set points outside of its box are moved into it.
        points: (M, 3) length units.
        of: numbers of all particles in their order, or `"volume"` or `"quantity"`: the values $q_j$, default the quantity (of
            two that of colours); or the amounts $a_j$, default the volumes, which give the coverage. Masses give the density.
        normalised: whether it is the field; else the plain sum, whose integral is $\sum_j a_j$.

    Returns:
        (M,) in the dtype of the particles, in units of `of`, or of that over length cubed. Outside of every support the field is
        NaN, a sum 0.

    Differentiation:
        By positions, supports, volumes, `of` and points; who is near is held fixed: a tree on the host finds that, eagerly under
        `jax.grad`, too. Where `jit` or `vmap` hide places, all pairs are summed up, in blocks.

    Raises:
        ValueError: another shape, what is not finite, a unit that is none of lengths, sums beyond the dtype.

    References:
        Hochstetter, Orthmann & Kolb 2016, equations 1 and 2; Price 2012, equation 6 (the sum).
    """
    with checks.at_once(particles, points, of) as traced:
        particles, exponent = carrying(fitting("particles", particles, Particles), of, normalised)
        points = in_unit("points", points, particles.length_unit)
        points = points if is_traced(points) else np.asarray(points)
        checks.require_real("points", points)
        checks.require_shape("points", points, (None, 3), "one row (x, y, z) a point")
        places = points, dataclasses.replace(particles, quantity=particles.support, volume=particles.support)
        there, known = jax.tree.map(lambda leaf: lax.stop_gradient(leaf) if is_traced(leaf) else leaf, places)
        if not is_traced(there):
            checks.require_finite("points", there)
        is_known = len(points) > 0 and not is_traced(there, known)
        there = np.asarray(there, np.float64) if is_known else there
        if is_known and particles.box is not None:
            lower, upper = known.box.corners()
            there = lower + (there - lower) % (upper - lower)
        if not traced:
            at = ParticleField(particles, signed=not normalised).at(there)
            return array_of(rounded(at.quantity if normalised else at.coverage, exponent, particles.dtype))
        first = points.astype(particles.dtype)
        parts = first, (points - first).astype(particles.dtype)  # what is known has digits that only both hold
        digits = 0 if is_traced(known.support) else int(np.frexp(np.asarray(known.support).max())[1])
        field = ParticleField(known) if is_known else None
        blocks = field.blocks(there) if field else [np.s_[:]]
        sums = functools.partial(_sums, particles, unit=np.asarray(2.0**digits, particles.dtype), normalised=normalised)
        found = [sums(tuple(part[one] for part in parts), field and field.padded(there[one])) for one in blocks]
        return times(jnp.concatenate(found), exponent - (0 if normalised else 3 * digits))  # type: ignore[no-any-return]


def carrying(particles: Particles, of: Any, normalised: bool) -> tuple[Particles, int]:
    """Put the numbers `of` into particles, as their quantity, or as their volume for sums that are not normalised.

    They are divided by a power of two, whose exponent is returned, too, so that float32 holds them.
    """
    name = "quantity" if normalised else "volume"
    held = held_by(particles, name if of is None else of, None)
    changed: dict[str, Any] = {name: held.amounts[:, 0]}
    return dataclasses.replace(particles, **changed), held.exponents[0]


def rounded(values: np.ndarray, exponent: int, dtype: Any) -> np.ndarray:
    """Values times a power of two in a dtype; `ValueError` of what it cannot hold."""
    values = np.ldexp(np.asarray(values, np.float64), exponent)
    largest, most = float(np.abs(values).max(initial=0, where=~np.isnan(values))), float(np.finfo(dtype).max)
    if largest > most:
        raise ValueError(f"`of` makes {largest:.3g}, and {dtype} ends at {most:.3g}: give it in another unit")
    return values.astype(dtype)


@functools.partial(jax.jit, static_argnames="normalised")
def _sums(
    particles: Particles, points: tuple[Array, Array], pairs: tuple[Array, ...] | None, unit: Array, normalised: bool
) -> Float[Array, " points"]:
    """Over the pairs given, whose offsets are exact and have derivatives by both ends, or all; a plain sum by cubes of a unit."""
    kernel, support = kernels.by_name(particles.kernel), particles.support
    held, inverse = jnp.where(particles.valid, particles.volume, 0), unit / support
    if normalised:  # ratios alone count
        most, least = lax.stop_gradient((held.max(), support.min()))
        weight = held / jnp.where(most > 0, most, 1) * (least / support) ** 3
        table = jnp.stack([particles.quantity * weight, weight], 1)
    else:
        table = (held * inverse * inverse * (inverse * kernel.norm))[:, None]  # float32 may not hold the cube of a length
    if pairs is None:
        sums = _over_all(particles, points, table)
    else:
        place, entry, offset = pairs
        moved = points[0][place] - particles.position[entry]
        offset = (offset.astype(moved.dtype) + (moved - lax.stop_gradient(moved))) / support[entry, None]
        terms = kernel.of_square((offset**2).sum(1), jnp)[:, None] * table[entry]
        sums = jax.ops.segment_sum(terms, place, len(points[0]))
    return jnp.where(sums[:, 1] > 0, ratio(sums[:, 0], sums[:, 1]), jnp.nan) if normalised else sums[:, 0]


def _over_all(particles: Particles, points: tuple[Array, Array], table: Array) -> Float[Array, "points channels"]:
    """Sums over all particles and, of a periodic set, the two copies nearest along each axis: supports reach no third."""
    count, rows = len(points[0]), max(ALL_PAIRS // particles.capacity, 1)
    particles, kernel, box = particles.wrapped(), kernels.by_name(particles.kernel), particles.box
    blocks = jnp.pad(jnp.stack(points, 1), ((0, -count % rows), (0, 0), (0, 0))).reshape(-1, rows, 2, 3)

    @jax.checkpoint
    def block(parts: Array) -> Array:
        offset, left = two_sum(parts[:, None, 0], -particles.position)
        left = left + parts[:, None, 1] - (0 if particles.position_rest is None else lax.stop_gradient(particles.position_rest))
        offsets = [offset + left]
        if box is not None:
            sides, left_of_sides = sides_of(box)
            turns = jnp.round(lax.stop_gradient(offset) / sides)
            offset = (offset - turns * sides) + (left - turns * left_of_sides)  # of those near the first difference is exact
            offsets = [offset, offset + jnp.where(offset < 0, sides, -sides)]
        squares = [(one / particles.support[:, None]) ** 2 for one in offsets]
        square = (x[..., 0] + y[..., 1] + z[..., 2] for x, y, z in itertools.product(squares, repeat=3))
        weight: Any = sum(kernel.of_square(one, jnp) for one in square)
        return jnp.matmul(weight, table, precision=lax.Precision.HIGHEST)

    return lax.map(block, blocks).reshape(-1, table.shape[1])[:count]  # type: ignore[no-any-return]


@on_host
def resample(
    particles: Particles,
    lower: Any,
    spacing: Any,
    shape: tuple[int, int, int],
    *,
    fill: float = 0.0,
    of: Any = None,
    normalised: bool = True,
    cell: str = "point",
) -> Volume:
    r"""The field $Q(x) = \sum q_j V_j W_j(x) / \sum V_j W_j(x)$ at the points of a grid, or a plain sum (host side, float64).

    Args:
        particles: whose quantity is resampled; of two, that of colours. Of a periodic set one period: there is nothing outside.
        lower: (3,) position of the point (0, 0, 0), length units.
        spacing: between neighbouring points, length units: a number, or (3,); > 0.
        shape: points along x, y and z, at least 2 each.
        fill: value of points outside of every support. Particles show nothing there, a volume what its transfer function makes of
            `fill`: give a value beyond the quantities, and extinction 0 from there to the first that is to be shown. Between a
            point inside and one outside the volume is interpolated, so borders are blurred by a cell. Of a plain sum, which is 0
            outside of supports, that of points outside of a period.
        of, normalised: as for `jaxsph.sample`: the plain sum of masses is the density, whose integral is the mass.
        cell: "point" for values at points; "mean" for those over the cells around them, half a spacing to either side. Means of
            the plain sum times the volume of a cell add up to what particles have in the grid, however small their supports
            are; those of the field weigh by $V_j W_j$, as it does. Cells of a periodic set hold the matter of all its copies.

    Returns:
        Volume of the particles' dtype.

    Raises:
        ValueError: a shape, spacing, lower corner or fill out of range.

    References:
        Hochstetter, Orthmann & Kolb 2016, equations 1 and 2.
    """
    places = {"lower": lower, "spacing": spacing}.items()
    lower, spacing = (np.asarray(in_unit(name, value, particles.length_unit), np.float64) for name, value in places)
    counts = np.asarray(checks.require_real("shape", checks.plain("shape", shape)))
    if counts.shape != (3,) or not ((counts == np.floor(counts)) & (counts >= 2)).all():
        raise ValueError(f"`shape` must be three integers of at least 2, got {shape!r:.60}; give the points along x, y and z")
    if (most := float(np.prod(counts, dtype=np.float64))) > MOST_POINTS:
        raise ValueError(f"`shape` = {shape} has {most:.3g} points, more than {MOST_POINTS:,}: give fewer, farther apart")
    for name, value, shapes in (("lower", lower, [(3,)]), ("spacing", spacing, [(), (3,)]), ("fill", np.asarray(fill), [()])):
        if value.shape not in shapes:
            raise ValueError(f"`{name}` must have shape {' or '.join(map(str, shapes))}, got {value.shape}")
        checks.require_finite(name, value, "give finite numbers")
    checks.require_positive("spacing", spacing, "spacing is the distance between neighbouring grid points")
    spacing = np.broadcast_to(spacing, 3)
    if cell not in ("point", "mean"):
        raise ValueError(f"`cell` must be 'point' or 'mean', got {cell!r}; means keep the mass of particles")
    values = _on_grid(particles, lower, spacing, shape, of, normalised, cell)
    inside = np.isfinite(values)
    for axis, (low, high) in enumerate(() if particles.box is None else zip(*particles.box.corners(), strict=True)):
        at, slack = lower[axis] + spacing[axis] * np.arange(shape[axis]), ON_FACE * spacing[axis]
        inside &= np.moveaxis(((at >= low - slack) & (at <= high + slack))[:, None, None], 0, axis)
    values = np.where(inside, values, fill).astype(particles.dtype)
    made = Volume.from_array(values, lower, spacing)
    return dataclasses.replace(made, length_unit=particles.length_unit)


def _on_grid(
    particles: Particles, lower: np.ndarray, spacing: np.ndarray, shape: tuple[int, ...], of: Any, normalised: bool, cell: str
) -> Float[np.ndarray, "x y z"]:
    """Values at the points of a grid, or means over the cells around them; NaN where the normalised field has none."""
    if cell == "mean":
        held, exponent = carrying(particles, of, normalised)
        field = ParticleField(held, copied=False, signed=not normalised)
        amounts = np.stack([field.volume, *(field.volume * one for one in field.quantities[: int(normalised)])])
        sums = cell_means(field, amounts, particles.box, lower, spacing, (int(shape[0]), int(shape[1]), int(shape[2])))
        return rounded(field_of(sums, normalised), exponent, particles.dtype)
    x, y, _ = (step * np.arange(points) for step, points in zip(spacing, shape, strict=True))
    rays = EvenSamples(y, x, 0.0, spacing[2], int(shape[2]), np.zeros(shape[:2]), False)  # along z
    held, exponent = carrying(particles, of, normalised)
    field = ParticleField(held, signed=not normalised)
    sums, unit = field.along(rays, (field.position - lower)[:, [1, 0, 2]], int(normalised))
    return rounded(field_of(sums if normalised else unit * sums, normalised), exponent, particles.dtype)


def field_of(sums: np.ndarray, normalised: bool) -> np.ndarray:
    """The field of sums of weights and of weighted quantities, NaN where there is nothing; or the first of them."""
    weight = sums[0]
    return np.divide(sums[1], weight, out=np.full_like(weight, np.nan), where=weight > 0) if normalised else weight
