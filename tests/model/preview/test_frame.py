"""Framing: what is lit fills most of the picture, and stray particles do not rule it."""

import dataclasses

import numpy as np
import pytest
from examples import examples
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.model.preview.frame import (
    Direction,
    across_faces,
    bulk_of,
    bulk_of_period,
    fitted,
    flat_along,
    num_outside,
    snug_in_picture,
)
from jaxsph.model.preview.glimpse import exposure, glimpse

OBLIQUE, UP = (-0.45, -0.35, -1), (0, 1, 0)
LIT = 24 / 255


def scene_of(position, support):
    particles = js.Particles.from_arrays(position, support, np.zeros(len(position)), 1.0)
    return js.Scene(particles=particles, transfer=js.TransferFunction.from_points([-1, 1], np.ones((2, 3)), [1.0, 1.0]))


def block(size=1.0, sides=(1.0, 1.0, 1.0), count=2000):
    return size * np.random.default_rng(0).random((count, 3)) * sides


def filled(scene, camera):
    """Longest side of what is lit, over that of the picture."""
    seen = glimpse(scene, camera, 60)
    rows, columns = np.nonzero(seen.picture(exposure(seen)).max(-1) > LIT)
    return max((np.ptp(rows) + 1) / len(seen.v), (np.ptp(columns) + 1) / len(seen.u))


@examples(12)
@given(
    st.floats(-3, 4),
    st.tuples(*[st.sampled_from([0.2, 1.0])] * 3),
    st.sampled_from([None, 30.0, 90.0]),
    st.sampled_from([(64, 64), (96, 48), (48, 96)]),
)
def test_a_block_fills_the_picture_whatever_its_size_and_shape(decades, sides, fov, size):
    scene = scene_of(block(10.0**decades, sides), 0.12 * 10.0**decades)
    camera = fitted(scene, Direction.along(OBLIQUE, UP, fov, size))
    assert 0.75 <= filled(scene, camera) <= 1.0


@pytest.mark.parametrize("far", [10, 1000])
def test_stray_particles_do_not_rule_the_frame_and_are_counted(far):
    position = np.concatenate([block(), far * np.eye(3)])
    scene = scene_of(position, 0.12)
    camera = fitted(scene, Direction.along(OBLIQUE, UP, 30.0, (64, 64)))
    assert filled(scene, camera) >= 0.75 and num_outside(scene, camera) >= 2


def test_a_core_that_is_lost_in_its_halo_fills_a_third_of_the_picture():
    halo = np.random.default_rng(1).normal(size=(1500, 3))
    position = np.concatenate([halo, 1e-3 * halo[:300]])
    volume = np.repeat([1.0, 1e-9], [1500, 300])
    particles = js.Particles.from_arrays(position, np.repeat([0.3, 3e-4], [1500, 300]), np.zeros(1800), volume)
    scene = dataclasses.replace(scene_of(position, 0.3), particles=particles)
    camera = fitted(scene, Direction.along(OBLIQUE, UP, None, (64, 64)))
    assert 0.002 < float(camera.half_height) < 0.02 and num_outside(scene, camera) > 1000


@examples(20)
@given(st.tuples(*[st.floats(-2, 2)] * 3), st.tuples(*[st.sampled_from([0.1, 0.3, 1.0])] * 3))
def test_the_bulk_of_a_periodic_set_is_found_wherever_its_period_begins(moved, sides):
    """Along axes that it does not fill, it is as long, and holds nearly all; one that is whole is left where it is."""
    position, box = (block(sides=sides, count=500) + moved) % 1, np.ones(3)
    scene = scene_of(position, 0.02)
    scene = dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, box=js.Box(0 * box, box)))
    bulk, place, small = bulk_of_period(scene), across_faces(scene), np.array(sides) < 1
    assert (bulk is None) == (not small.any())
    if bulk is None:
        assert place is None
        return
    np.testing.assert_allclose((bulk.upper - bulk.lower)[~small], 1)
    np.testing.assert_allclose((bulk.upper - bulk.lower)[small], np.array(sides)[small] + 0.04, atol=0.02)
    assert (((position - bulk.lower) % 1 <= bulk.upper - bulk.lower) | ~small).all(1).mean() > 0.96
    if place is not None:
        centred = scene.particles.centered(place)
        lower, upper = centred.bounds()
        assert across_faces(dataclasses.replace(scene, particles=centred)) is None and (bulk.upper <= upper + 1).all()
        assert (np.abs(place - 0.5)[~small] < 1e-6).all() and (upper - lower == 1).all()


def test_the_bulk_of_amounts_leaves_out_what_is_light():
    position = np.concatenate([block(count=1000), block(count=1000) + 50])
    particles = js.Particles.from_arrays(position, 0.02, np.zeros(2000))
    light = np.zeros(particles.capacity)
    light[:2000] = np.repeat([1.0, 1e-3], 1000)
    lower, upper = bulk_of(particles, light).bounds()
    assert (lower > -0.05).all() and (upper < 1.05).all() and (upper - lower > 0.9).all()


def test_one_large_support_does_not_rule_the_frame():
    position, support = block(), np.full(2000, 0.12)
    support[0] = 50.0
    particles = js.Particles.from_arrays(position, support, np.zeros(2000), np.append(1e-9, np.ones(1999)))
    look = js.TransferFunction.from_points([-1, 1], np.ones((2, 3)), [1.0, 1.0])
    camera = fitted(js.Scene(particles=particles, transfer=look), Direction.along(OBLIQUE, UP, 30.0, (64, 64)))
    assert np.isfinite(np.asarray(camera.eye)).all() and float(camera.near) < float(camera.far)


def test_the_middle_that_is_asked_for_stays_in_the_middle():
    scene = scene_of(block(), 0.12)
    center = np.array([0.2, 0.5, 0.8])
    camera = fitted(scene, Direction.along(OBLIQUE, UP, 30.0, (64, 64)), center)
    view = np.asarray(camera.axes, np.float64) @ (center - camera.exact_eye())
    assert np.abs(view[:2]).max() < 1e-5 * view[2] and num_outside(scene, camera) < 20


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_particles_and_none_have_a_camera(count):
    scene = scene_of(np.random.default_rng(1).random((count, 3)), np.full(count, 0.3))
    camera = fitted(scene, Direction.along(OBLIQUE, UP, 30.0, (64, 64)))
    assert 0 < float(camera.near) < float(camera.far) and np.isfinite(np.asarray(camera.eye)).all()


def test_depths_are_those_of_what_is_in_the_picture():
    position = np.array([[0.0, 0, 0], [0, 0, 4], [90, 0, 30]])
    camera = js.Camera.look_at((0, 0, -2), (0, 0, 0), fov_degrees=30, near=1e-3, far=1.0, width=8, height=8)
    made = snug_in_picture(camera, scene_of(position, 0.5))
    assert float(made.near) == pytest.approx(1.5, rel=3e-3) and float(made.far) == pytest.approx(6.5, rel=3e-3)
    near, far = (float(end) for end in (snug_in_picture(camera, scene_of(position, 0.5), (1.8, 3.0)).near, made.far))
    assert near >= 1.79 and far <= 6.6


def test_an_upward_direction_along_the_line_of_sight_is_refused():
    with pytest.raises(ValueError, match="parallel to the line of sight"):
        Direction.along((0, 0, 1), (0, 0, 1), None, (8, 8))


def test_what_is_flat_but_for_a_slight_tilt_is_so_along_an_axis():
    disc = np.random.default_rng(1).normal(size=(100, 3)) * (3, 3, 0.1) @ ((1, 0, 0), (0, 1, 0.03), (0, -0.03, 1))
    np.testing.assert_array_equal(np.abs(flat_along(scene_of(disc, 1.0))), (0, 0, 1))
