"""The oracle: the same image in float64 NumPy, particle by particle and sample by sample, with no grid and no cleverness.

Flow: scene, camera -> [image] -> Image.

It follows Hochstetter et al. 2016, sections 2.1 and 2.2, line by line and is what every other renderer here is judged by. Slow:
about 50 M particle-sample evaluations a second, and two float64 numbers of memory a sample.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.particles import kernels
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.volume import Volume
from jaxsph.reference.columns import thickness
from jaxsph.reference.where import asked_for, columns_of, ray_coordinates, to_view, to_world
from jaxsph.reference.where import inside as within

Part = Callable[[int], tuple[np.ndarray, np.ndarray]]  # its optical thickness in a sample of every ray, and the same times colour


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
    numerators, denominator, evaluations = _fields(scene, camera, settings.samples, cull, every)
    inside = denominator > 0
    quantities = [np.where(inside, numerator / np.where(inside, denominator, 1), 0) for numerator in numerators]
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
    (numerator, *_), denominator, evaluations = _fields(scene, camera, samples, cull, every)
    return numerator, denominator, evaluations


def _fields(
    scene: Scene, camera: Camera, samples: int, cull: bool, every: int
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray]:
    """The same of all quantities."""
    u, v = _ray_coordinates(camera, every)
    s = sample_depths(camera, samples)
    spread = s if camera.is_perspective else np.ones_like(s)
    kernel = kernels.by_name(scene.particle_set.kernel)
    position, _, support, volume, *quantities = columns_of(scene.particle_set)
    strength = volume / support**3
    strength = strength / max(strength.max(initial=0), np.finfo(float).tiny)
    shape = (len(v), len(u), samples)
    numerators, denominator, evaluations = [np.zeros(shape) for _ in quantities], np.zeros(shape), np.zeros(shape, np.int32)
    for (x, y, z), h, m, *carried in zip(to_view(position, camera), support, strength, *quantities, strict=True):
        rows, columns, depths = _box(x, y, z, h, u, v, s, camera.is_perspective) if cull else (slice(None),) * 3
        dx = (spread[depths] * u[columns, None] - x) / h
        dy = (spread[depths] * v[rows, None] - y) / h
        dz = (s[depths] - z) / h
        weight = m * kernel.of_square(dx[None] ** 2 + dy[:, None] ** 2 + dz**2, np)
        for numerator, q in zip(numerators, carried, strict=True):
            numerator[rows, columns, depths] += q * weight
        denominator[rows, columns, depths] += weight
        evaluations[rows, columns, depths] += 1
    return numerators, denominator, evaluations


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
    quantity = np.zeros(inside.shape)
    for corner in np.ndindex(2, 2, 2):
        share = np.where(corner, part, 1 - part).prod(-1)
        quantity += share * values[tuple(np.moveaxis(whole + corner, -1, 0))]
    return quantity, inside


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
