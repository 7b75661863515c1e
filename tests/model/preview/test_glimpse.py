"""A coarse picture is an unbiased likeness of the reference, and is exposed such that enough of it is seen."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.model.preview import glimpse as preview
from jaxsph.model.preview.glimpse import ALPHA, BRIGHT, LEAST_LIT, SHOWS, Glimpse, exposure, glimpse, levelled

RAYS = 16


def ball(count=4000, second=False):
    rng = np.random.default_rng(0)
    position = rng.normal(size=(count, 3))
    position *= (rng.random((count, 1)) ** (1 / 3)) / np.linalg.norm(position, axis=1, keepdims=True)
    quantity = position[:, 0]
    return js.Particles.from_arrays(position, 0.25, (quantity, position[:, 1]) if second else quantity, 4.19 / count)


COLORS = [[1, 0.2, 0], [0.1, 0.4, 1]]


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("second", [False, True])
@pytest.mark.parametrize("clipped", [False, True])
def test_its_mean_colour_is_that_of_the_reference(projection, second, clipped):
    particles = ball(second=second)
    own = {"extinction_values": [-1.0, 1.0]} if second else {}
    look = js.TransferFunction.from_points([-1, 1], COLORS, [0.5, 2.0], **own)
    scene = js.Scene(particles=particles, transfer=look, within=js.Sphere((0.2, 0, 0), 0.7) if clipped else None)
    if projection == "perspective":
        camera = js.Camera.look_at((0.5, 0.4, 3), (0, 0, 0), width=RAYS, height=RAYS, near=1.5, far=4.6)
    else:
        camera = js.Camera.orthographic((0.5, 0.4, 3), (0, 0, 0), view_height=2.6, width=RAYS, height=RAYS, near=1.5, far=4.6)
    seen = glimpse(scene, camera, rays=RAYS, steps=64)
    truth = js.reference.render(scene, camera, js.Settings(samples=64))
    assert np.abs(seen.picture() - np.asarray(truth.color)).mean() < 0.02
    assert np.abs(seen.picture() - np.asarray(truth.color)).max() < 0.35
    assert abs(seen.weights().sum(2).mean() - np.asarray(truth.alpha).mean()) < 0.01


def test_its_volumes_are_those_of_the_reference():
    values = np.random.default_rng(0).random((6, 5, 4)).astype(np.float32)
    volume = js.Volume.from_array(values, (-1, -1, -1), 0.5)
    scene = js.Scene(volume=volume, volume_transfer=js.TransferFunction.from_points([0, 1], COLORS, [0.2, 1.5]))
    camera = js.Camera.framing(volume, width=RAYS, height=RAYS)
    seen = glimpse(scene, camera, rays=RAYS, steps=64)
    truth = js.reference.render(scene, camera, js.Settings(samples=64))
    assert np.abs(seen.picture() - np.asarray(truth.color)).mean() < 0.02


def test_scaling_extinction_is_scaling_the_transfer_function():
    particles = ball(500)
    looks = [js.TransferFunction.from_points([-1, 1], COLORS, [0.5 * f, 2.0 * f]) for f in (1, 3)]
    camera = js.Camera.framing(particles, width=RAYS, height=RAYS)
    one, three = (glimpse(js.Scene(particles=particles, transfer=look), camera, RAYS) for look in looks)
    np.testing.assert_allclose(one.picture(3), three.picture(), atol=1e-9)
    assert (one.optical_depth * 3 == pytest.approx(three.optical_depth, rel=1e-6)) and one.weights(3).sum(2).max() <= 1


def test_a_camera_inside_of_the_particles_and_one_that_sees_nothing_are_fine():
    particles = ball(500)
    scene = js.Scene(particles=particles, transfer=js.TransferFunction.from_points([-1, 1], COLORS, [0.5, 2.0]))
    inside = js.Camera.look_at((0, 0, 0), (1, 0, 0), width=24, height=12, near=0.01, far=2)
    away = js.Camera.look_at((9, 0, 0), (99, 0, 0), width=24, height=12, near=0.01, far=2)
    seen = glimpse(scene, inside, RAYS)
    assert seen.optical_depth.shape == (8, 16) and (seen.optical_depth > 0).all() and np.isfinite(seen.picture()).all()
    assert not glimpse(scene, away, RAYS).optical_depth.any()


def test_nothing_is_dark():
    empty = js.Particles.from_arrays(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    scene = js.Scene(particles=empty, transfer=js.TransferFunction.from_points([-1, 1], COLORS, [0.5, 2.0]))
    assert not glimpse(scene, js.Camera.framing(empty, width=8, height=8), RAYS).picture().any()


SIDE, STEPS = 20, 4


def seen(depth, color=1.0):
    """A picture of these optical depths."""
    depth = np.broadcast_to(depth, (SIDE, SIDE)).astype(np.float64)
    extinction = np.repeat(depth[..., None] / STEPS, STEPS, 2)
    places = np.linspace(-1, 1, SIDE)
    ones = np.ones((SIDE, SIDE, STEPS))
    return Glimpse(places, places, ones, np.ones((SIDE, SIDE)), extinction, color * np.ones((*ones.shape, 3)))


@given(st.floats(-12, 12))
def test_a_plain_sheet_of_any_extinction_is_nearly_opaque(decades):
    picture = seen(10.0**decades)
    assert np.allclose(picture.weights(exposure(picture)).sum(2), ALPHA)


def test_a_bright_core_does_not_leave_the_rest_dark():
    depth = np.full((SIDE, SIDE), 0.01)
    depth[:2, :4] = 3.0
    picture = seen(depth)
    lit = picture.picture(exposure(picture)).max(-1) > 24 / 255
    assert lit.mean() >= LEAST_LIT


@pytest.mark.parametrize("power", [0.1, 1, 9])
def test_colours_of_a_picture_reach_both_ends_of_a_map_and_half_of_it_stays_below_the_middle(power):
    position = np.random.default_rng(0).random((500, 3))
    gray = js.TransferFunction.from_points(np.linspace(0, 1, 16), np.linspace(0, 1, 16)[:, None].repeat(3, 1), np.full(16, 3.0))
    scene = js.Scene(particles=js.Particles.from_arrays(position, 0.2, position[:, 0] ** power), transfer=gray)
    camera = js.Camera.fitted(scene, width=32, height=32)
    made = glimpse(levelled(scene, camera), camera)
    alpha = made.weights().sum(2)
    places = made.picture()[..., 0][alpha > SHOWS] / alpha[alpha > SHOWS]
    reached = max(np.percentile(places, BRIGHT) / preview.BRIGHT_PLACE, np.median(places) / preview.MIDDLE_PLACE)
    assert 0.95 < reached <= 1 + 4 * np.finfo(np.float32).eps
    assert np.percentile(places, 100 - BRIGHT) <= preview.DARK_PLACE + 4 * np.finfo(np.float32).eps
    np.testing.assert_array_equal(alpha, glimpse(scene, camera).weights().sum(2))


@pytest.mark.parametrize("low", [1.0, -100.0])
def test_a_map_of_two_colours_spans_what_is_seen_unless_it_is_of_both_signs(low):
    position = np.random.default_rng(0).random((500, 3))
    quantity = np.where(position[:, 0] < 0.01, 100.0, 5 + 10 * position[:, 0])  # a few are hot, and hardly seen
    map_of_two = js.scenes.colormap("coolwarm", 16)
    look = js.TransferFunction.from_points(np.linspace(low, 100, 16), map_of_two, np.full(16, 3.0))
    scene = js.Scene(particles=js.Particles.from_arrays(position, 0.2, quantity), transfer=look)
    made = levelled(scene, js.Camera.fitted(scene, width=32, height=32)).transfer
    first, last = (float(made.values[end]) for end in (0, -1))
    assert (first, last) == (low, 100) if low < 0 else 0 < first < 7 < 13 < last < 20
    np.testing.assert_array_equal(made.colors, look.colors)


def test_where_nothing_is_met_nothing_changes():
    assert exposure(seen(0.0)) == 1.0


def test_a_black_colour_map_ends_the_search():
    assert np.isfinite(exposure(seen(1.0, 0.0)))
