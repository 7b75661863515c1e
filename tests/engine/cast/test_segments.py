"""Segments show what lies between samples: borders of supports wherever they are, jumps, and colours that change on the way."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chords import Rays, light
from derivatives import QUICKLY
from examples import examples
from hypothesis import given, strategies as st
from images import seen_from

import jaxsph as js
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.planning.plan import Plan
from jaxsph.model.particles import kernels

WIDTH, HEIGHT, SAMPLES, CAPACITY = 13, 10, 32, 8
SETTINGS = js.Settings(samples=SAMPLES, integrator="segments")
PLAN = Plan(WIDTH, HEIGHT, SAMPLES, CAPACITY, 4, 1, ListPlan(2, 2, 128, 512), CastPlan(16, 4, 48), 0, integrator="segments")
CLOSE = 1e-5  # of alpha
ROUNDING = 64 * np.finfo(np.float32).eps  # of the square of what positions reach to: what grazes a support meets it or not
FACE = 32 * np.finfo(np.float32).eps  # length units that a face may be off by, so that rays nearly along it meet it elsewhere
EXTINCTION = 2.0
GREY = js.TransferFunction.from_points([0.0, 0.5, 1.0], np.full((3, 3), 0.5), [EXTINCTION] * 3)
PROJECTIONS = "perspective", "orthographic"


def camera(projection="perspective", eye=(1.2, 0.9, -2.1), near=0.9, far=4.5, **size):
    return seen_from(eye, projection, 55.0, 2.2, near=near, far=far, **{"width": WIDTH, "height": HEIGHT} | size)


def balls(position, support, quantity=0.5, volume=1.0, kernel="poly6"):
    position = np.atleast_2d(np.asarray(position, np.float32))
    return js.Particles.from_arrays(position, support, quantity, volume, kernel, capacity=CAPACITY)


@functools.partial(jax.jit, static_argnames="plan", compiler_options=QUICKLY)
def shown(scene, view, plan=PLAN):
    """By the one plan: one program for all scenes of the same parts."""
    return js.render(scene, view, dataclasses.replace(SETTINGS, samples=plan.samples), plan=plan)


def check_alpha(image, rays, position, support, extinction=EXTINCTION):
    """That alpha is that of the path length in a union of balls, whose squares are off by roundings."""
    assert int(image.faults) == 0
    position, support = np.atleast_2d(np.asarray(position, np.float32)), np.atleast_1d(np.float32(support)).astype(float)
    reach = np.linalg.norm(position - rays.start[0], axis=1).max() + support.max()
    least, most = (
        1 - np.exp(-extinction * rays.within(position, np.maximum(support**2 + sign * ROUNDING * reach * support, 0)))
        for sign in (-1, 1)
    )
    alpha = np.asarray(image.alpha, float).ravel()
    assert (alpha >= least - CLOSE).all() and (alpha <= most + CLOSE).all(), np.maximum(least - alpha, alpha - most).max()


places = st.tuples(*[st.floats(-0.9, 0.9)] * 3)
sizes = st.floats(0.02, 1.5)


@pytest.mark.parametrize("projection", PROJECTIONS)
@given(place=places, size=sizes)
def test_a_ball_of_one_quantity_has_the_alpha_of_its_chords(projection, place, size):
    """Wherever it lies between samples; some are shorter than an interval, some are cut by near or far."""
    view = camera(projection)
    image = shown(js.Scene(balls(place, size), GREY), view)
    check_alpha(image, Rays.of(view), place, size)
    np.testing.assert_allclose(image.color, 0.5 * np.asarray(image.alpha)[..., None] * np.ones(3), atol=1e-6)


@given(place=places, size=st.floats(0.3, 1.5), near=st.floats(0.01, 0.3), depth=st.floats(0.2, 2.0))
def test_a_ball_around_the_camera_is_cut_by_near_and_far(place, size, near, depth):
    view = camera(eye=(0.1, 0.2, -0.3), near=near, far=near + depth)
    check_alpha(shown(js.Scene(balls(place, size), GREY), view), Rays.of(view), place, size)


@given(seed=st.integers(0, 2**32 - 1))
def test_balls_of_several_quantities_and_one_extinction_have_the_alpha_of_their_union(seed):
    """Of all sizes. Two of them: what they cover of a slab is at most two pieces, which its pivot splits or which are one."""
    rng = np.random.default_rng(seed)
    position, support = (
        rng.uniform(-0.8, 0.8, (2, 3)).astype(np.float32),
        (1.2 * 10 ** -rng.uniform(0, 1.5, 2)).astype(np.float32),
    )
    particles = balls(position, support, rng.uniform(0, 1, 2).astype(np.float32), rng.uniform(0.1, 1, 2).astype(np.float32))
    view, looks = camera(), dataclasses.replace(GREY, colors=np.float32([[1.0, 0, 0], [0.5, 0, 0.5], [0, 0, 1]]))
    image = shown(js.Scene(particles, looks), view)
    if two_pieces_at_most(Rays.of(view), position, support, view):
        check_alpha(image, Rays.of(view), position, support)


@jax.jit
def depths_of_samples(view):
    return view.depth(jnp.arange(SAMPLES) + 0.5, SAMPLES)


def two_pieces_at_most(rays, position, support, view):
    """Whether there is no gap that no sample lies in."""
    begin, end = rays.chords(position, support.astype(float) ** 2)
    depth = np.asarray(depths_of_samples(view))
    apart = (begin.max(1) > end.min(1)) & (end > begin).all(1)
    inner = [np.searchsorted(depth, ends) for ends in (end.min(1), begin.max(1))]
    return not (apart & (inner[0] == inner[1])).any()


FIRST = "poly6", "cubic_spline", "wendland_c2"


@pytest.mark.parametrize(
    "kernel", [name if name in FIRST else pytest.param(name, marks=pytest.mark.slow) for name in kernels.KERNELS]
)
def test_an_image_is_the_integral_of_its_light(kernel):
    """Supports of all sizes, and colours that change from one to the next: but for where that is within a segment or two.

    Where balls of two quantities overlap the colour turns over a length that shrinks with the kernel's width: the higher
    Wendland kernels and the quintic spline are off by half as much again at the same samples.
    """
    particles, view = several(np.random.default_rng(0), kernel), camera()
    most = 6e-2 if kernel in FIRST else 9e-2
    color, transmittance = off(shown(js.Scene(particles, RAINBOW), view), view, particles, RAINBOW)
    assert max(color.max(), transmittance.max()) < most and color.mean() < 2e-3 and transmittance.mean() < 1e-3


def off(image, view, particles, looks):
    """Errors of colours and transmittance."""
    return off_from(light(Rays.of(view), particles, looks), image)


def off_from(exact, image):
    """The same from given ones."""
    color, transmittance = exact
    assert 1 - transmittance.min() > 0.5
    return np.abs(np.asarray(image.color).reshape(-1, 3) - color), np.abs(np.asarray(image.transmittance).ravel() - transmittance)


RAINBOW = js.TransferFunction.from_points([0.1, 0.5, 0.9], [[1, 0.1, 0], [0.1, 1, 0.2], [0, 0.1, 1]], [0.3, 2.0, 1.0])


def several(rng, kernel="poly6", dtype=np.float32):
    """Particles of all sizes."""
    position, support = rng.uniform(-0.8, 0.8, (CAPACITY, 3)), 1.2 * 10 ** -rng.uniform(0, 0.7, CAPACITY)
    given = position, support, rng.uniform(0, 1, CAPACITY), rng.uniform(0.1, 1, CAPACITY)
    return js.Particles.from_arrays(*(part.astype(dtype) for part in given), kernel=kernel, capacity=CAPACITY)


@pytest.mark.slow
@pytest.mark.parametrize("projection", PROJECTIONS)
def test_the_error_of_what_is_smooth_falls_with_the_square_of_the_length_of_segments(projection, x64):
    """Supports around all that is seen, and supports of all sizes: in the mean both do, the latter from 64 to 512 samples."""
    view = camera(projection, near=1.5, far=3.7)
    looks = jax.tree.map(lambda leaf: leaf.astype(float), RAINBOW)
    big = dataclasses.replace(several(np.random.default_rng(5), dtype=np.float64), support=jnp.full(CAPACITY, 5.0))
    assert (Rays.of(view).within(big.position, 25.0) == (view.far - view.near) * Rays.of(view).slant).all()
    big = dataclasses.replace(big, quantity=jnp.where(jnp.arange(CAPACITY) % 2, 6.0, -5.0))
    for particles, each, overall in ((big, 3.6, 3.9), (several(np.random.default_rng(0), dtype=np.float64), 2.0, 3.4)):
        errors, exact = [], light(Rays.of(view), particles, looks, 256)
        for samples in (64, 128, 256, 512):
            plan = dataclasses.replace(PLAN, samples=samples, lists=ListPlan(2, 2, 128, 1024))
            image = shown(js.Scene(particles, looks), view, plan)
            assert int(image.faults) == 0
            errors.append(max(error.mean() for error in off_from(exact, image)))
        fewer = np.divide(errors[:-1], errors[1:])
        assert (fewer > each).all() and np.prod(fewer) > overall**3, errors


def test_a_volume_whose_look_jumps_is_integrated_exactly():
    """A quantity that is linear along depth, in a slab whose faces lie between samples."""
    points, lower, spacing, jump = 5, -0.61, 0.3, 0.37
    values = np.broadcast_to(np.linspace(0, 1, points, dtype=np.float32), (2, 2, points))
    volume = js.Volume.from_array(values, (-4, -4, lower), (8, 8, spacing))
    looks = js.TransferFunction.from_points([0.1, jump, jump, 0.9], np.full((4, 3), 0.5), [0.0, 0.5, 2.0, 1.0])
    view = camera(eye=(0.0, 0.0, -3.0), near=1.13, far=5.3)
    view = dataclasses.replace(view, axes=np.eye(3, dtype=np.float32))
    image = shown(js.Scene(volume=volume, volume_transfer=looks), view)
    mean = (jump - 0.1) * 0.25 + (0.9 - jump) * 1.5 + 0.1 * 1.0
    rays = Rays.of(view)
    through = np.exp(-mean * spacing * (points - 1) * rays.slant)
    np.testing.assert_allclose(np.asarray(image.transmittance).ravel(), through, atol=CLOSE)


@given(seed=st.integers(0, 2**32 - 1))
def test_a_box_of_one_quantity_has_the_alpha_of_what_rays_meet_of_it(seed):
    """However it is placed, and rays cut off its corners."""
    rng = np.random.default_rng(seed)
    lower, size = rng.uniform(-1, 0.2, 3).astype(np.float32), rng.uniform(0.05, 1.5, 3).astype(np.float32)
    volume = js.Volume.from_array(np.full((2, 2, 5), 0.5, np.float32), lower, size / np.float32([1, 1, 4]))
    looks = js.TransferFunction.from_points(np.linspace(0, 1, 4), np.full((4, 3), 0.5), [EXTINCTION] * 4)
    view = camera()
    image, rays = shown(js.Scene(volume=volume, volume_transfer=looks), view), Rays.of(view)
    least, most = (1 - np.exp(-EXTINCTION * rays.in_box(lower - off, lower + size + off)) for off in (-FACE, FACE))
    alpha = np.asarray(image.alpha, float).ravel()
    assert (alpha >= least - CLOSE).all() and (alpha <= most + CLOSE).all(), np.maximum(least - alpha, alpha - most).max()


def test_a_jump_of_the_transfer_function_is_seen_between_samples():
    """Hardly any sample is where it lies: the error is that of what is smooth."""
    particles, view = several(np.random.default_rng(3)), camera()
    looks = js.TransferFunction.from_points([0.5, 0.5, 1.0], [[1, 0, 0], [0, 0, 1], [0, 0, 1]], [0.2, 3.0, 3.0])
    color, transmittance = off(shown(js.Scene(particles, looks), view), view, particles, looks)
    assert color.mean() < 4e-3 and transmittance.mean() < 4e-3


CLOUD = np.random.default_rng(4).uniform(-0.8, 0.8, (6, 3)).astype(np.float32)


def points(profile="ball", extinction=1.5, radius=0.4, color=(0.5, 0.5, 0.5)):
    return js.Points.from_arrays(CLOUD, radius, color, extinction, profile=profile)


def test_thicknesses_of_points_particles_and_volumes_add_up():
    """Balls of points, balls of particles and a box that is larger than the view."""
    position, support = CLOUD[:3] * np.float32(0.5), np.float32([0.8, 0.5, 0.3])
    box = js.Volume.from_array(np.full((2, 2, 2), 0.5, np.float32), (-9, -9, -9), 18.0)
    scene = js.Scene(balls(position, support), GREY, volume=box, volume_transfer=GREY, points=points())
    view = camera()
    image, rays = shown(scene, view, dataclasses.replace(PLAN, num_particles=2 * CAPACITY)), Rays.of(view)
    assert int(image.faults) == 0
    begin, end = rays.chords(CLOUD, np.float32(0.4).astype(float) ** 2)
    of_particles = rays.within(position, support.astype(float) ** 2)
    of_box = (rays.far - rays.near) * rays.slant
    thickness = 1.5 * (end - begin).sum(1) * rays.slant + EXTINCTION * (of_particles + of_box)
    np.testing.assert_allclose(np.asarray(image.transmittance).ravel(), np.exp(-thickness), atol=CLOSE)
    np.testing.assert_allclose(image.color, 0.5 * np.asarray(image.alpha)[..., None] * np.ones(3), atol=1e-6)


@examples(20)
@given(seed=st.integers(0, 2**32 - 1))
def test_colours_never_exceed_alpha_and_what_has_one_colour_shows_it(seed):
    rng = np.random.default_rng(seed)
    view, particles = camera(near=rng.uniform(0.1, 1.5)), several(rng)
    extinction = rng.choice([0, 0.1, 5, 1e4], 3) * rng.uniform(0, 1, 3)
    colors = rng.uniform(0, 1, (3, 3))
    for same in (False, True):
        given = colors[:1] * np.ones((3, 1)) if same else colors
        looks = js.TransferFunction.from_points(
            *(np.float32(part) for part in (np.sort(rng.uniform(0, 1, 3)), given, extinction))
        )
        image = shown(js.Scene(particles, looks), view)
        color, alpha = np.asarray(image.color), np.asarray(image.alpha)[..., None]
        assert (color >= 0).all() and (color <= alpha + 2e-6).all() and (alpha <= 1).all()
        if same:
            np.testing.assert_allclose(color, alpha * np.asarray(looks.colors)[0], atol=4e-6)


@pytest.mark.parametrize("why", ["no particle", "no volume", "no extinction", "behind the camera"])
def test_where_there_is_nothing_nothing_is_shown(why):
    particles, looks = several(np.random.default_rng(7)), RAINBOW
    if why == "no particle":
        particles = dataclasses.replace(particles, valid=np.zeros(CAPACITY, bool))
    if why == "no volume":
        particles = dataclasses.replace(particles, volume=np.zeros(CAPACITY, np.float32))
    if why == "no extinction":
        looks = dataclasses.replace(looks, extinction=np.zeros(3, np.float32))
    if why == "behind the camera":
        particles = dataclasses.replace(particles, position=np.asarray(particles.position) + np.float32([2.4, 1.8, -8.0]))
    image = shown(js.Scene(particles, looks), camera())
    assert int(image.faults) == 0
    assert not np.asarray(image.color).any() and (np.asarray(image.transmittance) == 1).all()
