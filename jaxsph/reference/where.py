"""Where things are, in float64 NumPy: rays, views, clips at points and along rays, and periodic sets as explicit copies.

Flow: scene, camera -> [where] -> image, chords, columns, media.

Written apart from `model.camera`, `model.clips`, `model.clip_shapes` and `model.periodic`, which are judged by it: clips in world
space, periodic sets with all copies of all particles.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.clips.clips import Both, Clip, Outside
from jaxsph.model.clips.shapes import Box, Plane, Sphere
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene


def asked_for(scene: Scene, camera: Camera, every: int = 1) -> Camera:
    """The camera with near and far; `ValueError` for scenes that the reference does not know, and `every` of no pixels."""
    if every < 1:
        raise ValueError(f"`every` must be at least 1, got {every}; 1 takes all pixels")
    scene.check_without_surface("the reference")
    if scene.media:
        raise ValueError("`media` are unknown to the reference, which has particles, volumes and points; give `media=()`")
    return with_depths(camera, scene)


def ray_coordinates(camera: Camera, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lateral coordinates u and v of rays, by image-space coordinates: the middle of pixel c is at c + 1/2."""
    half = float(camera.half_height)
    return half * camera.width / camera.height * (2 * columns / camera.width - 1), half * (1 - 2 * rows / camera.height)


def lines(u: np.ndarray, v: np.ndarray, is_perspective: bool) -> tuple[Float[np.ndarray, "... 3"], Float[np.ndarray, "... 3"]]:
    """Of rays in view space: places at depth 0, and change of place a unit of depth."""
    aside = np.stack([u, v, np.zeros_like(u)], -1)
    ahead = np.broadcast_to(np.array([0.0, 0.0, 1.0]), aside.shape)
    return (np.zeros_like(aside), aside + ahead) if is_perspective else (aside, ahead)


def to_view(position: Float[np.ndarray, "... 3"], camera: Camera) -> Float[np.ndarray, "... 3"]:
    """World to view coordinates."""
    return (position - camera.exact_eye()) @ np.asarray(camera.axes, np.float64).T


def to_world(place: Float[np.ndarray, "... 3"], camera: Camera) -> Float[np.ndarray, "... 3"]:
    """World coordinates of view coordinates."""
    return place @ np.asarray(camera.axes, np.float64) + camera.exact_eye()


def inside(clip: Clip | None, place: Float[np.ndarray, "... 3"]) -> Bool[np.ndarray, "..."]:
    """Whether points in world space are in a clip; None is everywhere."""
    if clip is None:
        return np.ones(place.shape[:-1], bool)
    if isinstance(clip, Outside):
        return ~inside(clip.clip, place)
    if isinstance(clip, Both):
        return inside(clip.first, place) & inside(clip.second, place)
    if isinstance(clip, Plane):
        return (place - _exact(clip.point, clip.rest)) @ np.asarray(clip.normal, np.float64) >= 0
    if isinstance(clip, Sphere):
        return ((place - _exact(clip.center, clip.rest)) ** 2).sum(-1) <= float(clip.radius) ** 2
    if isinstance(clip, Box):
        lower, upper = clip.corners()
        return np.asarray(np.all((place >= lower) & (place <= upper), axis=-1))
    raise ValueError(f"`{type(clip).__name__}` is unknown to the reference, which has planes, boxes and spheres")


def crossings(
    clip: Clip, start: Float[np.ndarray, "rays 3"], direction: Float[np.ndarray, "rays 3"]
) -> Float[np.ndarray, "rays faces"]:
    """Depths at which rays through `start + depth * direction` may pass faces of a clip; NaN where they do not."""
    if isinstance(clip, Outside):
        return crossings(clip.clip, start, direction)
    if isinstance(clip, Both):
        return np.concatenate([crossings(part, start, direction) for part in (clip.first, clip.second)], 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        if isinstance(clip, Plane):
            normal = np.asarray(clip.normal, np.float64)
            depth = ((_exact(clip.point, clip.rest) - start) @ normal / (direction @ normal))[:, None]
        elif isinstance(clip, Sphere):
            away, length = start - _exact(clip.center, clip.rest), (direction**2).sum(1)
            foot = -(away * direction).sum(1) / length
            nearest = ((away + foot[:, None] * direction) ** 2).sum(1)
            half = np.sqrt((float(clip.radius) ** 2 - nearest) / length)
            depth = np.stack([foot - half, foot + half], 1)
        else:
            assert isinstance(clip, Box)
            depth = np.concatenate([(corner - start) / direction for corner in clip.corners()], 1)
    return np.where(np.isfinite(depth), depth, np.nan)


def columns_of(particles: Particles) -> tuple[np.ndarray, ...]:
    """`places_of`, and there supports, volumes and each quantity in float64."""
    position, entry = places_of(particles)
    others = particles.support, particles.volume, *particles.quantities
    return position, entry, *(np.asarray(column, np.float64)[entry] for column in others)


def places_of(particles: Particles) -> tuple[Float[np.ndarray, "places 3"], Int[np.ndarray, " places"]]:
    """Where particles are, and their entries; of a periodic set every copy that reaches into the box."""
    entry = np.flatnonzero(np.asarray(particles.valid))
    position, support = particles.exact_position()[entry], np.asarray(particles.support, np.float64)[entry]
    if particles.box is None or not len(entry):
        return position, entry
    lower, upper = particles.box.corners()
    period = upper - lower
    position = lower + (position - lower) % period
    most = np.ceil(support.max() / period).astype(int) + 1
    copies = [position + period * turns for turns in itertools.product(*(range(-k, k + 1) for k in most))]
    away = [np.linalg.norm(np.maximum(np.maximum(lower - copy, copy - upper), 0), axis=1) for copy in copies]
    reaching = [gap < support for gap in away]
    places = np.concatenate([copy[which] for copy, which in zip(copies, reaching, strict=True)])
    return places, np.concatenate([entry[which] for which in reaching])


def _exact(near: Any, rest: Any) -> np.ndarray:
    return np.asarray(np.asarray(near, np.float64) + np.asarray(rest, np.float64))
