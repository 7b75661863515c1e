"""One ray in float64: it meets what an independent count finds, and loses the light that the images of the oracle lose."""

import dataclasses
import itertools

import numpy as np
import pytest
from chords import Rays

import jaxsph as js
from jaxsph.reference.light_integral import along

SIZE = {"width": 12, "height": 10}
PIXELS = [(4, 5), (0, 0), (9, 11), (5, 2)]
SAMPLES = 40
LOOK = js.TransferFunction.from_points([0, 0.4, 1], [(1, 0.5, 0), (0, 0.5, 1), (1, 1, 1)], [0.5, 2.0, 0.2])


def cloud(box=None):
    rng = np.random.default_rng(5)
    position = rng.uniform(-1, 1, (60, 3)).astype(np.float32)
    columns = rng.uniform(0.2, 0.6, 60), rng.uniform(size=60), rng.uniform(1, 2, 60)
    return js.Particles.from_arrays(position, *columns, box=box)


def volume():
    values = np.random.default_rng(3).uniform(size=(4, 4, 4)).astype(np.float32)
    return js.Volume.from_array(values, (-0.9, -0.8, -0.7), 0.5)


def stars():
    position = np.array([[0.1, 0.2, 0.3], [-0.4, 0.1, 0], [0.5, -0.3, -0.2]], np.float32)
    return js.Points.from_arrays(position, [0.5, 0.4, 0.6], np.ones((3, 3), np.float32), [2.0, 1.0, 3.0])


OUTSIDE = js.Camera.look_at((0.3, 0.4, -4), (0, 0, 0), fov_degrees=40, near=2.2, far=6.0, **SIZE)
CAMERAS = {
    "perspective": OUTSIDE,
    "among": js.Camera.look_at((0.1, 0.05, -0.2), (0, 0, 1), fov_degrees=60, near=0.05, far=3.0, **SIZE),
    "orthographic": js.Camera.orthographic((0, 0, -3), (0, 0, 0), view_height=2.4, near=1.0, far=3.2, **SIZE),
}
SCENES = {
    "particles": js.Scene(particles=cloud(), transfer=LOOK),
    "clipped": js.Scene(particles=cloud(), transfer=LOOK, volume=volume(), volume_transfer=LOOK, points=stars(),
                        within=js.Sphere((0.1, 0, 0), 0.8) & ~js.Plane((0.4, 0, 0), (1, 0, 0))),
    "periodic": js.Scene(particles=cloud(js.Box((-1, -1, -1), (1, 1, 1))), transfer=LOOK),
    "all": js.Scene(particles=cloud(), transfer=LOOK, volume=volume(), volume_transfer=LOOK, points=stars()),
    "volume": js.Scene(volume=volume(), volume_transfer=LOOK),
    "points": js.Scene(points=stars()),
}  # fmt: skip


def met(scene, camera, row, column):
    """Entries of the particles whose supports a ray passes through, by a dense walk along it."""
    rays = Rays.of(camera)
    nth = row * camera.width + column
    depth = np.linspace(rays.near, rays.far, 20_001)
    place = rays.start[nth] + depth[:, None] * rays.direction[nth]
    box = scene.particles.box
    if box is not None:
        place = place[np.all((place >= -1) & (place <= 1), axis=1)]
    found = []
    for entry in np.flatnonzero(np.asarray(scene.particles.valid)):
        turns = [(0, 0, 0)] if box is None else list(itertools.product((-2, 0, 2), repeat=3))
        centers = np.asarray(scene.particles.position[entry], np.float64) + np.array(turns)
        if any((np.linalg.norm(place - one, axis=1) < float(scene.particles.support[entry])).any() for one in centers):
            found.append(entry)
    return found


@pytest.mark.parametrize("view", CAMERAS)
@pytest.mark.parametrize("name", ["particles", "periodic"])
def test_particles_met_are_those_that_a_walk_along_the_ray_finds(name, view):
    scene, camera = SCENES[name], CAMERAS[view]
    counts = 0
    for pixel in PIXELS:
        found = along(scene, camera, *pixel)
        assert found.particles.tolist() == met(scene, camera, *pixel)
        assert found.particles.tolist() == along(scene, camera, *pixel, samples=SAMPLES).particles.tolist()
        counts += len(found.particles)
    assert counts > 8


@pytest.mark.parametrize("view", CAMERAS)
@pytest.mark.parametrize("name", SCENES)
def test_samples_lose_the_light_that_the_reference_image_loses(name, view):
    scene, camera = SCENES[name], CAMERAS[view]
    truth = js.reference.render(scene, camera, js.Settings(samples=SAMPLES))
    for pixel in PIXELS:
        found = along(scene, camera, *pixel, samples=SAMPLES)
        assert found.transmittance[-1] == pytest.approx(truth.transmittance[pixel], abs=1e-9)
        np.testing.assert_array_equal(found.depth, js.reference.sample_depths(camera, SAMPLES))


@pytest.mark.parametrize("view", CAMERAS)
@pytest.mark.parametrize("name", SCENES)
def test_nodes_lose_the_light_that_the_light_integral_loses(name, view):
    scene, camera = SCENES[name], CAMERAS[view]
    truth = js.reference.integral(scene, camera, pixels=tuple(np.array(PIXELS).T))
    for pixel, transmittance in zip(PIXELS, truth.transmittance, strict=True):
        found = along(scene, camera, *pixel)
        assert found.transmittance[-1] == pytest.approx(transmittance, abs=2e-6)
        assert (np.diff(found.depth) >= 0).all() and (np.diff(found.transmittance) <= 0).all()
        near, far = camera.near_and_far()
        assert found.depth[[0, -1]].tolist() == [near, far]


@pytest.mark.parametrize("samples", [None, SAMPLES])
@pytest.mark.parametrize("name", ["particles", "periodic"])
def test_what_particles_add_is_alpha(name, samples):
    for camera, pixel in itertools.product(CAMERAS.values(), PIXELS):
        found = along(SCENES[name], camera, *pixel, samples=samples)
        assert found.added.sum() == pytest.approx(1 - found.transmittance[-1], abs=1e-12)
        assert (found.added >= 0).all() and found.added.shape == found.particles.shape


def test_beside_other_parts_particles_add_their_own_share_alone():
    """Two media of the same extinction take as much, by whichever way of sampling."""
    flat = js.TransferFunction.from_points([0, 1], [(1, 1, 1), (1, 1, 1)], [1.0, 1.0])
    particles = js.Particles.from_arrays(np.zeros((1, 3), np.float32), 9.0, 0.5)
    solid = js.Volume.from_array(np.zeros((2, 2, 2), np.float32), (-9, -9, -9), 18.0)
    scene = js.Scene(particles=particles, transfer=flat, volume=solid, volume_transfer=flat)
    for samples in (None, SAMPLES):
        found = along(scene, OUTSIDE, 4, 5, samples=samples)
        assert found.particles.tolist() == [0]
        assert found.added[0] == pytest.approx((1 - found.transmittance[-1]) / 2, rel=1e-6)


def test_a_clip_hides_particles_that_lie_in_what_it_cuts_away():
    whole = SCENES["particles"]
    clipped = dataclasses.replace(whole, within=js.Plane((0, 0, 0.2), (0, 0, 1)))
    seen, left = along(whole, OUTSIDE, 4, 5), along(clipped, OUTSIDE, 4, 5)
    assert set(left.particles) < set(seen.particles)
    reach = np.asarray(whole.particles.position)[:, 2] + np.asarray(whole.particles.support)
    assert (reach[left.particles] > 0.2).all()


def test_quantities_are_told_where_there_are_any_one_or_two():
    two = js.TransferFunction.from_points([0, 1], [(1, 0, 0), (0, 0, 1)], [0.5, 2.0], extinction_values=[0, 10])
    rng = np.random.default_rng(5)
    position = rng.uniform(-1, 1, (60, 3)).astype(np.float32)
    particles = js.Particles.from_arrays(position, 0.5, (rng.uniform(size=60), rng.uniform(5, 9, 60)))
    for samples in (None, SAMPLES):
        first, second = along(js.Scene(particles=particles, transfer=two), OUTSIDE, 4, 5, samples=samples).quantities
        there = ~np.isnan(first)
        assert there.any() and (there == ~np.isnan(second)).all()
        assert first[there].max() <= 1 and second[there].min() >= 5
    for name in ("volume", "points"):
        (quantity,) = along(SCENES[name], OUTSIDE, 4, 5, samples=SAMPLES).quantities
        assert quantity.shape == (SAMPLES,) and np.isnan(quantity).all() == (name == "points")


def test_a_ray_that_meets_nothing_has_its_depths_and_all_of_its_light():
    aside = js.Camera.look_at((9, 9, -4), (9, 9, 0), near=1.0, far=6.0, **SIZE)
    for samples in (None, SAMPLES):
        found = along(SCENES["all"], aside, 4, 5, samples=samples)
        assert (found.transmittance == 1).all() and not found.extinction.any() and np.isnan(found.quantities[0]).all()
        assert not len(found.particles) and not len(found.added)
