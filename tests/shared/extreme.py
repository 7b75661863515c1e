"""Frames that are extreme in one thing or several, and how wrong an image of them may be.

An image is right if it is the reference image of particles and samples moved by a few eps of their distance from the eye. How
much that changes a pixel is what it may be off, and 64 eps (`error_and_allowance`).
"""

import dataclasses
from unittest import mock

import numpy as np
from images import layers

import jaxsph as js
from jaxsph.engine.request import times
from jaxsph.numerics.checks import array_of
from jaxsph.reference import image as reference_image

EPS = float(np.finfo(np.float32).eps)
FORWARD = -np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])


def spoilt(owner, field, value, at=None):
    """The same with other numbers at an index or a slice of one of its arrays; by default, with another first number."""
    found = np.array(getattr(owner, field))
    found[(0,) * found.ndim if at is None else at] = value
    return dataclasses.replace(owner, **{field: array_of(found)})


@dataclasses.dataclass(frozen=True)
class Extreme:
    """A frame of 24 particles in a cube of two units, seen from three units away; and what of it is extreme."""

    length: float = 1.0  # of a unit
    offset: float = 0.0  # of everything from the origin, units
    decades: float = 1.0  # over which supports are spread
    volume: str = "given"
    support: float = 1.0
    slab: float | None = None  # far / near - 1 of a thin frame, into which the scene is shrunk
    nearest: float | None = None  # far / near
    extinction: tuple[float, ...] = (1, 1, 1, 1, 1)  # factors
    scale: float = 1.0  # of quantities and control points
    start: float = 0.0  # of quantities and control points, before they are scaled
    spike: float | None = None  # quantity of two particles
    coincident: bool = False
    projection: str = "perspective"
    kernel: str = "poly6"

    def scene(self, frames, seed=0):
        rng = np.random.default_rng(seed)
        count = frames.capacity
        position = rng.uniform(-1, 1, (count, 3)) * (0 if self.coincident else 1)
        support = 0.9 * 10 ** -rng.uniform(0, self.decades, count) * self.support
        volume = {"given": rng.uniform(0.1, 1, count), "equal": np.ones(count), "cube": support**3 / support.max() ** 3}[
            self.volume
        ]
        quantity = self.rounded(rng.uniform(0, 1, count))
        if self.spike is not None:
            quantity[:2] = self.spike, -self.spike
        points = np.sort(rng.uniform(0, 1, 5)), rng.uniform(0, 1, (5, 3)), rng.uniform(0, 4, 5) * self.extinction
        unit = self.length * (1 if self.slab is None else self.slab / 3.4)
        place = position * unit + self.origin()
        particles = js.Particles.from_arrays(place, support * unit, quantity, volume, self.kernel)
        return js.Scene(
            particles=particles, transfer=js.TransferFunction.from_points(self.rounded(points[0]), points[1], points[2] / unit)
        )

    def rounded(self, value):
        """Numbers that float32 holds as they are."""
        return np.float32((value + self.start) * self.scale).astype(np.float64)

    def origin(self):
        return np.array([1, -1 / 3, 1 / 7]) * self.offset * self.length

    def camera(self, frames):
        target, size = self.origin(), {"width": frames.width, "height": frames.height}
        distance, near, far, height = 3.0, 1.3, 4.7, 2.6
        if self.slab is not None:
            distance, near, far, height = 1.0, 1 - self.slab / 2, 1 + self.slab / 2, 0.8 * self.slab
        if self.nearest is not None:
            near = far / self.nearest
        distance, near, far, height = (value * self.length for value in (distance, near, far, height))
        eye, up = target - FORWARD * distance, (0.1, 1, 0.2)
        if self.projection == "perspective":
            fov = 2 * np.degrees(np.arctan(height / distance / 2))
            return js.Camera.look_at(eye, target, up, fov, **size, near=near, far=far)
        return js.Camera.orthographic(eye, target, up, height, **size, near=near, far=far)


def moved(scene, camera, rng, part):
    """The scene with everything moved by up to `part` of what it is rounded by: positions, supports, quantities."""
    particles = scene.particles
    position, eye = particles.exact_position(), camera.exact_eye()
    distance = np.abs(position - eye).max(1, keepdims=True)
    quantity = np.asarray(particles.quantity, np.float64)
    inside = np.abs(quantity) <= 1e6 * np.abs(np.asarray(scene.transfer.values, np.float64)).max()
    spread = np.ptp(quantity[inside]) if inside.any() else 0
    shaken = {
        "position": position + part * distance * rng.uniform(-1, 1, position.shape),
        "quantity": quantity + part * spread * rng.uniform(-1, 1, quantity.shape),
        "support": np.asarray(particles.support, np.float64) * (1 + part * rng.uniform(-1, 1, quantity.shape)),
        "position_rest": None,
    }
    return dataclasses.replace(scene, particles=dataclasses.replace(particles, **shaken))


def error_and_allowance(image, scene, camera, settings, draws=6):
    """Error of every pixel, and how much the reference changes when rounding moves what it is made of."""
    truth = layers(js.reference.render(scene, camera, settings))
    part = (4 + np.log(float(camera.far) / float(camera.near)) / 2 if camera.is_perspective else 4) * EPS
    rng, change = np.random.default_rng(0), np.zeros(truth.shape[:2])
    depth = reference_image._depth
    for _ in range(draws):

        def shaken_depth(*at):
            exact = depth(*at)
            return exact + part * np.abs(exact) * rng.uniform(-1, 1, exact.shape)

        with mock.patch.object(reference_image, "_depth", shaken_depth):
            shaken = layers(js.reference.render(moved(scene, camera, rng, part), camera, settings))
        change = np.maximum(change, np.abs(shaken - truth).max(-1))
    return np.abs(layers(image) - truth).max(-1), 64 * EPS + 2 * change


def same_in_another_unit(image, other, digits):
    """Whether an image is another of lengths of `2 ** digits`."""
    for name in ("color", "transmittance", "error_bound", "evaluations"):
        np.testing.assert_array_equal(getattr(image, name), getattr(other, name), err_msg=name)
    np.testing.assert_array_equal(image.depth, np.asarray(times(other.depth, digits)))
