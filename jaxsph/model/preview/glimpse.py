r"""A coarse picture of a scene's particles and volumes, in NumPy: a lattice of rays, jittered samples along each, no programs.

Flow: Scene, Camera -> [glimpse] -> optical depths, light and where it comes from, exposure -> frame, opening.

Samples are even in depth, each ray with an offset of its own, so that what is thinner than a step is met as often as it should.
The field at a sample is $Q = \sum_j q_j V_j W_j / \sum_j V_j W_j$, as everywhere. It is an estimate, for choosing a look and a
frame: no bound is made of it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.volume import Volume

RAYS, STEPS = 40, 48
"""Rays along the longer side of the image, and samples along each."""
PAIRS = 1 << 21
"""Particles times rays that are looked at in one go."""
SEED = 0
BRIGHT, ALPHA = 99.0, 0.95
"""Percentile of the pixels that is to have this alpha."""
LIT, LEAST_LIT = 0.12, 0.3
"""A channel from which a pixel is not dark, and the share of the pixels that have anything at all that is to be lit."""
MOST = 64.0
"""Factor by which the share of lit pixels may brighten what the brightest alone ask for."""


@dataclasses.dataclass(frozen=True, eq=False)
class Glimpse:
    """What rays through a coarse lattice of pixels meet.

    Attributes:
        u, v: lateral coordinates of columns and rows of rays: tangents if perspective, else length units.
        depth: (rows, columns, steps) view depths of the samples.
        length: (rows, columns) length of ray that each sample stands for, length units.
        extinction: (rows, columns, steps), a unit of length.
        color: (rows, columns, steps, 3).
    """

    u: Float[np.ndarray, " columns"]
    v: Float[np.ndarray, " rows"]
    depth: Float[np.ndarray, "rows columns steps"]
    length: Float[np.ndarray, "rows columns"]
    extinction: Float[np.ndarray, "rows columns steps"]
    color: Float[np.ndarray, "rows columns steps 3"]

    @property
    def optical_depth(self) -> Float[np.ndarray, "rows columns"]:
        """Of whole rays."""
        return self.extinction.sum(2) * self.length

    def weights(self, scale: float = 1.0) -> Float[np.ndarray, "rows columns steps"]:
        """Share of each sample in its pixel, for `scale` times the extinction; the sum along a ray is its alpha."""
        depth = scale * self.extinction * self.length[..., None]
        through = np.exp(-(np.cumsum(depth, 2) - depth))
        return through * -np.expm1(-depth)

    def picture(self, scale: float = 1.0) -> Float[np.ndarray, "rows columns 3"]:
        """The colours of the pixels, over black."""
        return (self.weights(scale)[..., None] * self.color).sum(2)


def exposure(seen: Glimpse) -> float:
    """A factor of the extinction, > 0, at which the 99th percentile of alpha is 0.95, and of all pixels that meet anything three
    in ten are lit; 1 where nothing is met.
    """
    depth = seen.optical_depth
    meets = depth > 0
    if not meets.any():
        return 1.0
    brightest = float(np.percentile(depth, BRIGHT)) or float(depth.max())
    scale = -np.log1p(-ALPHA) / brightest
    limit = scale * MOST
    while scale < limit and (seen.picture(scale).max(-1) > LIT)[meets].mean() < LEAST_LIT:
        scale *= 2**0.25
    return float(scale)


def typical_exposure(seen: Glimpse) -> float:
    r"""A factor of the extinction, > 0, at which what is most opaque has an alpha of 0.95, however small it is in the picture.

    That is the mean optical depth weighted by itself, $\sum \tau^2 / \sum \tau$; 1 where nothing is met.
    """
    depth = seen.optical_depth
    total = float(depth.sum())
    return float(-np.log1p(-ALPHA) * total / (depth**2).sum()) if total > 0 else 1.0


def glimpse(scene: Scene, camera: Camera, rays: int = RAYS, steps: int = STEPS) -> Glimpse:
    """A coarse picture of particles and volumes of a scene; points and other media are not in it (host side).

    Args:
        scene: of which particles and volumes are seen, where `within` shows them.
        camera: of which the view is taken, not the number of pixels.
        rays: along the longer side of the image.
        steps: samples along each ray.
    """
    longest = max(camera.width, camera.height)
    columns, rows = (max(2, round(rays * size / longest)) for size in (camera.width, camera.height))
    half = float(camera.half_height)
    v = half * (1 - 2 * (np.arange(rows) + 0.5) / rows)
    u = half * camera.width / camera.height * (2 * (np.arange(columns) + 0.5) / columns - 1)
    near, far = camera.near_and_far()
    step = (far - near) / steps
    offset = np.random.default_rng(SEED).random((rows, columns))
    depth = near + step * (np.arange(steps) + offset[..., None])
    slant = 1 + v[:, None] ** 2 + u**2 if camera.is_perspective else np.ones((rows, columns))
    shape = depth.shape
    extinction, color = np.zeros(shape), np.zeros((*shape, 3))
    rays_of = _Rays(camera, u, v, near, step, steps, offset, slant)
    if scene.particles is not None and scene.transfer is not None:
        _add(extinction, color, *_particles(scene.particles, scene.transfer, rays_of))
    place = rays_of.places(depth)
    for volume, look in scene.volumes:
        _add(extinction, color, *_volume(volume, look, place))
    if scene.within is not None:
        extinction *= np.asarray(scene.within.contains(tuple(np.moveaxis(place, -1, 0))))
    return Glimpse(u, v, depth, step * np.sqrt(slant), extinction, color)


@dataclasses.dataclass(frozen=True, eq=False)
class _Rays:
    """The lattice: its rays, and where samples sit along them."""

    camera: Camera
    u: np.ndarray
    v: np.ndarray
    near: float
    step: float
    steps: int
    offset: np.ndarray
    slant: np.ndarray

    def places(self, depth: np.ndarray) -> np.ndarray:
        """World coordinates of samples, (rows, columns, steps, 3)."""
        spread = depth if self.camera.is_perspective else np.ones_like(depth)
        view = np.stack([spread * self.u[None, :, None], spread * self.v[:, None, None], depth], -1)
        return view @ np.asarray(self.camera.axes, np.float64) + self.camera.exact_eye()

    def seen(self, position: np.ndarray) -> np.ndarray:
        """View coordinates of places, (..., 3)."""
        return (position - self.camera.exact_eye()) @ np.asarray(self.camera.axes, np.float64).T

    def reached(self, view: np.ndarray, support: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and one past the last column and row that each sphere may reach, (2, N) of (columns, rows) each."""
        first, past = [], []
        for axis, (places, sign) in enumerate(((self.u, 1), (self.v, -1))):
            low, high = view[:, axis] - support, view[:, axis] + support
            if self.camera.is_perspective:
                front, back = view[:, 2] - support, view[:, 2] + support
                safe = np.where(front > 0, front, 1)
                low, high = np.minimum(low / safe, low / np.where(back > 0, back, 1)), np.maximum(high / safe, high / back)
                around = front <= self.near / 2
                low, high = np.where(around, -np.inf, low), np.where(around, np.inf, high)
            order = places if sign > 0 else places[::-1]
            begin, end = np.searchsorted(order, low), np.searchsorted(order, high)
            first.append(begin if sign > 0 else len(places) - end)
            past.append(end if sign > 0 else len(places) - begin)
        gone = (view[:, 2] + support < self.near) | (view[:, 2] - support > self.near + self.step * self.steps)
        return np.array(first), np.where(gone, np.array(first), np.array(past))


def _particles(particles: Particles, look: TransferFunction, rays: _Rays) -> tuple[np.ndarray, np.ndarray]:
    """Extinction and colour of the field at all samples."""
    valid = np.asarray(particles.valid)
    view = rays.seen(particles.exact_position()[valid])
    support = np.asarray(particles.support, np.float64)[valid]
    volume = np.asarray(particles.volume, np.float64)[valid]
    weight = volume / support**3
    weight = weight / (weight.max(initial=0) or 1)
    kernel = kernels.by_name(particles.kernel)
    quantities = [np.asarray(one, np.float64)[valid] for one in particles.quantities]
    shape = (len(rays.v), len(rays.u), rays.steps)
    sums = np.zeros((1 + len(quantities), int(np.prod(shape))))
    for row, column, of in _pairs(*rays.reached(view, support)):
        at, radius = view[of], support[of]
        u, v, slant = rays.u[column], rays.v[row], rays.slant[row, column]
        if rays.camera.is_perspective:
            nearest = (at[:, 0] * u + at[:, 1] * v + at[:, 2]) / slant
            away = ((nearest[:, None] * np.stack([u, v, np.ones_like(u)], 1) - at) ** 2).sum(1)
        else:
            nearest, away = at[:, 2], (at[:, 0] - u) ** 2 + (at[:, 1] - v) ** 2
        half = np.sqrt(np.maximum(radius**2 - away, 0) / slant)
        start = rays.near + rays.step * rays.offset[row, column]
        first = np.maximum(np.ceil((nearest - half - start) / rays.step), 0).astype(np.int64)
        past = np.minimum(np.floor((nearest + half - start) / rays.step) + 1, rays.steps).astype(np.int64)
        pair, number = _expanded(first, np.where(away < radius**2, past, first))
        square = away[pair] + (start[pair] + rays.step * number - nearest[pair]) ** 2 * slant[pair]
        value = weight[of[pair]] * kernel.of_square(np.minimum(square / radius[pair] ** 2, 1.0), np)
        entry = (row[pair] * shape[1] + column[pair]) * shape[2] + number
        sums[0] += np.bincount(entry, value, sums.shape[1])
        for nth, quantity in enumerate(quantities, 1):
            sums[nth] += np.bincount(entry, value * quantity[of[pair]], sums.shape[1])
    covered = sums[0] > 0
    field = [np.where(covered, one / np.where(covered, sums[0], 1), 0).reshape(shape) for one in sums[1:]]
    extinction, color = _looked_up(look, field[0], field[-1])
    return extinction * covered.reshape(shape), color


def _looked_up(look: TransferFunction, by: np.ndarray, opaque_by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extinction and colour at values of the quantity, or of two."""
    values, colors = np.asarray(look.values, np.float64), np.asarray(look.colors, np.float64)
    own = look.values if look.extinction_values is None else look.extinction_values
    extinction = np.interp(opaque_by, np.asarray(own, np.float64), np.asarray(look.extinction, np.float64))
    return extinction, np.stack([np.interp(by, values, channel) for channel in colors.T], -1)


def _volume(volume: Volume, look: TransferFunction, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extinction and colour of a volume at places."""
    values = np.asarray(volume.values)  # as they are: a copy in float64 of a large scan would not fit
    lattice = (place - np.asarray(volume.lower, np.float64)) / np.asarray(volume.spacing, np.float64)
    inside = ((lattice >= 0) & (lattice <= np.array(values.shape) - 1)).all(-1)
    places = np.moveaxis(lattice, -1, 0)
    quantity = scipy.ndimage.map_coordinates(values, places, np.float64, order=1, mode="nearest")
    extinction, color = _looked_up(look, quantity, quantity)
    return extinction * inside, color


def _add(extinction: np.ndarray, color: np.ndarray, more: np.ndarray, of_more: np.ndarray) -> None:
    """Add a medium: extinctions add, colours weigh by them."""
    total = extinction + more
    share = np.where(total > 0, more / np.where(total > 0, total, 1), 0)[..., None]
    color += share * (of_more - color)
    extinction += more


def _pairs(first: np.ndarray, past: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Rows, columns and particles of all pairs of a ray and a particle whose rectangle holds it, some at a time."""
    wide, high = np.maximum(past - first, 0)
    count = wide * high
    some = np.flatnonzero(count)
    ends = np.cumsum(count[some])
    begin = 0
    while begin < len(some):
        done = ends[begin - 1] if begin else 0
        end = max(begin + 1, int(np.searchsorted(ends, done + PAIRS)))
        of, number = _expanded(np.zeros(end - begin, np.int64), count[some[begin:end]])
        of = some[begin:end][of]
        row, column = np.divmod(number, wide[of])
        yield first[1][of] + row, first[0][of] + column, of
        begin = end


def _expanded(first: np.ndarray, past: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of ranges of whole numbers: to which range each number in them belongs, and the numbers."""
    count = np.maximum(past - first, 0)
    of = np.repeat(np.arange(len(count)), count)
    before = np.cumsum(count) - count
    return of, np.arange(len(of)) - before[of] + first[of]
