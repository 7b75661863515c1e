r"""A coarse picture of a scene's particles and volumes, in NumPy: a lattice of rays, jittered samples along each, no programs.

Flow: Scene, Camera -> [glimpse] -> optical depths, light and where it comes from, exposure -> frame, opening.

Samples are even in depth, each ray with an offset of its own, so that what is thinner than a step is met as often as it should.
The field at a sample is $Q = \sum_j q_j V_j W_j / \sum_j V_j W_j$, as everywhere. It is an estimate, for choosing a look and a
frame: no bound is made of it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import scipy
from jaxtyping import Float

from jaxsph.model.camera.camera import Camera
from jaxsph.model.particles.field import EvenSamples, ParticleField
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import Scale, colors_at
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import array_of

RAYS, STEPS = 40, 48  # rays along the longer side of the image, and samples along each
SEED = 0
BRIGHT, ALPHA = 99.0, 0.95  # percentile of the pixels that is to have this alpha
LIT, LEAST_LIT = 0.12, 0.3  # a channel from which a pixel is not dark, and the share of all that have any light that is to be lit
SHOWS, BRIGHT_PLACE, MIDDLE_PLACE, DARK_PLACE = 0.3, 0.95, 0.5, 0.3  # alpha from which a pixel's colour counts; places in a map
NARROWEST, OF_MAP = 0.1, 0.8  # part of a range, to which that is narrowed at most; and of a map from light to light that is seen
RISING = 0.2  # by how much the ends of a map differ in lightness that goes from dark to light, or back
MOST = 64.0  # factor by which the share of lit pixels may brighten what the brightest alone ask for


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


def exposure(seen: Glimpse, light: bool = False) -> float:
    """A factor of the extinction, > 0, at which the 99th percentile of alpha is 0.95, and of all pixels that meet anything three
    in ten are lit, or differ from a `light` background; 1 where nothing is met.
    """
    depth = seen.optical_depth
    meets = depth > 0
    if not meets.any():
        return 1.0
    brightest = float(np.percentile(depth, BRIGHT)) or float(depth.max())
    scale = -np.log1p(-ALPHA) / brightest
    limit = scale * MOST
    while scale < limit:
        weights = seen.weights(scale)[..., None]
        if ((weights * (1 - seen.color if light else seen.color)).sum(2).max(-1) > LIT)[meets].mean() >= LEAST_LIT:
            break
        scale *= 2**0.25
    return float(scale)


def levelled(scene: Scene, camera: Camera) -> Scene:
    """Particles with the range of their colours fitted to the picture: pixels blend what is dense with what is thin before it, so
    that few would have the light end of a map, or all would. The 99th percentile is to have `BRIGHT_PLACE`, unless half would
    have more than `MIDDLE_PLACE`, and the 1st at most `DARK_PLACE`, as else a ball of even density in a thin medium would be of
    one colour. Maps that end about as light as they begin have what is seen from end to end; of both signs they stay as they are.
    """
    look: Any = scene.transfer
    values, places = np.asarray(look.values, np.float64), np.linspace(0, 1, len(look.values))
    rises = abs(float((look.colors[-1] - look.colors[0]).mean())) >= RISING
    if not rises and np.isclose(values[0], -values[-1]):
        return scene
    gray = dataclasses.replace(look, colors=array_of(np.tile(places, (3, 1)).T))
    seen = glimpse(dataclasses.replace(scene, transfer=gray), camera)
    alpha = seen.weights().sum(2)
    if not (shows := alpha > SHOWS).any():
        return scene
    low, *above = np.percentile(seen.picture()[shows, 0] / alpha[shows], (100 - BRIGHT, 50, BRIGHT))
    high, wanted = np.array(above), np.array((MIDDLE_PLACE, BRIGHT_PLACE))
    starts = (wanted * low - DARK_PLACE * high) / (wanted - DARK_PLACE)
    start = max(0.0, min(*starts, high[0] - MIDDLE_PLACE * NARROWEST))
    width = float(((high - start) / wanted).max())
    if not rises:
        width = max(high[1] - low, NARROWEST) / OF_MAP
        start = (low + high[1] - width) / 2
    ends = array_of(Scale.of(values).value(start + width * places), look.values.dtype)
    own = look.values if look.extinction_values is None else look.extinction_values
    return dataclasses.replace(scene, transfer=dataclasses.replace(look, values=ends, extinction_values=own))


def typical_exposure(seen: Glimpse) -> float:
    r"""A factor of the extinction, > 0, at which what is most opaque has an alpha of 0.95, however small it is in the picture.

    That is the mean optical depth weighted by itself, $\sum \tau^2 / \sum \tau$; 1 where nothing is met.
    """
    depth = seen.optical_depth
    total = float(depth.sum())
    return float(-np.log1p(-ALPHA) * total / (depth**2).sum()) if total > 0 else 1.0


def glimpse(scene: Scene, camera: Camera, rays: int = RAYS, steps: int = STEPS) -> Glimpse:
    """A coarse picture of particles and volumes of a scene, as `within` shows them; points and media are not in it (host side).

    Of the camera the view is taken, not the number of pixels: there are so many `rays` along the longer side.
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
    grid = EvenSamples(u, v, near, step, steps, offset, camera.is_perspective)
    extinction, color = np.zeros(depth.shape), np.zeros((*depth.shape, 3))
    if scene.particles is not None and scene.transfer is not None:
        _add(extinction, color, *_particles(scene.particles, scene.transfer, camera, grid))
    spread = depth if camera.is_perspective else np.ones_like(depth)
    view = np.stack([spread * u[None, :, None], spread * v[:, None, None], depth], -1)
    place = view @ camera.exact_axes() + camera.exact_eye()
    for volume, look in scene.volumes:
        _add(extinction, color, *_volume(volume, look, place))
    if scene.within is not None:
        extinction *= np.asarray(jax.jit(type(scene.within).contains)(scene.within, tuple(np.moveaxis(place, -1, 0))))
    return Glimpse(u, v, depth, step * np.sqrt(grid.slant), extinction, color)


def _particles(particles: Particles, look: TransferFunction, camera: Camera, rays: EvenSamples) -> tuple[np.ndarray, np.ndarray]:
    """Extinction and colour of the field at all samples."""
    held = ParticleField(particles, copied=False)
    view = camera.exact_view(held.position)
    (total, *weighted), _ = held.along(rays, view)
    covered = total > 0
    field = [np.where(covered, one / np.where(covered, total, 1), 0) for one in weighted]
    extinction, color = _looked_up(look, field[0], field[-1])
    return extinction * covered, color


def extinction_at(look: TransferFunction, quantity: np.ndarray) -> np.ndarray:
    """The extinction at values of the quantity that it is looked up by."""
    own = look.values if look.extinction_values is None else look.extinction_values
    return np.interp(quantity, np.asarray(own, np.float64), np.asarray(look.extinction, np.float64))


def _looked_up(look: TransferFunction, by: np.ndarray, opaque_by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extinction and colour at values of the quantity, or of two."""
    values, colors = np.asarray(look.values, np.float64), np.asarray(look.colors, np.float64)
    return extinction_at(look, opaque_by), colors_at(by, values, colors)


def _volume(volume: Volume, look: TransferFunction, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extinction and colour of a volume at places."""
    values = np.asarray(volume.values)  # as they are: a copy in float64 of a large scan would not fit
    lattice = (place - np.asarray(volume.lower, np.float64)) / np.asarray(volume.spacing, np.float64)
    inside = ((lattice >= 0) & (lattice <= np.array(values.shape) - 1)).all(-1)
    places = np.moveaxis(lattice, -1, 0)
    quantity = scipy.ndimage.map_coordinates(values, places, np.float64, order=1, mode="nearest")
    there = ~np.isnan(quantity)
    extinction, color = _looked_up(look, *2 * (np.where(there, quantity, 0),))
    return extinction * (inside & there), color


def _add(extinction: np.ndarray, color: np.ndarray, more: np.ndarray, of_more: np.ndarray) -> None:
    """Add a medium: extinctions add, colours weigh by them."""
    total = extinction + more
    share = np.where(total > 0, more / np.where(total > 0, total, 1), 0)[..., None]
    color += share * (of_more - color)
    extinction += more
