"""The oracle: the same image in float64 NumPy, particle by particle and sample by sample, with no grid and no cleverness.

Flow: scene, camera -> [image] -> Image; particles, camera -> [image] -> Projection.

It follows Hochstetter et al. 2016, sections 2.1 and 2.2, line by line and is what every other renderer here is judged by. Slow:
about 50 M particle-sample evaluations a second, and two float64 numbers of memory a sample.

Integrals along rays, of kernels, which projections are, and of profiles of points, are taken by quadrature, with no closed form.
"""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.image import Image
from jaxsph.model.particles import kernels
from jaxsph.model.particles.columns import held_by
from jaxsph.model.particles.particles import Particles
from jaxsph.model.points import FALLOFF, Ball, Gaussian, Points, Profile, Shaped, Table
from jaxsph.model.projection import Projection
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.volume import Volume
from jaxsph.reference.where import asked_for, columns_of, inside as within, lines, ray_coordinates, to_view, to_world

Part = Callable[[int], tuple[np.ndarray, np.ndarray]]  # its optical thickness in a sample of every ray, and the same times colour
NODES, WEIGHTS = np.polynomial.legendre.leggauss(32)
BLOCK = 4096  # places at which a function is asked at once: one program, whatever the number of rays


def render(scene: Scene, camera: Camera, settings: Settings | None = None, *, cull: bool = True, every: int = 1) -> Image:
    """Render `scene` at full rate in float64.

    Args:
        scene, camera: as for `jaxsph.render`; their (possibly float32) numbers are taken as exact.
        settings: only `samples` is looked at.
        cull: evaluate a particle only in the box of samples around its support; `False` evaluates it everywhere.
        every: only every so many rows and columns of pixels, from number `every // 2` on: the image is
            `[every // 2 :: every, every // 2 :: every]` of the whole.

    Returns:
        Image of float64 NumPy arrays; `certified`, with `error_bound` 0, as it is the reference itself.

    References:
        Hochstetter, Orthmann & Kolb 2016, equations 1 (field), 2 (CSPH), 3 (compositing), 8 (sample depths).
        Kaehler, Abel & Hege 2007, equations 1 to 4 (parts that share samples).
    """
    started = time.perf_counter()
    settings = settings or Settings()
    camera = asked_for(scene, camera, every)
    numerators, denominator, evaluations, ends = _fields(scene, camera, settings.samples, cull, every)
    inside = denominator > 0
    # a mean is between the quantities that it is of, where rounding would put it beside a jump that is at one of them
    quantities = [
        np.where(inside, np.clip(numerator / np.where(inside, denominator, 1), *both), 0)
        for numerator, both in zip(numerators, ends, strict=True)
    ]
    u, v = _ray_coordinates(camera, every)
    square = 1 + u[None, :] ** 2 + v[:, None] ** 2
    lengths = np.sqrt(square) if camera.is_perspective else np.ones_like(square)  # path length a unit of depth
    edges = sample_borders(camera, settings.samples)
    shown = np.broadcast_to(True, inside.shape)
    if scene.particles_within is not None:
        places = _world(camera, settings.samples, every)
        inside &= within(scene.particles_within, places)
        shown = within(scene.within, places)
    parts = [] if scene.transfer is None else [_in_medium(quantities, inside, scene.transfer, edges, lengths)]
    for volume, look in scene.volumes:
        quantity, there = _in_volume(volume, camera, settings.samples, every)
        parts.append(_in_medium([quantity], there & shown, look, edges, lengths))
    parts += [_of_points(*thickness(points, camera, u, v, edges), shown) for points in scene.point_sets]
    color, transmittance, depth = _composite(parts, edges, lengths.shape, scene.mix)
    per_pixel: Any = evaluations.sum(-1).astype(np.float64)
    total, seconds = int(per_pixel.sum()), {"cast": time.perf_counter() - started}
    stats = {"evaluations": total, "evaluations_full": total, "cells": 0, "pairs": 0, "seconds": seconds}
    return Image(color, transmittance, depth, np.zeros_like(transmittance), per_pixel, True, 0, stats)


def sample_depths(camera: Camera, samples: int) -> np.ndarray:
    """View depths (samples,) of the fine samples, s(i + 1/2), float64, length units."""
    return _depth(camera, np.arange(samples) + 0.5, samples)


def sample_borders(camera: Camera, samples: int) -> np.ndarray:
    """View depths (samples + 1,) between which the fine samples stand, s(i), float64, length units."""
    return _depth(camera, np.arange(samples + 1), samples)


def field(
    scene: Scene, camera: Camera, samples: int, *, cull: bool = True, every: int = 1
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sums of the CSPH field at every sample, of all pixels or of `every` so many as in `render`.

    Returns:
        `sum q_j V_j W_j` (of two quantities, the first), `sum V_j W_j` (each up to one common factor) and the number of particles
        evaluated, all (height, width, samples).
    """
    (numerator, *_), denominator, evaluations, _ = _fields(scene, camera, samples, cull, every)
    return numerator, denominator, evaluations


def _fields(
    scene: Scene, camera: Camera, samples: int, cull: bool, every: int
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """The same of all quantities, and of each the least and the greatest that has any weight."""
    u, v = _ray_coordinates(camera, every)
    s = sample_depths(camera, samples)
    spread = s if camera.is_perspective else np.ones_like(s)
    kernel = kernels.by_name(scene.particle_set.kernel)
    position, _, support, volume, *quantities = columns_of(scene.particle_set)
    strength = volume / support**3
    strength = strength / max(strength.max(initial=0), np.finfo(float).tiny)
    shape = (len(v), len(u), samples)
    numerators, denominator, evaluations = [np.zeros(shape) for _ in quantities], np.zeros(shape), np.zeros(shape, np.int32)
    ends = [(np.full(shape, np.inf), np.full(shape, -np.inf)) for _ in quantities]
    for (x, y, z), h, m, *carried in zip(to_view(position, camera), support, strength, *quantities, strict=True):
        rows, columns, depths = _box(x, y, z, h, u, v, s, camera.is_perspective) if cull else (slice(None),) * 3
        dx = (spread[depths] * u[columns, None] - x) / h
        dy = (spread[depths] * v[rows, None] - y) / h
        dz = (s[depths] - z) / h
        weight = m * kernel.of_square(dx[None] ** 2 + dy[:, None] ** 2 + dz**2, np)
        for numerator, (least, greatest), q in zip(numerators, ends, carried, strict=True):
            numerator[rows, columns, depths] += q * weight
            for end, extreme in ((least, np.minimum), (greatest, np.maximum)):
                some = end[rows, columns, depths]
                extreme(some, q, out=some, where=weight > 0)
        denominator[rows, columns, depths] += weight
        evaluations[rows, columns, depths] += 1
    return numerators, denominator, evaluations, ends


def _ray_coordinates(camera: Camera, every: int) -> tuple[np.ndarray, np.ndarray]:
    u, v = ray_coordinates(camera, np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    return u[every // 2 :: every], v[every // 2 :: every]


def _depth(camera: Camera, u: np.ndarray, samples: int) -> np.ndarray:
    near, far = camera.near_and_far()
    if camera.is_perspective:
        return near * (far / near) ** (u / samples)
    return near + (far - near) * u / samples


def _box(
    x: float, y: float, z: float, h: float, u: np.ndarray, v: np.ndarray, s: np.ndarray, perspective: bool
) -> tuple[slice, slice, slice]:
    """Rows, columns and samples outside which the particle's weight is zero."""
    first, last = np.searchsorted(s, z - h, "left"), np.searchsorted(s, z + h, "right")
    if first >= last:
        return slice(0, 0), slice(0, 0), slice(0, 0)
    ends = s[[first, last - 1]] if perspective else np.ones(2)
    columns = slice(*np.searchsorted(u, [((x - h) / ends).min(), ((x + h) / ends).max()]) + [0, 1])
    rows = slice(*np.searchsorted(-v, [(-(y + h) / ends).min(), (-(y - h) / ends).max()]) + [0, 1])
    return rows, columns, slice(first, last)


def _world(camera: Camera, samples: int, every: int) -> np.ndarray:
    """World coordinates of all samples, (height, width, samples, 3)."""
    u, v = _ray_coordinates(camera, every)
    s = sample_depths(camera, samples)
    spread = s if camera.is_perspective else np.ones_like(s)
    return to_world(np.stack(np.broadcast_arrays(spread * u[None, :, None], spread * v[:, None, None], s), -1), camera)


def _in_volume(volume: Volume, camera: Camera, samples: int, every: int) -> tuple[np.ndarray, np.ndarray]:
    """The trilinear quantity at every sample, and whether it is inside the grid; (height, width, samples) each."""
    at = (_world(camera, samples, every) - volume.bounds()[0]) / np.asarray(volume.spacing, np.float64)
    values: Any = np.asarray(volume.values, np.float64)
    last = np.array(values.shape) - 1
    inside = ((at >= 0) & (at <= last)).all(-1)
    whole = np.clip(at.astype(int), 0, last - 1)
    part = np.clip(at - whole, 0, 1)
    quantity, least, greatest = np.zeros(inside.shape), np.full(inside.shape, np.inf), np.full(inside.shape, -np.inf)
    for corner in np.ndindex(2, 2, 2):
        share = np.where(corner, part, 1 - part).prod(-1)
        value = values[tuple(np.moveaxis(whole + corner, -1, 0))]
        quantity += share * value
        least, greatest = np.minimum(least, value), np.maximum(greatest, value)
    missing = np.isnan(quantity)
    return np.where(missing, 0, np.clip(quantity, least, greatest)), inside & ~missing


def _in_medium(
    quantities: list[np.ndarray], inside: np.ndarray, transfer: TransferFunction, edges: np.ndarray, lengths: np.ndarray
) -> Part:
    """Colour is looked up by the first quantity, extinction by the last."""
    of_extinction = transfer.values if transfer.extinction_values is None else transfer.extinction_values

    def sample(i: int) -> tuple[np.ndarray, np.ndarray]:
        color = interpolated(transfer.values, transfer.colors, quantities[0][..., i])
        extinction = interpolated(of_extinction, np.asarray(transfer.extinction)[:, None], quantities[-1][..., i])[..., 0]
        own = np.where(inside[..., i], extinction, 0) * (edges[i + 1] - edges[i]) * lengths
        return own, own[..., None] * color

    return sample


def _of_points(total: np.ndarray, colored: np.ndarray, shown: np.ndarray) -> Part:
    return lambda i: (np.where(shown[..., i], total[..., i], 0), np.where(shown[..., i, None], colored[..., i, :], 0))


def _composite(parts: list[Part], edges: np.ndarray, shape: tuple[int, ...], mix: str) -> tuple[Any, ...]:
    """Front to back, equation 3: colour, transmittance and the depth where transmittance falls to 1/2.

    Thicknesses of parts that share a sample add up. Their colours weigh by thickness (`mix` of "extinction"), or are added
    times the parts' own opacities ("opacity": Kaehler, Abel & Hege 2007, equation 1).
    """
    color, transmittance, depth = np.zeros((*shape, 3)), np.ones(shape), np.full(shape, np.inf)
    for i in range(len(edges) - 1):
        here = [part(i) for part in parts]
        total: Any = sum(own for own, _ in here)
        of_all = [(total, sum(colored for _, colored in here))] if mix == "extinction" else here
        for own, colored in of_all:
            shown = -np.expm1(-own) / np.where(own > 0, own, 1)  # opacity a unit of thickness
            color += (transmittance * shown)[..., None] * colored
        behind = transmittance * np.exp(-total)
        crossed = (transmittance > 0.5) & (behind <= 0.5)
        place = np.log(2 * transmittance, where=crossed, out=np.zeros_like(transmittance)) / np.where(crossed, total, 1)
        depth = np.where(crossed, edges[i] + place * (edges[i + 1] - edges[i]), depth)
        transmittance = behind
    return color, transmittance, depth


def interpolated(points: Any, given: Any, quantity: np.ndarray) -> np.ndarray:
    """A table (points, channels), piecewise linear between its control points; at a jump, the later of them."""
    values, table = np.asarray(points, np.float64), np.asarray(given, np.float64)
    right = np.clip(np.searchsorted(values, quantity, "right"), min(1, len(values) - 1), len(values) - 1)
    left = np.maximum(right - 1, 0)
    width = values[right] - values[left]
    jump = (quantity >= values[left]).astype(float)
    where = np.where(width > 0, np.clip((quantity - values[left]) / np.where(width > 0, width, 1), 0, 1), jump)[..., None]
    return np.asarray(table[left] * (1 - where) + table[right] * where)


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
    kinks_of_kernel = np.array([0.0, *reversed(kernel.ends)])
    across, down = np.meshgrid(u, v)
    starts, directions = lines(across, down, camera.is_perspective)
    slant = np.linalg.norm(directions, axis=-1)
    for i in np.flatnonzero(np.asarray(particles.valid)):
        support = float(np.asarray(particles.support)[i])
        foot = ((centers[i] - starts) * directions).sum(-1) / slant**2
        square = ((starts + foot[..., None] * directions - centers[i]) ** 2).sum(-1) / support**2
        met = np.nonzero(square < 1)
        start, end = ((depth - foot[met]) * slant[met] / support for depth in (near, far))
        integral = integral_across(kinks_of_kernel, square[met], lambda away, t: kernel.of_square(away + t * t, np), start, end)
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

    References:
        Kaehler, Abel & Hege 2007, section 3.2, for the spread "feet".
    """
    total, colored = np.zeros((len(v), len(u), len(edges) - 1)), np.zeros((len(v), len(u), len(edges) - 1, 3))
    across, down = np.meshgrid(u, v)
    starts, directions = lines(across, down, camera.is_perspective)
    middles = to_view(points.exact_position(), camera)
    points = jax.tree.map(np.asarray, points)
    for point in np.flatnonzero(points.valid):
        rows, columns, lengths = _lengths(points, point, camera, middles[point], starts, directions, edges)
        own = float(points.extinction[point]) * float(points.radius[point]) * lengths
        total[rows, columns] += own
        colored[rows, columns] += own[..., None] * np.asarray(points.color[point], np.float64)
    return total, colored


def _lengths(
    points: Points, point: Any, camera: Camera, middle: np.ndarray, starts: np.ndarray, directions: np.ndarray, edges: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns of the rays that pass a point, and integrals of its profile in their samples (rays, samples), in radii."""
    radius, axes, slant = float(points.radius[point]), camera.exact_axes(), np.linalg.norm(directions, axis=-1)
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
    at = foot_depth[:, None] if points.spread == "feet" and not is_splat else np.full((1, 1), middle[2])
    return rows, columns, ((edges[:-1] <= at) & (at < edges[1:])) * integral(-half, half)


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
