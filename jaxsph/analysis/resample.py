"""From particles to a grid: their CSPH field at the points of a lattice, as a volume.

Flow: particles -> [resample] -> Volume -> render, write_volume.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxsph.analysis.at_places import carrying, rounded
from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.model.particles.periodic import with_ghosts
from jaxsph.model.preview.glimpse import EvenSamples
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import require_finite, require_positive
from jaxsph.numerics.given import in_unit
from jaxsph.numerics.trees import on_host

ON_FACE = 1e-6  # of a spacing, that points may lie outside of a periodic box


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

    Returns:
        Volume of the particles' dtype.

    Raises:
        ValueError: a shape, spacing, lower corner or fill out of range.

    References:
        Hochstetter, Orthmann & Kolb 2016, equations 1 and 2.
    """
    places = {"lower": lower, "spacing": spacing}.items()
    lower, spacing = (np.asarray(in_unit(name, value, particles.length_unit), np.float64) for name, value in places)
    if len(shape) != 3 or any(int(points) != points or points < 2 for points in shape):
        raise ValueError(f"`shape` must be three integers of at least 2, got {tuple(shape)}; give the points along x, y and z")
    for name, value, shapes in (("lower", lower, [(3,)]), ("spacing", spacing, [(), (3,)]), ("fill", np.asarray(fill), [()])):
        if value.shape not in shapes:
            raise ValueError(f"`{name}` must have shape {' or '.join(map(str, shapes))}, got {value.shape}")
        require_finite(name, value, "give finite numbers")
    require_positive("spacing", spacing, "spacing is the distance between neighbouring grid points")
    (held, exponent), spacing = carrying(particles, of, normalised), np.broadcast_to(spacing, 3)
    weight, *weighted = _sums(lower, spacing, tuple(map(int, shape)), with_ghosts(held), normalised)
    inside = weight > 0 if normalised else np.ones(shape, bool)
    for axis, (low, high) in enumerate(() if particles.box is None else zip(*particles.box.corners(), strict=True)):
        at, slack = lower[axis] + spacing[axis] * np.arange(shape[axis]), ON_FACE * spacing[axis]
        inside &= np.moveaxis(((at >= low - slack) & (at <= high + slack))[:, None, None], 0, axis)
    sums = weighted[0] / np.where(inside, weight, 1) if normalised else weight
    values = np.where(inside, rounded(sums, exponent, particles.dtype), fill).astype(particles.dtype)
    made = Volume.from_array(values, lower, spacing)
    return dataclasses.replace(made, length_unit=particles.length_unit)


def _sums(lower: np.ndarray, spacing: np.ndarray, shape: tuple[int, ...], particles: Particles, normalised: bool) -> np.ndarray:
    """Sums of weights, and where normalised of quantities times weights, at all points of a grid: rays along z, rows along x."""
    columns, kernel = particles.to_numpy(), kernels.by_name(particles.kernel)
    view = (particles.exact_position()[np.asarray(particles.valid)] - lower)[:, [1, 0, 2]]
    support, quantity, volume = (columns[name].astype(np.float64) for name in ("support", "quantity", "volume"))
    x, y, _ = (step * np.arange(points) for step, points in zip(spacing, shape, strict=True))
    if normalised:  # ratios alone count, however far apart
        strength = np.log(np.where(volume > 0, volume, 1)) - 3 * np.log(support)
        largest = strength.max(initial=-np.inf, where=volume > 0)
        strength = np.where(volume > 0, np.exp(np.minimum(strength - largest, 0)), 0)
        amounts = np.stack([strength, strength * quantity])
    else:
        amounts = (kernel.norm * volume / support**3)[None]
    return EvenSamples(y, x, 0.0, spacing[2], shape[2], np.zeros(shape[:2]), False).sums(view, support, amounts, kernel)
