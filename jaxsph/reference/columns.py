"""Projections in the oracle: particle by particle, by quadrature of kernels along rays in float64 NumPy, with no closed form.

Flow: particles, camera -> [columns] -> Projection.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from jaxsph.model import kernels
from jaxsph.model.camera.camera import Camera
from jaxsph.model.held import held_by
from jaxsph.model.particles import Particles
from jaxsph.model.projection import Projection

NODES, WEIGHTS = np.polynomial.legendre.leggauss(32)
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
    near, far = (float(depth) for depth in (depth_range or (camera.near, camera.far)))
    number = 1 if pixel == "ray" else subrays
    places, shares = np.polynomial.legendre.leggauss(number)
    u, v = _ray_coordinates(camera, (1 + places) / 2)
    sums = np.zeros((len(v), len(u), amounts.shape[1]))
    views = (particles.exact_position() - camera.exact_eye()) @ np.asarray(camera.axes, np.float64).T
    for i in np.flatnonzero(np.asarray(particles.valid)):
        column = _column(particles.kernel, views[i], float(particles.support[i]), u, v, (near, far), camera.is_perspective)
        sums += column[..., None] * amounts[i]
    parts = sums.reshape(camera.height, number, camera.width, number, -1)
    means: Any = np.einsum("isjtk,s,t->ijk", parts, shares / 2, shares / 2)
    area: Any = np.float64((2 * float(camera.half_height) / camera.height) ** 2)
    if not held.is_mean:
        return Projection(means[..., 0], None, area, camera.is_perspective, name=held.name)
    weights = means[..., 1]
    values: Any = np.where(weights > 0, means[..., 0] / np.where(weights > 0, weights, 1), np.nan)
    return Projection(values, weights, area, camera.is_perspective, name=held.name)


def _ray_coordinates(camera: Camera, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    half = float(camera.half_height)
    columns, rows = ((np.arange(size)[:, None] + places).ravel() for size in (camera.width, camera.height))
    return half * camera.width / camera.height * (2 * columns / camera.width - 1), half * (1 - 2 * rows / camera.height)


def _column(
    kernel: str,
    center: np.ndarray,
    support: float,
    u: np.ndarray,
    v: np.ndarray,
    depths: tuple[float, float],
    perspective: bool,
) -> np.ndarray:
    """Integral of the kernel of one particle along all rays, (rows, columns)."""
    aside = np.stack([*np.meshgrid(u, v), np.zeros((len(v), len(u)))], -1)
    ahead = np.broadcast_to(np.array([0.0, 0.0, 1.0]), aside.shape)
    starts, directions = (np.zeros_like(aside), aside + ahead) if perspective else (aside, ahead)
    slant = np.linalg.norm(directions, axis=-1)
    foot = ((center - starts) * directions).sum(-1) / slant**2
    square = ((starts + foot[..., None] * directions - center) ** 2).sum(-1) / support**2
    met = np.nonzero(square < 1)
    column, square = np.zeros(square.shape), square[met]
    start, end = ((depth - foot[met]) * slant[met] / support for depth in depths)
    rings = np.sqrt(np.maximum(np.array(KINKS)[:, None] ** 2 - square, 0))
    total, smooth = np.zeros(square.shape), kernels.by_name(kernel)
    for low, high in itertools.pairwise([*-rings[::-1], *rings]):
        first, last = np.clip(start, low, high), np.clip(end, low, high)
        for node, share in zip(NODES, WEIGHTS, strict=True):
            t = (first + last) / 2 + node * (last - first) / 2
            total += share * (last - first) / 2 * smooth.of_square(square + t * t, np)
    column[met] = smooth.norm * total / support**2
    return column
