"""Where rays pass spheres, in float64: rays of chosen pixels, and their entries into and exits from supports.

Flow: camera, pixels -> rays; rays, spheres -> [chords] -> portions, media.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsph.model.camera.camera import Camera
from jaxsph.reference.where import lines, ray_coordinates

MOST_CANDIDATES = 1 << 20  # pairs of a ray and a sphere that are looked at at once


class Rays(NamedTuple):
    """Rays in view space: at depth s the place is `start + s * direction`.

    Attributes:
        u, v: their lateral coordinates, as `model.camera` has them.
        near, far: depths between which light is looked at.
        is_perspective: whether all start at the eye.
    """

    u: Float[np.ndarray, " rays"]
    v: Float[np.ndarray, " rays"]
    near: float
    far: float
    is_perspective: bool

    @property
    def start(self) -> Float[np.ndarray, "rays 3"]:
        """Places at depth 0."""
        return lines(self.u, self.v, self.is_perspective)[0]

    @property
    def direction(self) -> Float[np.ndarray, "rays 3"]:
        """Change of place a unit of depth."""
        return lines(self.u, self.v, self.is_perspective)[1]

    @property
    def slant(self) -> Float[np.ndarray, " rays"]:
        """Path length a unit of depth."""
        return np.sqrt(1 + self.u**2 + self.v**2) if self.is_perspective else np.ones_like(self.u)

    def some(self, which: Int[np.ndarray, " some"]) -> Rays:
        """Those of the given numbers."""
        return self._replace(u=self.u[which], v=self.v[which])


def rays_of(camera: Camera, rows: Int[np.ndarray, " rays"], columns: Int[np.ndarray, " rays"]) -> Rays:
    """The rays through the middles of pixels."""
    u, v = ray_coordinates(camera, columns + 0.5, rows + 0.5)
    return Rays(u, v, *camera.near_and_far(), camera.is_perspective)


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


class Spheres:
    """Spheres in view space, with their shadows on the screen, by which rays find them.

    Attributes:
        center, radius: of them, length units.
    """

    def __init__(self, center: Float[np.ndarray, "spheres 3"], radius: Float[np.ndarray, " spheres"], is_perspective: bool):
        self.center, self.radius = center, radius
        self._shadow = [_shadow(center[:, axis], center[:, 2], radius, is_perspective) for axis in (0, 1)]

    def chords(self, rays: Rays) -> Chords:
        """All chords of `rays` between near and far; cut off there they are not."""
        found = [_chords(rays, self.center, self.radius, *pairs) for pairs in self._candidates(rays)]
        return Chords(*(np.concatenate(parts) for parts in zip(NO_CHORDS, *found, strict=True)))

    def _candidates(self, rays: Rays) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Numbers of rays and of spheres whose shadows they may be in, some at a time."""
        (left, right), (low, high) = self._shadow
        seen = (left <= rays.u.max()) & (right >= rays.u.min()) & (low <= rays.v.max()) & (high >= rays.v.min())
        seen &= (self.center[:, 2] + self.radius > rays.near) & (self.center[:, 2] - self.radius < rays.far)
        sphere, order = np.flatnonzero(seen), np.argsort(rays.u)
        first, last = np.searchsorted(rays.u[order], left[sphere]), np.searchsorted(rays.u[order], right[sphere], "right")
        for some in batches(last - first, MOST_CANDIDATES):
            which, ray = ranges(first[some], last[some] - first[some])
            ray, of = order[ray], sphere[some][which]
            inside = (low[of] <= rays.v[ray]) & (rays.v[ray] <= high[of])
            yield ray[inside], of[inside]


def ranges(first: Int[np.ndarray, " n"], count: Int[np.ndarray, " n"]) -> tuple[np.ndarray, np.ndarray]:
    """All of `first[i] .. first[i] + count[i] - 1` in a row, behind the i that each is of."""
    which = np.repeat(np.arange(len(first)), count)
    return which, np.arange(len(which)) - np.repeat(np.cumsum(count) - count - first, count)


def batches(count: Int[np.ndarray, " n"], most: int) -> list[Int[np.ndarray, " some"]]:
    """Numbers of things, as many at a time as have about `most` of what is counted together."""
    ends = np.cumsum(count)
    some = np.split(np.arange(len(ends)), np.searchsorted(ends, np.arange(most, ends[-1] if len(ends) else 0, most)))
    return [part for part in some if len(part)]


def _shadow(x: np.ndarray, z: np.ndarray, radius: np.ndarray, is_perspective: bool) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest lateral coordinate of rays that may meet spheres: of tangents, where the eye is not beside a sphere."""
    if not is_perspective:
        return x - radius, x + radius
    ahead = z > radius * (1 + 1e-6)
    margin = np.where(ahead, z**2 - radius**2, 1)
    root = radius * np.sqrt(np.where(ahead, x**2 + margin, 0))
    return np.where(ahead, (x * z - root) / margin, -np.inf), np.where(ahead, (x * z + root) / margin, np.inf)


def _chords(rays: Rays, center: np.ndarray, radius: np.ndarray, ray: np.ndarray, sphere: np.ndarray) -> Chords:
    slant, middle = rays.slant[ray], center[sphere]
    start, direction = rays.start[ray], rays.direction[ray]
    foot = ((middle - start) * direction).sum(-1) / slant**2
    apart = functools.reduce(np.add, ((start + foot[:, None] * direction - middle) ** 2).T)
    half = np.sqrt(np.maximum(radius[sphere] ** 2 - apart, 0)) / slant
    entry, exit = foot - half, foot + half
    met = (entry < exit) & (exit > rays.near) & (entry < rays.far)
    return Chords(ray[met], sphere[met], entry[met], exit[met])
