"""Integrals along rays by quadrature in float64 NumPy, with no closed form: of kernels, which projections are, and of profiles.

Flow: particles, camera -> [columns] -> Projection; points, rays, borders of samples -> [columns] -> image.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.particles import kernels
from jaxsph.model.particles.columns import held_by
from jaxsph.model.particles.particles import Particles
from jaxsph.model.points import FALLOFF, Ball, Gaussian, Points, Profile, Shaped, Table
from jaxsph.model.projection import Projection
from jaxsph.reference.where import lines, ray_coordinates, to_view

NODES, WEIGHTS = np.polynomial.legendre.leggauss(32)
BLOCK = 4096  # places at which a function is asked at once: one program, whatever the number of rays
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
    centers, kernel = to_view(particles.exact_position(), camera), kernels.by_name(particles.kernel)
    across, down = np.meshgrid(u, v)
    starts, directions = lines(across, down, camera.is_perspective)
    slant = np.linalg.norm(directions, axis=-1)
    for i in np.flatnonzero(np.asarray(particles.valid)):
        support = float(np.asarray(particles.support)[i])
        foot = ((centers[i] - starts) * directions).sum(-1) / slant**2
        square = ((starts + foot[..., None] * directions - centers[i]) ** 2).sum(-1) / support**2
        met = np.nonzero(square < 1)
        start, end = ((depth - foot[met]) * slant[met] / support for depth in (near, far))
        integral = integral_across(np.array(KINKS), square[met], lambda away, t: kernel.of_square(away + t * t, np), start, end)
        sums[met] += (kernel.norm * integral / support**2)[:, None] * amounts[i]
    parts = sums.reshape(camera.height, number, camera.width, number, -1)
    means: Any = np.einsum("isjtk,s,t->ijk", parts, shares / 2, shares / 2)
    area: Any = np.float64((2 * float(camera.half_height) / camera.height) ** 2)
    if not held.is_mean:
        return Projection(means[..., 0], None, area, camera.is_perspective, name=held.name)
    weights = means[..., 1]
    values: Any = np.where(weights > 0, means[..., 0] / np.where(weights > 0, weights, 1), np.nan)
    return Projection(values, weights, area, camera.is_perspective, name=held.name)


def thickness(points: Points, camera: Camera, u: np.ndarray, v: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Optical thickness of a point set in every sample, summed over its points, and the same times colour.

    Args:
        points: their (possibly float32) numbers are taken as exact.
        camera: of which only pose and projection are looked at.
        u, v: ray coordinates of columns and rows.
        edges: (samples + 1,), depths between which samples stand.

    Returns:
        (height, width, samples) and (height, width, samples, 3).
    """
    total, colored = np.zeros((len(v), len(u), len(edges) - 1)), np.zeros((len(v), len(u), len(edges) - 1, 3))
    across, down = np.meshgrid(u, v)
    starts, directions = lines(across, down, camera.is_perspective)
    axes, center = np.asarray(camera.axes, np.float64), points.exact_position() - camera.exact_eye()
    points = jax.tree.map(np.asarray, points)
    for point in np.flatnonzero(points.valid):
        rows, columns, lengths = _lengths(points, point, camera, axes @ center[point], starts, directions, edges)
        own = float(points.extinction[point]) * float(points.radius[point]) * lengths
        total[rows, columns] += own
        colored[rows, columns] += own[..., None] * np.asarray(points.color[point], np.float64)
    return total, colored


def _lengths(
    points: Points, point: Any, camera: Camera, middle: np.ndarray, starts: np.ndarray, directions: np.ndarray, edges: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns of the rays that pass a point, and integrals of its profile in their samples (rays, samples), in radii."""
    radius, axes, slant = float(points.radius[point]), np.asarray(camera.axes, np.float64), np.linalg.norm(directions, axis=-1)
    foot_depth = ((middle - starts) * directions).sum(-1) / slant**2
    foot = starts + foot_depth[..., None] * directions - middle
    rows, columns = np.nonzero((foot**2).sum(-1) < radius**2)
    foot, slant, foot_depth = foot[rows, columns] / radius, slant[rows, columns], foot_depth[rows, columns]
    attributes = {name: np.asarray(values[point], np.float64) for name, values in points.attributes.items()}
    half = np.sqrt(np.maximum(1 - (foot**2).sum(-1), 0))[:, None]  # of the length inside
    foot, direction = foot @ axes, directions[rows, columns] / slant[:, None] @ axes
    place = (edges - foot_depth[:, None]) * slant[:, None] / radius  # of borders along rays, from the foot on

    def value(_: np.ndarray, t: np.ndarray) -> np.ndarray:
        return at_offset(points.profile, foot[:, None] + t[..., None] * direction[:, None], attributes)

    integral = functools.partial(integral_across, kinks(points.profile), (foot**2).sum(-1)[:, None], value)
    away = np.linalg.norm(middle) if camera.is_perspective else middle[2]
    is_splat = points.splats_beyond is not None and away > float(points.splats_beyond)
    if points.spread == "chords" and not is_splat:
        ends = np.clip(place, -half, half)
        return rows, columns, integral(ends[:, :-1], ends[:, 1:])
    held = (edges[:-1] <= middle[2]) & (middle[2] < edges[1:])
    return rows, columns, held * integral(-half, half)


def kinks(profile: Profile) -> np.ndarray:
    """Distances in [0, 1] between which a profile is smooth, from 0 to 1."""
    return np.linspace(0, 1, profile.values.shape[0]) if isinstance(profile, Table) else np.array([0.0, 1.0])


def at_offset(profile: Profile, offset: np.ndarray, attributes: dict[str, np.ndarray]) -> np.ndarray:
    """A profile at offsets (..., 3) in radii, along world axes, of points with the given attributes (of any shape up to ...)."""
    if isinstance(profile, Shaped):
        given = (*np.moveaxis(offset, -1, 0), *(np.broadcast_to(value, offset.shape[:-1]) for value in attributes.values()))
        blocks = zip(*(np.resize(one, (-(-one.size // BLOCK), BLOCK)) for one in given), strict=True)
        with jax.enable_x64(True):
            found = [jax.jit(profile.function)(block[:3], dict(zip(attributes, block[3:], strict=True))) for block in blocks]
        return np.ravel([np.broadcast_to(one, BLOCK) for one in found])[: given[0].size].reshape(given[0].shape)
    distance = np.linalg.norm(offset, axis=-1)
    if isinstance(profile, Gaussian):
        return np.exp(-FALLOFF * distance**2)
    if isinstance(profile, Ball):
        return np.ones_like(distance)
    if isinstance(profile, Table):
        return np.interp(distance, kinks(profile), np.asarray(profile.values, np.float64))
    raise ValueError(f"`profile` {type(profile).__name__} is unknown to the reference, which has those of `model.points`")


def integral_across(
    kinks: np.ndarray, square: np.ndarray, value: Callable[..., np.ndarray], start: np.ndarray, end: np.ndarray
) -> np.ndarray:
    """Integral along rays from t = `start` to `end`, counted from the foot of a centre; by Gauss-Legendre quadrature.

    Args:
        kinks: distances from the centre, ascending from 0, between which what is integrated is smooth.
        square: of the distance of the foot.
        value: `value(square, t)`.
        start, end: within the last kink, or cut off there.
    """
    rings = np.sqrt(np.maximum(kinks.reshape(-1, *[1] * square.ndim) ** 2 - square, 0))
    total = np.zeros(np.broadcast_shapes(start.shape, end.shape))
    for low, high in itertools.pairwise([*-rings[::-1], *rings]):
        first, last = np.clip(start, low, high), np.clip(end, low, high)
        for node, weight in zip(NODES, WEIGHTS, strict=True):
            total += weight * (last - first) / 2 * value(square, (first + last) / 2 + node * (last - first) / 2)
    return total
