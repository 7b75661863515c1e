r"""The light integral itself, along the ray of each pixel, in float64 NumPy: what every way of sampling it is judged by; and one
ray: what the quantity is along it, how light is lost, which particles it meets and what each takes.

Flow: scene, camera, pixels -> rays -> portions -> light of portions, halved until it is known -> [light_integral] -> image, Ray.

$I = \int T(l)\,c(l)\,\sigma(l)\,dl$ over the path length l, with $T(l) = \exp(-\int_0^l \sigma)$. Of what particles take of light
in all, each takes the share that it has of the field there, $V_j W_j / \sum V W$.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.reference.image import sample_borders, sample_depths, thickness
from jaxsph.reference.looks import INTEGRATION, NODES, PLACE, AtNodes, Light, light_of, where_thickness
from jaxsph.reference.media import Part, ParticlesPart, at_nodes, parts_of, roots_of
from jaxsph.reference.where import Portions, Rays, asked_for, blocks, inside, rays_of, to_world

BLOCK = 128  # rays that share arrays
ROUNDS = 180  # of splitting, a third of which are halvings: a wall of an optical thickness of 1e6 takes about 20
MOST_PORTIONS = 1 << 16  # of a ray; beyond, its error is told as it is
LEAST_TOLERANCE = 1e-12
ROUNDING = 64 * np.finfo(float).eps  # of a ray's sums
SHORTEST = 4 * np.finfo(float).eps  # of the depth
RAY_TOLERANCE = 1e-6  # of the light integral, where that is what a ray is known by
POINT = 1e-9  # of a sample, the half of a portion about its middle by which a medium is asked for that place alone
MIDDLE = NODES // 2
WEIGHTS = INTEGRATION[-1][:, None]  # of the nodes of a portion


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
    spread "chords"; "feet" and "centres" lay it elsewhere, as ways of rendering it.

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


class Ray(NamedTuple):
    """What is along a ray, front to back.

    Attributes:
        depth: of the places that are looked at, ascending, length units; where portions meet, twice.
        quantities: of particles, else of the first volume, one or two; NaN where there is none.
        extinction: of all that is there, a unit length.
        transmittance: of all from near up to there; of samples, with what each of them stands for.
        particles: entries of the particles whose supports the ray passes through where they are shown, ascending.
        added: what each of these adds to alpha.
    """

    depth: Float[np.ndarray, " places"]
    quantities: tuple[Float[np.ndarray, " places"], ...]
    extinction: Float[np.ndarray, " places"]
    transmittance: Float[np.ndarray, " places"]
    particles: Int[np.ndarray, " particles"] = np.zeros(0, int)
    added: Float[np.ndarray, " particles"] = np.zeros(0)


def along(scene: Scene, camera: Camera, row: int, column: int, samples: int | None = None) -> Ray:
    """What the ray of a pixel meets, between near and far.

    Args:
        scene, camera: as for `jaxsph.reference.render`.
        row, column: of the pixel.
        samples: so many, as `jaxsph.reference.render` has them; None takes nodes of portions that are as short as
            `jaxsph.reference.integral` needs them for the light integral.

    Raises:
        ValueError: a scene of nothing, of a surface, or of media unknown here.
    """
    camera = asked_for(scene, camera)
    rays, parts = rays_of(camera, np.array([row]), np.array([column])), parts_of(scene, camera)
    roots = roots_of(parts, rays, empty=True)
    ray, portions, amounts = _integrated(rays, parts, roots) if samples is None else _sampled(scene, camera, rays, parts, samples)
    first = parts[0]
    if not isinstance(first, ParticlesPart):
        return ray
    entry = first.entry[first.chords.sphere]
    added = np.bincount(entry, first.shared(amounts, portions), scene.particle_set.capacity)
    first.take(roots)
    found = np.unique(entry[first.over(np.flatnonzero(first.shown))[1]])
    return ray._replace(particles=found, added=added[found])


def _integrated(rays: Rays, parts: list[Part], roots: Portions) -> tuple[Ray, Portions, np.ndarray]:
    """By quadrature; with the portions, and what the first part takes at nodes: of a portion's loss what is integrated there."""
    portions, *_ = refined(rays, parts, roots, RAY_TOLERANCE)
    seen, quantities, own = _looked(parts, portions)
    middle, half = portions.middles()
    thickness = light_of(seen, half * rays.slant).thickness.T
    behind = np.cumsum(thickness[-1])
    front = behind - thickness[-1]
    left = np.exp(-(front + thickness))
    each = WEIGHTS * left
    total = (each * seen.extinction).sum(0)
    taken = np.divide(np.exp(-front) - np.exp(-behind), total, out=np.zeros_like(total), where=total > 0)
    depth = middle + PLACE[:, None] * half
    depth[0], depth[-1] = portions.start, portions.end  # such that depths ascend
    at, *values, extinction, transmittance = (value.T.ravel() for value in (depth, *quantities, seen.extinction, left))
    transmittance = np.minimum.accumulate(transmittance)  # where rounding has it rise
    return Ray(at, tuple(values), extinction, transmittance), portions, each * taken * own


def _sampled(scene: Scene, camera: Camera, rays: Rays, parts: list[Part], samples: int) -> tuple[Ray, Portions, np.ndarray]:
    """The same by samples, each of which stands for what lies around it; points as they lie there."""
    depth, borders = sample_depths(camera, samples), sample_borders(camera, samples)
    path = np.diff(borders) * rays.slant
    portions = Portions(np.zeros(samples, int), depth - POINT * path, depth + POINT * path, np.arange(samples))
    parts = parts[: len(scene.looks)]
    for part in parts:
        part.take(portions)
    seen, quantities, first = _looked(parts, portions)
    extinction = seen.extinction[MIDDLE]
    visible = inside(scene.within, to_world(rays.start + depth[:, None] * rays.direction, camera))
    for points in scene.point_sets:
        total = thickness(points, camera, rays.u, rays.v, borders)[0][0, 0]
        extinction = extinction + np.where(visible, total / path, 0)
    left = np.cumprod(np.exp(-extinction * path))
    lost = np.append(1, left[:-1]) - left
    own = np.divide(lost, extinction, out=np.zeros(samples), where=extinction > 0)
    amounts = np.zeros((NODES, samples))
    amounts[MIDDLE] = own * first[MIDDLE]
    return Ray(depth, tuple(quantity[MIDDLE] for quantity in quantities), extinction, left), portions, amounts


def _looked(parts: list[Part], portions: Portions) -> tuple[AtNodes, np.ndarray, np.ndarray]:
    """What parts have at nodes of portions; and quantities and extinction of the first that has a transfer function."""
    seen = at_nodes(parts, portions)
    quantities, extinction = np.full((1, *seen.extinction.shape), np.nan), np.zeros_like(seen.extinction)
    for which, given, own, _ in seen.looked[:1]:
        quantities = np.full((len(given), *extinction.shape), np.nan)
        quantities[:, :, which], extinction[:, which] = given, own
    return seen, quantities, extinction


def met(scene: Scene, camera: Camera, rows: np.ndarray, columns: np.ndarray, part: int) -> tuple[np.ndarray, ...]:
    """What rays of pixels meet of one of the parts with a transfer function, at nodes of portions that are not split any further.

    Returns:
        Quantities, path lengths that they stand for, and what is absorbed and emitted there of the light that reaches the eye.
    """
    rays, parts = rays_of(asked_for(scene, camera), rows, columns), parts_of(scene, camera)
    found = [_met(rays.some(some), parts, part) for some in blocks(rays, BLOCK)]
    return tuple(np.concatenate(column) for column in zip(*found, strict=True))


def _met(rays: Rays, parts: list[Part], part: int) -> tuple[np.ndarray, ...]:
    """Quantities of a part at nodes of portions of some rays; path length of each, and what is absorbed and emitted there."""
    portions = roots_of(parts, rays)
    seen = at_nodes(parts, portions)
    half_path = (portions.end - portions.start) / 2 * rays.slant[portions.ray]
    light = light_of(seen, half_path)
    front = np.exp(-_thickness_before(portions, light))
    which, quantities, extinction, emission = seen.looked[part]
    path = (WEIGHTS * half_path)[:, which]
    left = path * (front[:, None] * np.exp(-light.thickness)).T[:, which]
    return quantities[0].ravel(), path.ravel(), (left * extinction).ravel(), (left * emission).reshape(3, -1).T
