"""The light integral: against closed forms, a plain fine midpoint sum, its own tighter tolerance and the limit of samples."""

import dataclasses
import itertools
import math

import formulas
import jax.numpy as jnp
import numpy as np
import pytest
from chords import Rays
from examples import examples
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.model.particles.kernels import KERNELS

PROJECTIONS = ["perspective", "orthographic"]
SEEDS = st.integers(0, 2**32 - 1)
FINE = 1 << 17  # midpoints of the plain sum


def view(projection="perspective", size=9, near=1.0, far=5.0, eye=(0, 0, -3.0)):
    """Along z; an odd size has a ray through the middle."""
    depths = {"width": size, "height": size, "near": near, "far": far}
    target = (eye[0], eye[1], eye[2] + 1)
    if projection == "perspective":
        return js.Camera.look_at(eye, target, fov_degrees=20.0, **depths)
    return js.Camera.orthographic(eye, target, view_height=1.0, **depths)


def chord(camera, center, radius):
    """Path length inside a sphere, between near and far."""
    return Rays.of(camera).within([center], [radius**2]).reshape(camera.height, camera.width)


def uniform(extinction, color=(1.0, 0.5, 0.25)):
    """A transfer function that looks the same everywhere."""
    return js.TransferFunction.from_points([0.0, 1.0], [color, color], [extinction, extinction])


def plainly(scene, camera, pixel, number=FINE):
    """Colour and alpha of one ray of particles by a midpoint sum, and a bound of its error: of intervals with a border inside."""
    rays, nth = Rays.of(camera), np.ravel_multi_index(pixel, (camera.height, camera.width))
    place, step = rays.start[nth], rays.direction[nth]
    near, far = float(camera.near), float(camera.far)
    width = (far - near) / number
    depth = near + (np.arange(number) + 0.5) * width
    valid, particles = np.asarray(scene.particles.valid), scene.particles
    columns = particles.position, particles.support, particles.quantity, particles.volume
    quantity, total = np.zeros(number), np.zeros(number)
    for x, h, q, volume in zip(*(np.asarray(column, np.float64)[valid] for column in columns), strict=True):
        r = np.sqrt(((place - x + depth[:, None] * step) ** 2).sum(-1)) / h
        weight = formulas.KERNELS[particles.kernel](r) * (volume / h**3)
        quantity, total = quantity + q * weight, total + weight
    inside = total > 0
    quantity = np.where(inside, quantity / np.where(inside, total, 1), 0)
    table = [np.asarray(part, np.float64) for part in (scene.transfer.values, scene.transfer.colors, scene.transfer.extinction)]
    color = np.stack([np.interp(quantity, table[0], channel) for channel in table[1].T], -1)
    path = width * np.linalg.norm(step)
    own = np.where(inside, np.interp(quantity, table[0], table[2]), 0) * path
    front = np.exp(-(np.cumsum(own) - own))
    light = (front * -np.expm1(-own)) @ color
    borders = np.abs(np.diff(inside.astype(int))).sum() + 2
    return light, -math.expm1(-own.sum()), borders * table[2].max() * path + 1e-9


def differences(image, truth):
    """Largest of a pixel over colours and transmittance."""
    return np.maximum(np.abs(image.color - truth.color).max(-1), np.abs(image.transmittance - truth.transmittance))


@pytest.mark.parametrize("projection", PROJECTIONS)
@pytest.mark.parametrize("kernel", KERNELS)
def test_a_ball_of_one_quantity_lets_through_what_its_chord_does(kernel, projection):
    center, radius, extinction = (0.0625, -0.03125, 0.25), 0.25, 7.0
    particles = js.Particles.from_arrays([center], radius, 0.3, kernel=kernel)
    camera = view(projection)
    image = js.reference.integral(js.Scene(particles=particles, transfer=uniform(extinction)), camera)
    alpha = -np.expm1(-extinction * chord(camera, center, radius))
    assert (alpha > 0).sum() > 9 and (alpha == 0).any()
    np.testing.assert_allclose(image.alpha, alpha, rtol=0, atol=1e-12)
    np.testing.assert_allclose(image.color, alpha[..., None] * [1, 0.5, 0.25], rtol=0, atol=1e-9)
    assert not image.certified and image.faults == 0


def test_near_and_far_cut_chords_off():
    particles, camera = js.Particles.from_arrays([(0, 0, 0.0)], 0.5, 0.3), view(near=2.75, far=3.125)
    image = js.reference.integral(js.Scene(particles=particles, transfer=uniform(2.0)), camera)
    np.testing.assert_allclose(image.alpha, -np.expm1(-2 * chord(camera, (0, 0, 0), 0.5)), rtol=0, atol=1e-12)


def test_depth_is_where_half_of_the_light_is_left():
    particles, camera = js.Particles.from_arrays([(0, 0, 0.0)], 0.5, 0.3), view("orthographic")
    image = js.reference.integral(js.Scene(particles=particles, transfer=uniform(2.0)), camera)
    assert image.depth[4, 4] == pytest.approx(2.5 + math.log(2) / 2, abs=1e-12)
    assert (np.isinf(image.depth) == (image.transmittance > 0.5)).all()


@pytest.mark.parametrize("kernel", KERNELS)
def test_two_balls_of_different_quantity_are_what_a_plain_sum_makes_of_them(kernel):
    position, support = [(0, 0.0625, -0.125), (0.03125, 0, 0.125)], [0.375, 0.25]
    particles = js.Particles.from_arrays(position, support, [0.1, 0.9], [1.0, 0.5], kernel)
    colors = [(1, 0, 0), (0, 1, 0), (0, 0, 1.0)]
    scene, camera = (
        js.Scene(particles=particles, transfer=js.TransferFunction.from_points([0, 0.4, 1], colors, [1, 5, 2])),
        view(),
    )
    for pixel in ((4, 4), (3, 5)):
        image = js.reference.integral(scene, camera, pixels=pixel)
        color, alpha, bound = plainly(scene, camera, pixel)
        assert alpha > 0.3
        assert np.abs(image.color - color).max() <= bound and abs(image.alpha - alpha) <= bound


@examples(6)
@given(SEEDS, st.sampled_from(sorted(KERNELS)), st.sampled_from(PROJECTIONS), st.sampled_from([0.2, 3.0]))
def test_random_particles_of_any_supports_are_what_a_plain_sum_makes_of_them(frames, seed, kernel, projection, distance):
    rng = np.random.default_rng(seed)
    scene, camera = frames.scene(rng, kernel, decades=1.5), frames.camera(rng, projection, distance)
    pixel = int(rng.integers(frames.height)), int(rng.integers(frames.width))
    image = js.reference.integral(scene, camera, pixels=pixel)
    color, alpha, bound = plainly(scene, camera, pixel)
    assert np.abs(image.color - color).max() <= bound and abs(image.alpha - alpha) <= bound


def ramp(values, colors, extinction, count=5):
    """A box from -1/2 to 1/2 whose quantity is the share of z."""
    values = [np.asarray(part, np.float64) for part in (values, colors, extinction)]
    lattice = np.broadcast_to(np.linspace(0, 1, count), (2, 2, count)).copy()
    volume = js.Volume.from_array(lattice, (-0.5, -0.5, -0.5), (1.0, 1.0, 1 / (count - 1)))
    return js.Scene(volume=volume, volume_transfer=js.TransferFunction.from_points(*values))


def test_a_jump_of_the_transfer_function_is_met_where_it_is():
    red, blue, jump = (1.0, 0, 0), (0, 0, 1.0), 0.40625
    scene = ramp([0, jump, jump, 1], [red, red, blue, blue], [1, 1, 6, 6])
    image = js.reference.integral(scene, view("orthographic", size=3))
    front, whole = math.exp(-jump), math.exp(-jump - 6 * (1 - jump))
    np.testing.assert_allclose(image.color, np.broadcast_to([1 - front, 0, front - whole], (3, 3, 3)), rtol=0, atol=1e-9)
    np.testing.assert_allclose(image.transmittance, whole, rtol=0, atol=1e-9)


def test_a_band_narrower_than_what_lies_between_nodes_is_not_overlooked():
    white, low, high = (1.0, 1.0, 1.0), 0.5 - 2.0**-13, 0.5 + 2.0**-13
    scene = ramp([0, low, low, high, high, 1], [white] * 6, [0, 0, 4096, 4096, 0, 0], count=2)
    image = js.reference.integral(scene, view("orthographic", size=3))
    np.testing.assert_allclose(image.alpha, -math.expm1(-1), rtol=0, atol=1e-9)


def test_a_slab_of_linear_quantity_has_its_closed_form():
    """Colour u and extinction 3: 3 u exp(-3 u) over [0, 1]."""
    scene = ramp([0, 1], [(0, 0, 0), (1, 1, 1)], [3, 3])
    image = js.reference.integral(scene, view("orthographic", size=3))
    np.testing.assert_allclose(image.color, (1 - 4 * math.exp(-3)) / 3, rtol=0, atol=1e-9)
    np.testing.assert_allclose(image.alpha, -math.expm1(-3), rtol=0, atol=1e-12)


def test_a_wall_is_met_in_full():
    image = js.reference.integral(ramp([0, 1], [(0.25, 0.5, 1)] * 2, [1e6, 1e6]), view("orthographic", size=1))
    np.testing.assert_allclose(image.color[0, 0], [0.25, 0.5, 1], rtol=0, atol=1e-7)
    assert image.transmittance[0, 0] == 0


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_a_gaussian_point_lets_through_the_integral_along_its_chord(projection):
    radius, extinction, center = 0.25, 7.0, (0.03125, -0.0625, 0.125)
    points = js.Points.from_arrays([center], radius, (1.0, 0, 0), extinction)
    camera = view(projection)
    half = chord(camera, center, radius) / (2 * radius)
    root = math.sqrt(4.5)
    along = math.sqrt(math.pi) / root * np.vectorize(math.erf)(root * half)
    alpha = -np.expm1(-extinction * radius * np.exp(-4.5 * (1 - half**2)) * along * (half > 0))
    image = js.reference.integral(js.Scene(points=points), camera)
    np.testing.assert_allclose(image.alpha, alpha, rtol=0, atol=1e-9)
    np.testing.assert_allclose(image.color[..., 0], alpha, rtol=0, atol=1e-9)


def lobes(offset, attributes):
    return attributes["strength"] * (1 + offset[0] * offset[1]) * jnp.exp(-jnp.sqrt(offset[2] ** 2 + 0.1))


@pytest.mark.parametrize("spread", ["chords", "feet", "centres"])
@pytest.mark.parametrize("profile", ["ball", "gaussian", [1.0, 0.25, 0.5, 0.0], lobes])
def test_points_hide_what_the_oracle_says_however_they_are_spread(profile, spread):
    rng = np.random.default_rng(3)
    attributes = {"strength": rng.uniform(0.5, 1, 6)}
    position, radius = rng.uniform(-0.25, 0.25, (6, 3)), rng.uniform(0.125, 0.25, 6)
    points = js.Points.from_arrays(
        position, radius, rng.uniform(0, 1, (6, 3)), 3.0, profile, attributes=attributes, spread=spread
    )
    scene, camera = js.Scene(points=points), view()
    truth = js.reference.render(scene, camera, js.Settings(samples=1))
    image = js.reference.integral(scene, camera)
    assert image.alpha.max() > 0.3
    np.testing.assert_allclose(image.transmittance, truth.transmittance, rtol=0, atol=1e-7)


def everything(frames, rng, mix="extinction"):
    """Particles, a volume and points in one place."""
    scene = frames.scene(rng)
    volume = js.Volume.from_array(rng.uniform(0, 1, (4, 5, 3)), (-0.75, -0.5, -0.5), (0.5, 0.25, 0.5))
    points = js.Points.from_arrays(rng.uniform(-1, 1, (9, 3)), rng.uniform(0.1, 0.5, 9), rng.uniform(0, 1, (9, 3)), 3.0)
    return dataclasses.replace(scene, volume=volume, volume_transfer=scene.transfer, points=points, mix=mix)


@pytest.mark.parametrize("mix", ["extinction", "opacity"])
@pytest.mark.parametrize("projection", PROJECTIONS)
def test_it_is_what_ever_more_samples_tend_to(frames, projection, mix):
    rng = np.random.default_rng(7)
    scene, camera = everything(frames, rng, mix), frames.camera(rng, projection)
    truth = js.reference.integral(scene, camera, every=4)
    errors = [
        differences(js.reference.render(scene, camera, js.Settings(samples=samples), every=4), truth).mean()
        for samples in (32, 256, 2048)
    ]
    assert errors[1] < errors[0] / 4 and errors[2] < errors[1] / 4 and errors[2] < 1e-3


def require_held(errors, bounds):
    """An estimate: one ray in a thousand may be beyond it, and two by chance in so few."""
    beyond = np.concatenate([np.ravel(error > bound) for error, bound in zip(errors, bounds, strict=True)])
    assert beyond.size >= 400 and beyond.sum() <= 1 + beyond.size / 1000


def looks(count):
    """A generator, a kernel and a projection for each of `count` frames."""
    pairs = itertools.cycle(itertools.product(sorted(KERNELS), PROJECTIONS))
    return ((np.random.default_rng(seed), *pair) for seed, pair in zip(range(count), pairs, strict=False))


def test_its_own_error_holds_what_a_tighter_tolerance_changes(frames):
    errors, bounds = [], []
    for rng, kernel, projection in looks(25):
        scene, camera = everything(frames, rng), frames.camera(rng, projection, float(rng.choice([0.2, 1.5, 3.0])))
        scene = dataclasses.replace(scene, particles=frames.scene(rng, kernel).particles)
        loose, tight = (js.reference.integral(scene, camera, every=4, tolerance=tolerance) for tolerance in (1e-5, 1e-9))
        assert (loose.error_bound <= 1e-5 + 1e-12).all() and (tight.error_bound <= 1e-9 + 1e-12).all()
        errors.append(differences(loose, tight))
        bounds.append(loose.error_bound + tight.error_bound)
    require_held(errors, bounds)


def test_its_own_error_holds_for_walls_bands_and_jumps_too(frames, adversary):
    errors, bounds = [], []
    for rng, kernel, projection in looks(50):
        scene, camera = adversary.scene(rng, kernel, np.float32), adversary.camera(rng, projection, np.float32)
        loose, tight = (js.reference.integral(scene, camera, every=6, tolerance=tolerance) for tolerance in (1e-4, 1e-7))
        assert np.isfinite(tight.color).all() and (tight.error_bound <= 1e-7 + 1e-12).all()
        errors.append(differences(loose, tight))
        bounds.append(loose.error_bound + tight.error_bound)
    require_held(errors, bounds)


def test_pixels_rows_and_the_whole_image_are_the_same_light(frames):
    rng = np.random.default_rng(2)
    scene, camera = frames.scene(rng), frames.camera(rng)
    told = []
    whole = js.reference.integral(scene, camera, progress=lambda done, total: told.append((done, total)))
    assert whole.shape == (frames.height, frames.width) and whole.color.dtype == np.float64
    assert told[-1] == (frames.height * frames.width,) * 2 and len(told) > 1
    rows, columns = rng.integers(frames.height, size=(5, 2)), rng.integers(frames.width, size=(5, 2))
    some = js.reference.integral(scene, camera, pixels=(rows, columns))
    assert some.color.shape == (5, 2, 3) and some.depth.shape == (5, 2) and some.stats["rays"] == 10
    np.testing.assert_allclose(some.color, whole.color[rows, columns], rtol=0, atol=1e-9)
    few = js.reference.integral(scene, camera, every=3)
    np.testing.assert_allclose(few.color, whole.color[1::3, 1::3], rtol=0, atol=1e-9)
    none = js.reference.integral(scene, camera, pixels=([], []))
    assert none.color.shape == (0, 3)


def test_where_nothing_is_nothing_is_seen():
    camera = view()
    empty = js.Particles.from_arrays(np.zeros((0, 3)), 1.0, 0.0)
    weightless = js.Particles.from_arrays([(0, 0, 0.0)], 1.0, 0.0, volume=0.0)
    aside = js.Particles.from_arrays([(0, 0, -9.0), (50, 0, 0)], 1.0, 0.0)
    for particles in (empty, weightless, aside):
        image = js.reference.integral(js.Scene(particles=particles, transfer=uniform(1.0)), camera)
        assert not image.color.any() and (image.transmittance == 1).all() and not image.error_bound.any()
        assert np.isinf(image.depth).all()


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"pixels": ([0], [9])}, "columns from 0 to 8, got 9"),
        ({"pixels": ([-1], [0])}, "rows from 0 to 8, got -1"),
        ({"pixels": ([0.5], [0])}, "must be integers"),
        ({"pixels": ([0, 1], [0])}, "one shape"),
        ({"pixels": np.zeros((3, 2), int)}, "must be a pair"),
        ({"pixels": ([0], [0]), "every": 2}, "goes with the whole image"),
        ({"every": 0}, "`every` must be at least 1"),
        ({"tolerance": 0}, "`tolerance` must be at least 1e-12"),
        ({"tolerance": math.nan}, "`tolerance` must be at least 1e-12"),
    ],
)
def test_what_cannot_be_asked_is_refused_with_a_reason(options, says):
    scene = js.Scene(particles=js.Particles.from_arrays([(0, 0, 0.0)], 0.5, 0.3), transfer=uniform(1.0))
    with pytest.raises(ValueError, match=says):
        js.reference.integral(scene, view(), **options)
