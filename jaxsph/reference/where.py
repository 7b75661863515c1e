"""Where things are, in float64 NumPy: rays, views, clips at points and along rays, periodic sets as explicit copies; entries of
rays into and exits from spheres, and the portions that rays are cut into, inside of which nothing begins or ends.

Flow: scene, camera, pixels -> [where] -> rays, chords, portions -> image, columns, media.

Written apart from `model.camera`, `model.clips` and `model.periodic`, which are judged by it: nothing else uses it, clips are in
world space, and periodic sets have all copies of all particles.
"""

from __future__ import annotations

import functools
import itertools
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.framing import with_depths
from jaxsph.model.clips import Both, Box, Clip, Outside, Plane, Sphere
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
    side = 2 * float(camera.half_height) / camera.height
    return (columns - camera.width / 2) * side, (camera.height / 2 - rows) * side


def lines(u: np.ndarray, v: np.ndarray, is_perspective: bool) -> tuple[Float[np.ndarray, "... 3"], Float[np.ndarray, "... 3"]]:
    """Of rays in view space: places at depth 0, and change of place a unit of depth."""
    aside = np.stack([u, v, np.zeros_like(u)], -1)
    ahead = np.broadcast_to(np.array([0.0, 0.0, 1.0]), aside.shape)
    return (np.zeros_like(aside), aside + ahead) if is_perspective else (aside, ahead)


def to_view(position: Float[np.ndarray, "... 3"], camera: Camera) -> Float[np.ndarray, "... 3"]:
    """World to view coordinates."""
    offset = position - camera.exact_eye()
    return np.stack([(offset * axis).sum(-1) for axis in camera.exact_axes()], -1)


def to_world(place: Float[np.ndarray, "... 3"], camera: Camera) -> Float[np.ndarray, "... 3"]:
    """World coordinates of view coordinates."""
    return camera.exact_eye() + sum(place[..., k, None] * axis for k, axis in enumerate(camera.exact_axes()))


def inside(clip: Clip | None, place: Float[np.ndarray, "... 3"]) -> Bool[np.ndarray, "..."]:
    """Whether points in world space are in a clip; None is everywhere."""
    if clip is None:
        return np.ones(place.shape[:-1], bool)
    if isinstance(clip, Outside):
        return ~inside(clip.clip, place)
    if isinstance(clip, Both):
        return inside(clip.first, place) & inside(clip.second, place)
    if isinstance(clip, Plane):
        return ((place - _exact(clip.point, clip.rest)) * np.asarray(clip.normal, np.float64)).sum(-1) >= 0
    if isinstance(clip, Sphere):
        return np.linalg.norm(place - _exact(clip.center, clip.rest), axis=-1) <= float(clip.radius)
    if isinstance(clip, Box):
        return np.asarray(np.all(np.clip(place, *clip.corners()) == place, axis=-1))
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


MOST_CANDIDATES = 1 << 20  # pairs of a ray and a sphere that are looked at at once
LONGEST = 0.25  # of a support: see `borders`
FEW = 4  # chords, see `borders`


class Rays(NamedTuple):
    """Rays in view space: at depth s the place is `start + s * direction`.

    Attributes:
        u, v: their lateral coordinates, as `model.camera` has them.
        start: places at depth 0.
        direction: change of place a unit of depth.
        slant: path length a unit of depth.
        near, far: depths between which light is looked at.
    """

    u: Float[np.ndarray, " rays"]
    v: Float[np.ndarray, " rays"]
    start: Float[np.ndarray, "rays 3"]
    direction: Float[np.ndarray, "rays 3"]
    slant: Float[np.ndarray, " rays"]
    near: float
    far: float

    def some(self, which: Int[np.ndarray, " some"]) -> Rays:
        """Those of the given numbers."""
        u, v, slant = self.u[which], self.v[which], self.slant[which]
        return Rays(u, v, self.start[which], self.direction[which], slant, self.near, self.far)


def rays_of(camera: Camera, rows: Int[np.ndarray, " rays"], columns: Int[np.ndarray, " rays"]) -> Rays:
    """The rays through the middles of pixels."""
    u, v = ray_coordinates(camera, columns + 0.5, rows + 0.5)
    slant = np.sqrt(1 + u**2 + v**2) if camera.is_perspective else np.ones_like(u)
    return Rays(u, v, *lines(u, v, camera.is_perspective), slant, *camera.near_and_far())


def blocks(rays: Rays, size: int) -> list[Int[np.ndarray, " some"]]:
    """Numbers of rays, about `size` at a time, that are side by side: few spheres are met by some of a block."""
    count = len(rays.u)
    strips = max(round(np.sqrt(count / size)), 1)
    strip = np.empty(count, int)
    strip[np.argsort(rays.v, kind="stable")] = np.arange(count) * strips // max(count, 1)
    order = np.lexsort((rays.u, strip))
    return [order[first : first + size] for first in range(0, count, size)]


class Chords(NamedTuple):
    """What rays have inside spheres, entry < exit.

    Attributes:
        ray, sphere: numbers of them.
        entry, exit: depths.
    """

    ray: Int[np.ndarray, " chords"]
    sphere: Int[np.ndarray, " chords"]
    entry: Float[np.ndarray, " chords"]
    exit: Float[np.ndarray, " chords"]


NO_CHORDS = Chords(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0))


Shadows = list[tuple[np.ndarray, np.ndarray]]  # of spheres: least and greatest u, and v, of rays that may meet them


def shadows_of(center: Float[np.ndarray, "spheres 3"], radius: Float[np.ndarray, " spheres"], is_perspective: bool) -> Shadows:
    """By tangents, where the eye is not beside a sphere."""
    if not is_perspective:
        return [(x - radius, x + radius) for x in center.T[:2]]
    z = center[:, 2]
    ahead = z > radius * (1 + 1e-6)
    margin = np.where(ahead, z**2 - radius**2, 1)
    roots = [(x, radius * np.sqrt(np.where(ahead, x**2 + margin, 0))) for x in center.T[:2]]
    return [tuple(np.where(ahead, (x * z + k * root) / margin, k * np.inf) for k in (-1, 1)) for x, root in roots]  # type: ignore[misc]


def chords_of(
    center: Float[np.ndarray, "spheres 3"], radius: Float[np.ndarray, " spheres"], shadows: Shadows, rays: Rays
) -> Chords:
    """All chords that rays have inside spheres in view space, between near and far; cut off there they are not."""
    (left, right), (low, high) = shadows
    seen = (left <= rays.u.max()) & (right >= rays.u.min()) & (low <= rays.v.max()) & (high >= rays.v.min())
    seen &= (center[:, 2] + radius > rays.near) & (center[:, 2] - radius < rays.far)
    candidates, order = np.flatnonzero(seen), np.argsort(rays.u)
    first, last = np.searchsorted(rays.u[order], left[candidates]), np.searchsorted(rays.u[order], right[candidates], "right")
    found = [NO_CHORDS]
    for some in batches(last - first, MOST_CANDIDATES):
        which, place = ranges(first[some], last[some] - first[some])
        ray, sphere = order[place], candidates[some][which]
        inside = (low[sphere] <= rays.v[ray]) & (rays.v[ray] <= high[sphere])
        ray, sphere = ray[inside], sphere[inside]
        slant, middle, start, direction = rays.slant[ray], center[sphere], rays.start[ray], rays.direction[ray]
        foot = ((middle - start) * direction).sum(-1) / slant**2
        apart = functools.reduce(np.add, ((start + foot[:, None] * direction - middle) ** 2).T)
        half = np.sqrt(np.maximum(radius[sphere] ** 2 - apart, 0)) / slant
        entry, exit = foot - half, foot + half
        met = (entry < exit) & (exit > rays.near) & (entry < rays.far)
        found.append(Chords(ray[met], sphere[met], entry[met], exit[met]))
    return Chords(*(np.concatenate(columns) for columns in zip(*found, strict=True)))


def ranges(first: Int[np.ndarray, " n"], count: Int[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """All of `first[i] .. first[i] + count[i] - 1` in a row, behind the i that each is of."""
    which = np.repeat(np.arange(len(first)), count)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(count) - count - first, count)


def batches(count: Int[np.ndarray, " n"], most: int) -> list[Int[np.ndarray, " some"]]:
    """Numbers of things, as many at a time as have about `most` of what is counted together."""
    ends = np.cumsum(count)
    some = np.split(np.arange(len(ends)), np.searchsorted(ends, np.arange(most, ends[-1] if len(ends) else 0, most)))
    return [part for part in some if len(part)]


class Portions(NamedTuple):
    """Parts of rays, in order of rays and, within a ray, of depth.

    Attributes:
        ray: number of its ray.
        start, end: depths.
        root: number of the portion of the first cut that it is a part of: what parts of a scene have there is told of those.
    """

    ray: Int[np.ndarray, " portions"]
    start: Float[np.ndarray, " portions"]
    end: Float[np.ndarray, " portions"]
    root: Int[np.ndarray, " portions"]

    def middles(self) -> tuple[Float[np.ndarray, " portions"], Float[np.ndarray, " portions"]]:
        """Depths of their middles, and half of their lengths."""
        return (self.start + self.end) / 2, (self.end - self.start) / 2

    def some(self, which: np.ndarray) -> Portions:
        """Those of the given numbers, or a mask."""
        return Portions(*(column[which] for column in self))


Cuts = tuple[np.ndarray, np.ndarray]  # numbers of rays, and depths on them


def borders(chords: Chords, radius: Float[np.ndarray, " chords"]) -> Cuts:
    """Entries and exits that rays are cut at from the start.

    All where less than `FEW` chords are on one side: there the medium begins or ends, or a mean of few may change quickly. At the
    others only a higher derivative jumps, and rays are cut where the error demands it. Of these the first in each of the bins
    that are `LONGEST` of a support long (of the power of two below it): so no longer chord is overlooked between nodes.
    """
    ray, depth = np.tile(chords.ray, 2), np.concatenate([chords.entry, chords.exit])
    step = np.repeat([1, -1], len(chords.ray))
    order = np.lexsort((-step, depth, ray))
    ray, depth, step = ray[order], depth[order], step[order]
    covering = np.cumsum(step)
    octave = np.frexp(np.tile(radius, 2)[order])[1]
    place = np.floor(depth / np.ldexp(LONGEST, octave - 1))
    first = np.zeros(len(ray), bool)
    within = np.lexsort((depth, octave, ray))
    keys = ray[within], octave[within], place[within]
    first[within[1:]] = np.logical_or.reduce([key[1:] != key[:-1] for key in keys])
    first[within[:1]] = True
    kept = first | (np.minimum(covering, covering - step) < FEW)
    return ray[kept], depth[kept]


def cut(rays: Rays, cuts: list[Cuts]) -> Portions:
    """What lies between neighbouring cuts of a ray, between near and far."""
    count = len(rays.u)
    ends = np.repeat([rays.near, rays.far], count)
    ray = np.concatenate([np.tile(np.arange(count), 2), *(ray for ray, _ in cuts)])
    depth = np.clip(np.concatenate([ends, *(depth for _, depth in cuts)]), rays.near, rays.far)
    order = np.lexsort((depth, ray))
    ray, depth = ray[order], depth[order]
    held = (ray[1:] == ray[:-1]) & (depth[1:] > depth[:-1])
    start, end = depth[:-1][held], depth[1:][held]
    return Portions(ray[:-1][held], start, end, np.arange(len(start)))
