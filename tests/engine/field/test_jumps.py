"""Where rounding may choose the side of a jump, or of a face, a picture is right or says that it does not know."""

import dataclasses

import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st
from images import layers

import jaxsph as js
from jaxsph.engine.field.jumps import LIPSCHITZ
from jaxsph.model.particles.kernels import KERNELS
from jaxsph.numerics.checks import array_of
from jaxsph.reference.where import ray_coordinates, to_world

pytestmark = pytest.mark.usefixtures("quick_programs")
ROUNDING = 1e-4  # of a pixel in float32, where no side is taken otherwise
INFORMED = 0.5  # of the pixels, that a bound must be known of


def require_right_or_unknown(scene, camera, settings, plan=None, informed=INFORMED):
    image = js.render(scene, camera, settings, plan=plan)
    truth = js.reference.render(scene, camera, dataclasses.replace(settings, tolerance=None))
    off, bound = np.abs(layers(image) - layers(truth)).max(-1), np.asarray(image.error_bound)
    assert (off <= bound + ROUNDING).all(), (off - bound).max()
    assert np.isfinite(bound).mean() >= informed
    assert bool(image.certified) == bool(np.isfinite(bound).all())
    return image


def sample_of(camera, samples, pixel, nth):
    """Where a sample lies in the world, in float64."""
    u, v = ray_coordinates(camera, np.array([pixel[1] + 0.5]), np.array([pixel[0] + 0.5]))
    depth = js.reference.sample_depths(camera, samples)[nth]
    aside = np.array([u[0], v[0]]) * (depth if camera.is_perspective else 1)
    return to_world(np.append(aside, depth), camera)


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=lambda kernel: kernel.name)
def test_roots_of_kernels_are_as_steep_as_said(kernel):
    q = np.linspace(0, 1, 20001)
    root = kernel.of_square(q * q, np) ** (1 / kernel.edge)
    assert root.max() <= 1 and np.abs(np.diff(root)).max() <= LIPSCHITZ * q[1] * (1 + 1e-6)


def test_means_at_a_jump_are_right_or_uncertified(frames):
    @examples(20)
    @given(st.integers(0, 10**6), st.sampled_from([np.float32(0), np.finfo(np.float32).eps]), st.booleans())
    def holds(seed, beside, smooth):
        rng = np.random.default_rng(seed)
        scene, camera = frames.scene(rng, decades=0.3), frames.camera(rng)
        weighted, weight, _ = js.reference.field(scene, camera, frames.samples)
        means = (weighted[weight > 0] / weight[weight > 0])[rng.integers((weight > 0).sum())]
        jump = np.float32(means) * (1 + beside)
        look = js.TransferFunction.from_points(
            np.array([0, jump, np.nextafter(jump, np.float32(2)) if smooth else jump, 1, 1], np.float32),
            [(1, 0, 0), (1, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 1)],
            [3.0, 3.0, 9.0, 2.0, 2.0],
        )
        require_right_or_unknown(dataclasses.replace(scene, transfer=look), camera, frames.settings, frames.plan())

    holds()


def test_frames_without_jumps_stay_certified(frames):
    rng = np.random.default_rng(3)
    scene, camera = frames.scene(rng, decades=0.3), frames.camera(rng)
    assert js.render(scene, camera, frames.settings, plan=frames.plan()).certified


@pytest.mark.parametrize("tolerance", [None, 0.01])
def test_a_jump_between_labels_is_unknown_of_few_pixels(frames, tolerance):
    rng = np.random.default_rng(4)
    scene, camera = frames.scene(rng, decades=0.3), frames.camera(rng)
    side = np.asarray(scene.particles.position)[:, 0] > 0
    particles = dataclasses.replace(scene.particles, quantity=array_of(np.where(side, 0.9, 0.1).astype(np.float32)))
    look = js.TransferFunction.from_points([0, 0.5, 0.5, 1, 1], [(1, 0, 0)] * 2 + [(0, 0, 1)] * 3, [3.0] * 5)
    scene = js.Scene(particles=particles, transfer=look)
    image = require_right_or_unknown(scene, camera, dataclasses.replace(frames.settings, tolerance=tolerance))
    assert np.isfinite(image.error_bound).mean() >= 0.95


@pytest.mark.parametrize("foot", [0.0, 0.5])
def test_labels_at_the_foot_of_a_wall_are_right_or_uncertified(frames, foot):
    rng = np.random.default_rng(5)
    scene, camera = frames.scene(rng, decades=0.3), frames.camera(rng)
    label = np.float32(0.7826308)
    particles = dataclasses.replace(scene.particles, quantity=array_of(np.full(frames.capacity, label)))
    values = np.array([0, label, label, label + np.float32(0.05), 1], np.float32)
    look = js.TransferFunction.from_points(values, [(1, 0, 0)] * 2 + [(0, 0, 1)] * 3, [1, 1, foot, 3e5, 3e5])
    require_right_or_unknown(js.Scene(particles=particles, transfer=look), camera, frames.settings, frames.plan(), 0)


LOOK = js.TransferFunction.from_points([0.0, 0.5, 1.0], [[1, 0.2, 0], [0, 1, 0.3], [0.1, 0, 1]], [4.0, 5.0, 6.0])


@examples(12)
@given(st.integers(0, 10**6), st.sampled_from(["plane", "ball"]))
def test_samples_on_a_face_are_right_or_uncertified(seed, face):
    """Of particles, a volume and points: a plane that all samples of one depth may lie on, or a ball's face."""
    rng = np.random.default_rng(seed)
    position, size = rng.uniform(-1, 1, (60, 3)).astype(np.float32), {"width": 12, "height": 10}
    camera = js.Camera.orthographic(rng.normal(size=3), (0, 0, 0), view_height=1.3, near=0.3, far=3.1, **size)
    place = sample_of(camera, 12, (rng.integers(10), rng.integers(12)), rng.integers(2, 8))
    forward, away = np.asarray(camera.axes, np.float64)[2], rng.normal(size=3)
    off = 0.4 * away / np.linalg.norm(away)
    clip = js.Plane(place, rng.choice([-1, 1]) * forward) & ~js.Sphere(place + (9 if face == "plane" else 1) * off, 0.4)
    x = np.linspace(0, 1, 5, dtype=np.float32)
    volume = js.Volume.from_array(x[:, None, None] * x[:, None] + 0 * x, (-1.0, -1.0, -1.0), 0.5)
    scene = js.Scene(
        particles=js.Particles.from_arrays(position, 0.9, rng.uniform(0, 1, 60).astype(np.float32)),
        transfer=LOOK,
        volume=volume,
        volume_transfer=LOOK,
        points=js.Points.from_arrays(position[:8], 0.3, (1, 1, 0.3), extinction=2.0),
        within=clip,
    )
    require_right_or_unknown(scene, camera, js.Settings(samples=12, integrator="samples"), informed=0)


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
def test_samples_of_volumes_at_a_jump_are_right_or_uncertified(dtype):
    certified = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        eye = rng.normal(size=3)
        camera = js.Camera.orthographic(eye, (0, 0, 0), rng.normal(size=3), 1.1, near=0.2, far=3.1, width=11, height=10)
        x = np.arange(6)
        ramp = (x[:, None, None] + 2 * x[:, None] + 4 * x).astype(dtype)
        lower = sample_of(camera, 9, (5, 5), 4) - 0.4 * rng.choice([[1.5, 2, 2], [2.25, 2.25, 2.25]])
        volume = js.Volume.from_array(ramp, lower, 0.4)
        jump = float(np.sum([1, 2, 4] * (sample_of(camera, 9, (5, 5), 4) - np.asarray(volume.lower, np.float64)) / 0.4))
        colors = [(1, 0, 0), (1, 0, 0), (0, 0, 1), (0, 0, 1)]
        look = js.TransferFunction.from_points([0, jump, jump, 35], colors, [2.0, 2.0, 6.0, 6.0])
        scene = js.Scene(volume=volume, volume_transfer=look)
        certified.append(bool(require_right_or_unknown(scene, camera, js.Settings(samples=9, integrator="samples")).certified))
    assert not all(certified)
