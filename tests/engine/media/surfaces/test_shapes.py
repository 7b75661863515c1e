"""Of a sphere, a torus and a slab of particles the surface is where their field in float64 has it, and without a hole."""

from __future__ import annotations

import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.particles.field import ParticleField
from jaxsph.reference.where import rays_of, to_world

pytestmark = pytest.mark.usefixtures("quick_programs")

SPACING, SUPPORT, LEVEL = 0.05, 0.1, 0.5
RADIUS, RING, TUBE, THICK = 0.4, 0.36, 0.15, 0.15
OFF, TILTED = 1e-5, 0.1  # of a support; degrees
GRAZED = 0.02  # cosine between ray and normal, below which a place is not told by float32
STEEP = 0.2  # and above which it is as good along the ray as across the surface
INSIDE = 0.3  # of a support below the shape's face: what reaches so deep is met for certain
SETTINGS = js.Settings(samples=64)


def below(shape, place):
    """How deep places (..., 3) are below the face of a shape; negative outside."""
    x, y, z = np.moveaxis(place, -1, 0)
    if shape == "sphere":
        return RADIUS - np.sqrt(x * x + y * y + z * z)
    if shape == "torus":
        return TUBE - np.hypot(np.hypot(x, y) - RING, z)
    return THICK - np.abs(z)


def scene(shape):
    rng = np.random.default_rng(4)
    reach = 1.2 if shape == "slab" else 0.6
    steps = np.arange(-reach, reach, SPACING) + SPACING / 2
    place = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3)
    place = place[below(shape, place) > 0]
    place = (place + rng.uniform(-0.1, 0.1, place.shape) * SPACING).astype(np.float32)
    particles = js.Particles.from_arrays(place, SUPPORT, place[:, 0], SPACING**3)
    return js.Scene(particles=particles, surface=js.Surface(LEVEL))


def camera(shape, side):
    where = {"width": side, "height": side, "fov_degrees": 20.0 if shape == "slab" else 30.0}
    return js.Camera.look_at((0.9, 0.6, 1.9), (0.0, 0.0, 0.0), near=1.2, far=3.2, **where)


@pytest.mark.parametrize(
    ("shape", "side"),
    [
        ("torus", 48),
        pytest.param("sphere", 1000, marks=pytest.mark.slow),
        pytest.param("torus", 1000, marks=pytest.mark.slow),
        pytest.param("slab", 1000, marks=pytest.mark.slow),
    ],
)
def test_depths_normals_and_no_hole(shape, side):
    shown, view = scene(shape), camera(shape, side)
    image = js.render(shown, view, SETTINGS)
    depth = np.asarray(image.depth, np.float64)
    met = np.isfinite(depth)
    rows, columns = np.mgrid[:side, :side].reshape(2, -1)
    rays = rays_of(view, rows, columns)
    deepest = np.full(side * side, -np.inf)
    for along in np.linspace(1.2, 3.2, 160):
        deepest = np.maximum(deepest, below(shape, to_world(rays.start + along * rays.direction, view)))
    certain = (deepest > INSIDE * SUPPORT).reshape(side, side)
    assert met[certain].all() and certain.sum() > 0.2 * side * side and (shape != "slab" or met.all())

    rows, columns = np.nonzero(met)
    rays = rays_of(view, rows, columns)
    place, ahead = (to_world(rays.start + (depth[met] + more)[:, None] * rays.direction, view) for more in (0, 1))
    there, way = ParticleField(shown.particles).at(place), ahead - place
    slope, length = (there.gradient * way).sum(1), np.linalg.norm(way, axis=1)
    facing = np.abs(slope) / np.linalg.norm(there.gradient, axis=1) / length
    seen, steep = facing > GRAZED, facing > STEEP
    off = np.abs(there.coverage - LEVEL) / np.abs(slope) / SUPPORT
    assert off[steep].max() <= OFF and (off * facing)[seen].max() <= OFF and seen.mean() > 0.95
    normal = np.asarray(image.normal, np.float64)[met][seen]
    tilted = np.degrees(np.linalg.norm(np.cross(normal, there.normal[seen]), axis=1))
    assert tilted.max() <= TILTED and ((normal * there.normal[seen]).sum(1) > 0).all()
