"""Projections in the oracle: particle by particle, by quadrature of kernels along rays in float64 NumPy, with no closed form.

Flow: particles, camera -> [columns] -> Projection.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.snug import with_depths
from jaxsph.model.particles import kernels
from jaxsph.model.particles.held import held_by
from jaxsph.model.particles.particles import Particles
from jaxsph.model.projection import Projection
from jaxsph.reference.where import integral_across, lines, ray_coordinates, to_view

KINKS = 0.0, 0.2, 1 / 3, 0.5, 0.6, 2 / 3, 1.0  # distances in supports between which all kernels are smooth


def project(
    particles: Particles,
    camera: Camera,
    of: Any = None,
    weight: Any = None,
    *,
    pixel: str = "mean",
    depth_range: tuple[float, float] | None = None,
    subrays: int = 8,
) -> Projection:
    """Integrals along rays as `jaxsph.project` has them.

    Args:
        particles, camera, of, weight, pixel, depth_range: as for `jaxsph.project`; their numbers are taken as exact. No period is
            known: give copies, and the depths of the faces.
        subrays: of means, rays a pixel on each axis, by Gauss-Legendre quadrature: too few for supports that are much smaller
            than a pixel.

    Returns:
        Values of float64 NumPy arrays.
    """
    held = held_by(particles, of, weight)
    amounts = np.ldexp(np.asarray(held.amounts, np.float64), held.exponents)
    near, far = (float(depth) for depth in (depth_range or with_depths(camera, particles).near_and_far()))
    number = 1 if pixel == "ray" else subrays
    places, shares = np.polynomial.legendre.leggauss(number)
    columns, rows = ((np.arange(size)[:, None] + (1 + places) / 2).ravel() for size in (camera.width, camera.height))
    u, v = ray_coordinates(camera, columns, rows)
    sums = np.zeros((len(v), len(u), amounts.shape[1]))
    views, (across, down) = to_view(particles.exact_position(), camera), np.meshgrid(u, v)
    rays = lines(across, down, camera.is_perspective)
    for i in np.flatnonzero(np.asarray(particles.valid)):
        column = _column(particles.kernel, views[i], float(np.asarray(particles.support)[i]), *rays, (near, far))
        sums += column[..., None] * amounts[i]
    parts = sums.reshape(camera.height, number, camera.width, number, -1)
    means: Any = np.einsum("isjtk,s,t->ijk", parts, shares / 2, shares / 2)
    area: Any = np.float64((2 * float(camera.half_height) / camera.height) ** 2)
    if not held.is_mean:
        return Projection(means[..., 0], None, area, camera.is_perspective, name=held.name)
    weights = means[..., 1]
    values: Any = np.where(weights > 0, means[..., 0] / np.where(weights > 0, weights, 1), np.nan)
    return Projection(values, weights, area, camera.is_perspective, name=held.name)


def _column(
    kernel: str, center: np.ndarray, support: float, starts: np.ndarray, directions: np.ndarray, depths: tuple[float, float]
) -> np.ndarray:
    """Integral of the kernel of one particle along all rays, (rows, columns)."""
    slant = np.linalg.norm(directions, axis=-1)
    foot = ((center - starts) * directions).sum(-1) / slant**2
    square = ((starts + foot[..., None] * directions - center) ** 2).sum(-1) / support**2
    met = np.nonzero(square < 1)
    column, square, smooth = np.zeros(square.shape), square[met], kernels.by_name(kernel)
    start, end = ((depth - foot[met]) * slant[met] / support for depth in depths)
    total = integral_across(np.array(KINKS), square, start, end, lambda t: smooth.of_square(square + t * t, np))
    column[met] = smooth.norm * total / support**2
    return column
