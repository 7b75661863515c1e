r"""The light integral itself, along the ray of each pixel, in float64 NumPy: what every way of sampling it is judged by.

Flow: scene, camera, pixels -> rays -> portions -> light of portions, halved until it is known -> [light_integral] -> image.

$I = \int T(l)\,c(l)\,\sigma(l)\,dl$ over the path length l, with $T(l) = \exp(-\int_0^l \sigma)$.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.reference.looks import Light, light_of, where_thickness
from jaxsph.reference.media import Part, at_nodes, parts_of, roots_of
from jaxsph.reference.where import Portions, Rays, asked_for, blocks, rays_of

BLOCK = 128  # rays that share arrays
ROUNDS = 180  # of splitting, a third of which are halvings: a wall of an optical thickness of 1e6 takes about 20
MOST_PORTIONS = 1 << 16  # of a ray; beyond, its error is told as it is
LEAST_TOLERANCE = 1e-12
ROUNDING = 64 * np.finfo(float).eps  # of a ray's sums
SHORTEST = 4 * np.finfo(float).eps  # of the depth


def integral(
    scene: Scene,
    camera: Camera,
    *,
    pixels: tuple[Any, Any] | None = None,
    every: int = 1,
    tolerance: float = 1e-7,
    progress: Callable[[int, int], None] | None = None,
) -> Image:
    r"""The light integral along rays between `camera.near` and `camera.far`, by quadrature of a known error.

    Extinctions of all parts add up, and so do their emissions, colour times extinction. (With `mix="opacity"` samples show the
    sum of colours times opacities; in the limit of short intervals opacities are thicknesses: it has the same integral.)
    Particles: $Q = \sum q V W / \sum V W$ wherever a support is, nothing elsewhere. Points are taken by their true density,
    spread "chords"; "centres" lays it elsewhere, as a way of rendering it.

    Rays are cut where supports, cells of volumes and points begin and end, into portions; of supports that many others overlap
    only some ends are cut at from the start. On a portion extinction and emission are taken as polynomials of degree 8 through
    Chebyshev nodes, thickness as the integral of the one, light as that of the other times transmittance. Portions whose light or
    transmittance differs from what every second node says are split: where a quantity crosses a control value of a transfer
    function, at the end of a support, or halved.

    Args:
        scene: particles, volumes and points; their (possibly float32) numbers are taken as exact, as is the camera.
        camera: where from, and how large the image is.
        pixels: rows and columns of some pixels, integers of one shape, which the image's fields then have.
        every: where `pixels` is None, only every so many rows and columns, as in `jaxsph.reference.render`.
        tolerance: of a ray's colours and transmittance, an estimated error that is worked down to; at least 1e-12.
        progress: called as `progress(done, total)` in rays.

    Returns:
        Image of float64 NumPy arrays. `error_bound` is the own error: four times the sum over portions of what all nodes and
        every second node differ by, and of what kinks and jumps of transfer functions can hide between nodes, times the
        transmittance in front. It is an estimate, and a cautious one, as the polynomials of all nodes are what is shown: on
        random scenes one ray in thousands errs by more. Above `tolerance` where no portion could be split any more. Not
        `certified`. `stats` counts `rays`, `chords`, `portions` and `evaluations`.

    Raises:
        ValueError: pixels out of the image, a tolerance below 1e-12, a scene of nothing, or of media unknown here.

    References:
        Hochstetter, Orthmann & Kolb 2016, equations 1 and 2 (field). Kaehler, Abel & Hege 2007, equations 1 to 4 (parts).
    """
    started = time.perf_counter()
    if not tolerance >= LEAST_TOLERANCE:
        raise ValueError(f"`tolerance` must be at least {LEAST_TOLERANCE:g}, got {tolerance!r}; float64 sums hold no more digits")
    camera = asked_for(scene, camera, every)
    rows, columns = _pixels(camera, pixels, every)
    rays, parts = rays_of(camera, rows.ravel(), columns.ravel()), parts_of(scene, camera)
    found, counts = _all(rays, parts, tolerance, progress)
    color: Any = found[:, :3].reshape(*rows.shape, 3)
    transmittance, depth, error, evaluations = found[:, 3:].T.reshape(4, *rows.shape)
    total, seconds = int(found[:, 6].sum()), {"cast": time.perf_counter() - started}
    stats = {"evaluations": total, "evaluations_full": total, "cells": 0, "pairs": 0, "seconds": seconds}
    stats |= {"rays": len(found), "chords": int(counts[0]), "portions": int(counts[1])}
    return Image(color, transmittance, depth, error, evaluations, False, 0, stats)


def _all(rays: Rays, parts: list[Part], tolerance: float, progress: Callable[..., None] | None) -> tuple[np.ndarray, np.ndarray]:
    """Colour, transmittance, depth, error and evaluations of rays (rays, 7), and how many chords and portions they have."""
    found, counts, done = np.empty((len(rays.u), 7)), np.zeros(2, int), 0
    for which in blocks(rays, BLOCK):
        some = rays.some(which)
        portions, light, evaluations = refined(some, parts, roots_of(parts, some), tolerance)
        found[which] = np.concatenate([_composite(some, portions, light), evaluations[:, None]], 1)
        counts += sum(len(part.chords.ray) for part in parts), len(portions.ray)
        done += len(which)
        if progress is not None:
            progress(done, len(rays.u))
    return found, counts


def _pixels(camera: Camera, pixels: tuple[Any, Any] | None, every: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns that are asked for."""
    if pixels is None:
        rows, columns = np.indices((camera.height, camera.width))[:, every // 2 :: every, every // 2 :: every]
        return rows, columns
    if every != 1:
        raise ValueError(f"`every` = {every} goes with the whole image; give `pixels` or `every`")
    if len(pixels) != 2:
        raise ValueError(f"`pixels` must be a pair, rows and columns, got {len(pixels)} arrays; as `numpy.nonzero` gives them")
    rows, columns = (np.asarray(part) for part in pixels)
    if rows.shape != columns.shape:
        raise ValueError(f"`pixels` must be rows and columns of one shape, got {rows.shape} and {columns.shape}")
    for name, given, size in (("rows", rows, camera.height), ("columns", columns, camera.width)):
        if given.size and given.dtype.kind not in "iu":
            raise ValueError(f"`pixels` must be integers, but {name} are {given.dtype}; pixel 0 has its ray at 1/2")
        if given.size and not (given.min() >= 0 and given.max() < size):
            raise ValueError(f"`pixels` must have {name} from 0 to {size - 1}, got {given.min()} .. {given.max()}")
    return rows.astype(int), columns.astype(int)


def refined(rays: Rays, parts: list[Part], portions: Portions, tolerance: float) -> tuple[Portions, Light, np.ndarray]:
    """Split portions until the error of every ray is within tolerance, or no portion can be split."""
    count = len(rays.u)
    evaluations = np.zeros(count)

    def look(some: Portions) -> Light:
        seen = at_nodes(parts, some)
        evaluations[:] += np.bincount(some.ray, seen.evaluations, count)
        return light_of(seen, (some.end - some.start) / 2 * rays.slant[some.ray])

    light = look(portions)
    for turn in range(ROUNDS):
        error = light.error * np.exp(-_thickness_before(portions, light))
        number = np.bincount(portions.ray, minlength=count)
        wanting = (np.bincount(portions.ray, error, count) > tolerance) & (number < MOST_PORTIONS)
        long = portions.end - portions.start > SHORTEST * np.abs(portions.end)
        split = wanting[portions.ray] & long & (error > tolerance / (4 * np.maximum(number[portions.ray], 1)))
        if not split.any():
            break
        where = _split(portions.some(split), light.crossing[split], parts, turn)
        times = 1 + split
        first = (np.cumsum(times) - times)[split]
        portions = Portions(*(np.repeat(column, times) for column in portions))
        portions.end[first], portions.start[first + 1] = where, where
        new = np.stack([first, first + 1], 1).ravel()
        light = Light(*(np.repeat(column, times, axis=0) for column in light))
        for column, fresh in zip(light, look(portions.some(new)), strict=True):
            column[new] = fresh
    return portions, light, evaluations


def _split(portions: Portions, crossing: np.ndarray, parts: list[Part], turn: int) -> np.ndarray:
    """Depths to split at: by turns crossings of control values, borders of supports, and always the middle."""
    border = np.full(len(crossing), np.nan)
    for part in parts:
        border = np.where(np.isnan(border), part.border_by(portions), border)
    where = (portions.start + portions.end) / 2
    for place in ((border, crossing), (crossing, border), ())[turn % 3]:
        where = np.where((place > portions.start) & (place < portions.end), place, where)
    return where


def _thickness_before(portions: Portions, light: Light) -> np.ndarray:
    """Optical thickness of all of a ray in front of each of its portions; ray by ray, as digits are lost behind walls."""
    first = np.searchsorted(portions.ray, portions.ray)
    place = np.arange(len(portions.ray)) - first
    table = np.zeros((portions.ray.max(initial=-1) + 1, place.max(initial=-1) + 2))
    table[portions.ray, place + 1] = light.thickness[:, -1]
    return np.cumsum(table, 1)[portions.ray, place]


def _composite(rays: Rays, portions: Portions, light: Light) -> np.ndarray:
    """Front to back: colour, transmittance, depth of half transmittance and error, (rays, 6)."""
    count, before = len(rays.u), _thickness_before(portions, light)
    front, own = np.exp(-before), light.thickness[:, -1]
    color = [np.bincount(portions.ray, front * channel, count) for channel in light.color.T]
    depth, half = np.full(count, np.inf), np.log(2)
    crossed = np.flatnonzero((before < half) & (before + own >= half))
    there = portions.some(crossed)
    share = where_thickness(light.thickness[crossed], half - before[crossed])
    depth[there.ray] = there.start + share * (there.end - there.start)
    transmittance = np.exp(-np.bincount(portions.ray, own, count))
    error = np.bincount(portions.ray, front * light.error, count)
    return np.stack([*color, transmittance, depth, np.where(error > 0, error + ROUNDING, 0)], 1)
