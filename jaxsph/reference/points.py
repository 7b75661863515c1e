"""Points in the oracle: how much of each lies in each sample of each ray, by quadrature of what a profile is.

Flow: Points, rays, borders of samples -> [points] -> image.
"""

from __future__ import annotations

import jax
import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.points import Points
from jaxsph.model.profiles import FALLOFF, Ball, Gaussian, Profile, Shaped, Table
from jaxsph.reference.where import integral_across, lines

BLOCK = 4096  # places at which a function is asked at once: one program, whatever the number of rays


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
        Kaehler, Abel & Hege 2007, section 3.2, for the spreads "feet" and "centres".
    """
    total, colored = np.zeros((len(v), len(u), len(edges) - 1)), np.zeros((len(v), len(u), len(edges) - 1, 3))
    across, down = np.meshgrid(u, v)
    starts, directions = lines(across, down, camera.is_perspective)
    axes, center = np.asarray(camera.axes, np.float64), points.exact_position() - camera.exact_eye()
    points = jax.tree.map(np.asarray, points)
    for point in np.flatnonzero(np.asarray(points.valid)):
        radius, middle = float(points.radius[point]), axes @ center[point]
        slant = np.linalg.norm(directions, axis=-1)
        foot_depth = ((middle - starts) * directions).sum(-1) / slant**2
        foot = starts + foot_depth[..., None] * directions - middle
        rows, columns = np.nonzero((foot**2).sum(-1) < radius**2)
        foot, slant, foot_depth = foot[rows, columns] / radius, slant[rows, columns], foot_depth[rows, columns]
        attributes = {name: np.asarray(values[point], np.float64) for name, values in points.attributes.items()}
        half = np.sqrt(np.maximum(1 - (foot**2).sum(-1), 0))[:, None]  # of the length inside
        seen = points.profile, attributes, foot @ axes, directions[rows, columns] / slant[:, None] @ axes
        place = (edges - foot_depth[:, None]) * slant[:, None] / radius  # of borders along rays, from the foot on
        away = np.linalg.norm(middle) if camera.is_perspective else middle[2]
        is_splat = points.splats_beyond is not None and away > float(points.splats_beyond)
        if points.spread == "chords" and not is_splat:
            ends = np.clip(place, -half, half)
            lengths = _integral(*seen, ends[:, :-1], ends[:, 1:])
        else:
            at = foot_depth if points.spread == "feet" and not is_splat else np.full(len(rows), middle[2])
            held = (edges[:-1] <= at[:, None]) & (at[:, None] < edges[1:])
            lengths = held * _integral(*seen, -half, half)
        own = float(points.extinction[point]) * radius * lengths
        total[rows, columns] += own
        colored[rows, columns] += own[..., None] * np.asarray(points.color[point], np.float64)
    return total, colored


def _integral(
    profile: Profile,
    attributes: dict[str, np.ndarray],
    foot: np.ndarray,
    direction: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
) -> np.ndarray:
    """Of the profile along rays from `start` to `end`, (rays, samples), in radii; split where a profile may have a kink.

    Rays have their `foot`, (rays, 3), from the centre to the place that is nearest to it, and a `direction` of length 1, on world
    axes.
    """

    def value(t: np.ndarray) -> np.ndarray:
        return at_offset(profile, foot[:, None] + t[..., None] * direction[:, None], attributes)

    return integral_across(kinks(profile), (foot**2).sum(-1)[:, None], start, end, value)


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
    raise ValueError(f"`profile` {type(profile).__name__} is unknown to the reference, which has those of `model.profiles`")
