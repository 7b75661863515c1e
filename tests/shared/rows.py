"""Frames of every combination that a user may ask for: what is shown, where, by which integrator, screen and kernel."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxsph as js
from jaxsph.engine.planning.plan import Plan
from jaxsph.model.medium import Medium
from jaxsph.numerics.checks import array_of

WIDTH, HEIGHT, SAMPLES, COUNT = 10, 9, 16, 24
OUTSIDE = ~js.Sphere((0.1, 0.0, 0.1), 0.55)
CLIPS = {
    "everywhere": None,
    "plane": js.Plane((0.05, 0.1, -0.1), (0.3, 1.0, 0.2)),
    "box": js.Box((-0.7, -0.6, -0.8), (0.8, 0.7, 0.6)),
    "sphere": js.Sphere((0.1, 0.0, 0.1), 0.8),
    "~sphere": OUTSIDE,
    "plane & ~sphere": js.Plane((0.0, 0.3, 0.0), (0.2, -1.0, 0.1)) & OUTSIDE,
}


@dataclasses.dataclass(frozen=True)
class Row:
    """One combination, and which of its promises are kept by quick tests."""

    media: str
    clip: str = "everywhere"
    integrator: str = "samples"
    screen: str = "pixels"
    kernel: str = "poly6"
    seed: int = 0
    quick: tuple[str, ...] = ()
    projection: str = "perspective"

    @property
    def name(self) -> str:
        """Such as "volume, plane, segments, pixels, poly6, perspective"."""
        return f"{self.media}, {self.clip}, {self.integrator}, {self.screen}, {self.kernel}, {self.projection}"

    @property
    def settings(self) -> js.Settings:
        """With a tolerance where the screen is to interpolate; segments that are refined for one have no derivatives."""
        tolerance = 0.05 if self.screen == "quadtree" and self.integrator == "samples" else None
        return js.Settings(samples=SAMPLES, integrator=self.integrator, screen=self.screen, leaf_pixels=4, tolerance=tolerance)

    def inputs(self, frames: Any, seed: int | None = None) -> tuple[js.Scene, js.Camera]:
        """A scene and a camera in float64; another seed draws others of the same shapes."""
        rng = np.random.default_rng(self.seed if seed is None else seed)
        size = dataclasses.replace(frames, width=WIDTH, height=HEIGHT, samples=SAMPLES)
        scene = FRAMES[self.media](size, rng, self.kernel)
        camera = size.camera(rng, self.projection, dtype=np.float64)
        return dataclasses.replace(scene, within=_double(CLIPS[self.clip])), camera

    def truth(self, frames: Any) -> tuple[js.Scene, js.Camera] | None:
        """What the reference shows the same of; None where it knows of no such media, or not all pixels are samples."""
        unknown = self.media in ("surface", "fluid", "all together", "fog")
        return None if unknown or self.integrator != "samples" or self.screen != "pixels" else self.inputs(frames)

    def plan(self, frames: Any) -> Plan:
        """With room for other scenes of these shapes."""
        plan = js.plan(*self.inputs(frames), self.settings, headroom=4)
        return js.plan(*self.inputs(frames, self.seed + 1), self.settings, like=plan, headroom=4)


def _double(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), tree)


def _look(rng: np.random.Generator, low: float = 0.0, high: float = 1.0) -> js.TransferFunction:
    values = np.linspace(low, high, 4) + rng.uniform(-0.05, 0.05, 4)
    return js.TransferFunction.from_points(values, rng.uniform(0.1, 0.9, (4, 3)), rng.uniform(0.3, 3, 4))


def _particles(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    return frames.scene(rng, kernel, decades=0.3, count=COUNT, dtype=np.float64)


def _two_quantities(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    one, look = _particles(frames, rng, kernel).particles, _look(rng)
    quantity = np.asarray(one.quantity), rng.uniform(2, 5, COUNT)
    columns = np.asarray(one.position), np.asarray(one.support), quantity, np.asarray(one.volume)
    look = js.TransferFunction.from_points(look.values, look.colors, rng.uniform(0.3, 3, 3), [2.0, 3.1, 5.0])
    return js.Scene(particles=js.Particles.from_arrays(*columns, kernel), transfer=look)


def _periodic(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    one = _particles(frames, rng, kernel)
    columns = (np.asarray(column) for column in (one.particles.position, one.particles.support, one.particles.quantity))
    position, support, quantity = columns
    box = np.array([1.7, 1.5, 1.6])
    particles = js.Particles.from_arrays(position % box, 0.4 * support, quantity, rng.uniform(0.1, 1, COUNT), kernel, box=box)
    return dataclasses.replace(one, particles=particles.centered((0.0, 0.0, 0.0)))


def _grid(rng: np.random.Generator) -> js.Volume:
    x = np.linspace(-1, 1, 7)
    distance = np.sqrt(x[:, None, None] ** 2 + 1.3 * x[:, None] ** 2 + 0.8 * x**2)
    return js.Volume.from_array(distance + rng.uniform(-0.03, 0.03, distance.shape), (-0.9, -0.9, -0.9), 0.3)


def _volume(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    return js.Scene(volume=_grid(rng), volume_transfer=_look(rng, 0.2, 1.6))


def _points(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    return js.Scene(points=tuple(_stars(rng, profile) for profile in ("gaussian", "ball", np.array([1.0, 0.8, 0.3, 0.0]))))


def _feet(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    return js.Scene(points=(_stars(rng, spread="feet"), _stars(rng, "ball", spread="feet", splats_beyond=2.6)))


def _stars(rng: np.random.Generator, profile: Any = "gaussian", **more: Any) -> js.Points:
    position, radius = rng.uniform(-0.8, 0.8, (12, 3)), rng.uniform(0.2, 0.5, 12)
    color, extinction = rng.uniform(0.1, 0.9, (12, 3)), rng.uniform(0.5, 3, 12)
    return js.Points.from_arrays(position, radius, color, extinction, profile, **more)


def _surface(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    return js.Scene(media=(js.IsoSurface.from_volume(_grid(rng), 0.62),))


def _fluid(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    return dataclasses.replace(_particles(frames, rng, kernel), surface=_double(js.Surface(0.02, smoothing=1.2)))


def _all(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    scene, volume = _particles(frames, rng, kernel), _volume(frames, rng, kernel)
    more = {"volume": volume.volume, "volume_transfer": volume.volume_transfer, "points": _stars(rng)}
    return dataclasses.replace(scene, media=(js.IsoSurface.from_volume(_grid(rng), 0.35),), **more)


def _by_opacity(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    scene, volume = _particles(frames, rng, kernel), _volume(frames, rng, kernel)
    return dataclasses.replace(scene, volume=volume.volume, volume_transfer=volume.volume_transfer, mix="opacity")


@dataclasses.dataclass(frozen=True)
class Fog(Medium):
    """A medium of one's own: everywhere the same, or what lies within a radius of a place in the world."""

    extinction_here: jax.Array
    color: jax.Array
    place: jax.Array
    radius: float = np.inf

    @classmethod
    def of(cls, extinction: Any = 0.7, color: Any = (0.2, 0.5, 0.9), radius: float = np.inf, dtype: Any = np.float32) -> Fog:
        """About the origin."""
        return cls(*(array_of(number, dtype) for number in (extinction, color, np.zeros(3))), radius)

    def seen_by(self, camera: js.Camera) -> Fog:
        return dataclasses.replace(self, place=camera.to_view(self.place))

    def occupied(self, slabs: Any) -> jax.Array:
        return slabs.distance_to(*self.place) <= self.radius

    def extinction(self, gathered: Any, task: Any) -> tuple[jax.Array, Any]:
        square = sum((at - middle) ** 2 for at, middle in zip(task.positions(), self.place, strict=True))
        return jnp.where(square <= self.radius**2, self.extinction_here, 0), ()

    def colors(self, samples: Any, task: Any, channels: slice) -> list[jax.Array]:
        return [jnp.broadcast_to(color, task.shape) for color in list(self.color)[channels]]


jax.tree_util.register_dataclass(Fog, data_fields=["extinction_here", "color", "place"], meta_fields=["radius"])


def _fog(frames: Any, rng: np.random.Generator, kernel: str) -> js.Scene:
    return dataclasses.replace(_particles(frames, rng, kernel), media=(Fog.of(dtype=np.float64),))


MEDIA = {
    "particles": _particles,
    "two quantities": _two_quantities,
    "volume": _volume,
    "points": _points,
    "surface": _surface,
    "fluid": _fluid,
    "all together": _all,
    "periodic": _periodic,
}
FRAMES = MEDIA | {"by opacity": _by_opacity, "fog": _fog, "feet": _feet}
"""What random frames are not of, too: too few may have it."""
