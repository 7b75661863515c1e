"""A surface with an opacity shows every time that a ray crosses it, in order of depth, and lets the rest of the light through."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from surfaced import ball, view_of_ball

import jaxsph as js
from jaxsph.analysis.at_places import ParticleField
from jaxsph.model.scene import widened
from jaxsph.reference.where import inside, rays_of, to_world

pytestmark = pytest.mark.usefixtures("quick_programs")

LEVEL, OPACITY, AMBIENT, COLOR = 0.45, 0.35, 0.2, np.array([0.9, 0.6, 0.3])
SETTINGS = js.Settings(samples=40)
PLACES = 2000  # of each ray
GRAZED = 3e-3  # of the level: a field that turns so near to it may be on either side


def shell():
    """The ball without its middle, so that rays cross up to four times."""
    particles = ball()
    hollow = np.asarray(particles.valid) & (np.linalg.norm(np.asarray(particles.position), axis=1) > 0.21)
    return dataclasses.replace(particles, valid=jnp.asarray(hollow))


def scene(**more):
    surface = js.Surface(LEVEL, color=tuple(COLOR), ambient=AMBIENT, opacity=OPACITY)
    return js.Scene(particles=shell(), surface=surface, **more)


def camera(projection="perspective"):
    return view_of_ball(projection, 16, 14)


def layers(scene, camera):
    """By definition, in float64: colours and alpha, how often rays cross, first normals, and which rays graze nothing."""
    rows, columns = (axis.ravel() for axis in np.mgrid[: camera.height, : camera.width])
    rays, field = rays_of(camera, rows, columns), ParticleField(widened(scene).particles)
    depth = np.linspace(float(camera.near), float(camera.far), PLACES)
    color, number, sure = np.zeros((len(rows), 3)), np.zeros(len(rows), int), np.ones(len(rows), bool)
    normal = np.zeros((len(rows), 3))
    for k in range(len(rows)):
        way = rays.direction[k]
        places = to_world(rays.start[k] + depth[:, None] * way, camera)
        value = field.at(places).coverage - LEVEL
        shown = inside(scene.particles_within, (places[1:] + places[:-1]) / 2)
        turns = (value[1:-1] - value[:-2]) * (value[2:] - value[1:-1]) <= 0
        sure[k] = not (turns & (np.abs(value[1:-1]) < GRAZED * LEVEL)).any()
        (crossed,) = np.nonzero(shown & ((value[1:] >= 0) != (value[:-1] >= 0)))
        at = depth[crossed] + value[crossed] / (value[crossed] - value[crossed + 1]) * (depth[1] - depth[0])
        found = field.at(to_world(rays.start[k] + at[:, None] * way, camera))
        ahead = np.diff(to_world(rays.start[k] + np.array([[0.0], [1.0]]) * way, camera), axis=0)[0]
        light = AMBIENT + (1 - AMBIENT) * np.abs(found.normal @ ahead) / np.linalg.norm(ahead)
        color[k] = ((1 - OPACITY) ** np.arange(len(at)) * OPACITY * light).sum() * COLOR
        number[k] = len(at)
        normal[k] = found.normal[0] if len(at) else 0
    shape = camera.height, camera.width
    return color.reshape(*shape, 3), number.reshape(shape), normal.reshape(*shape, 3), sure.reshape(shape)


@pytest.mark.core
@pytest.mark.parametrize(
    ("projection", "settings", "within"),
    [
        ("perspective", SETTINGS, None),
        pytest.param("orthographic", dataclasses.replace(SETTINGS, integrator="segments"), None, marks=pytest.mark.slow),
        pytest.param("perspective", SETTINGS, js.Plane((0.0, 0.0, -0.3), (0.2, 0.1, 1.0)), marks=pytest.mark.slow),
    ],
)
def test_every_crossing_is_a_layer(projection, settings, within):
    shown, view = scene(), camera(projection)
    if within is not None:
        shown = dataclasses.replace(shown, within=within)
    image = js.render(shown, view, settings)
    color, number, normal, sure = layers(shown, view)
    assert number.max() >= (4 if within is None else 3) and sure.sum() > 0.8 * sure.size and (number[sure] > 2).sum() > 4
    np.testing.assert_allclose(1 - np.asarray(image.alpha)[sure], (1 - OPACITY) ** number[sure], rtol=1e-5)
    np.testing.assert_allclose(np.asarray(image.color)[sure], color[sure], atol=2e-3)
    np.testing.assert_allclose(np.asarray(image.normal)[sure], normal[sure], atol=5e-3)


def test_droplets_between_samples_are_two_layers_each():
    """Three particles behind one another, each of which a ray enters and leaves between two samples."""
    view = camera()
    rays = rays_of(view, np.array([6]), np.array([9]))
    depth = np.array([[1.7], [2.0], [2.3]])  # samples are 0.05 apart, and a droplet is half as wide
    position = to_world(rays.start + depth * rays.direction, view)
    drops = js.Particles.from_arrays(position, 0.1, np.zeros(3), 2e-4, "cubic_spline")
    image = js.render(js.Scene(particles=drops, surface=js.Surface(0.48, opacity=0.25)), view, SETTINGS)
    np.testing.assert_allclose(np.asarray(image.transmittance)[6, 9], 0.75**6, rtol=1e-5)


def test_one_opacity_of_one_is_the_opaque_surface_and_a_number_changes_without_compiling(compiled):
    shown = scene()

    def of(opacity):
        surface = dataclasses.replace(shown.surface, opacity=opacity)
        return js.render(dataclasses.replace(shown, surface=surface), camera(), SETTINGS)

    wanted, image = of(None), of(jnp.float32(1))
    np.testing.assert_allclose(image.color, wanted.color, atol=1e-5)
    np.testing.assert_array_equal(image.alpha, wanted.alpha)
    np.testing.assert_allclose(image.depth, wanted.depth, rtol=1e-6)
    compiled.clear()
    met = np.isfinite(np.asarray(wanted.depth))
    thin, thick = (np.asarray(of(jnp.float32(opacity)).alpha) for opacity in (0.1, 0.6))
    assert not compiled and (thin[met] < thick[met]).all() and not thin[~met].any()


def test_what_lies_behind_shines_through():
    grid = np.stack(np.meshgrid(np.linspace(-0.6, 0.6, 5), np.linspace(-0.6, 0.6, 5)), -1).reshape(-1, 2)
    sheet = js.Points.from_arrays(np.c_[grid, np.full(25, 0.8)].astype(np.float32), 0.25, np.ones((25, 3)), np.full(25, 50.0))
    unmet = dataclasses.replace(scene().surface, level=1e3)
    scenes = scene(), scene(points=sheet), dataclasses.replace(scene(points=sheet), surface=unmet)
    alone, lit, behind = (js.render(one, camera(), SETTINGS) for one in scenes)
    assert not np.asarray(behind.normal).any() and np.asarray(behind.alpha).max() > 0.9
    through = np.asarray(alone.transmittance)[..., None] * np.asarray(behind.color)
    np.testing.assert_allclose(np.asarray(lit.color), np.asarray(alone.color) + through, atol=2e-3)
