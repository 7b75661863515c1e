"""The oracle's points: against closed forms of single points, of pairs, and of a point in a medium."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
from chords import Rays

import jaxsph as js

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)
RADIUS, EXTINCTION = 0.25, 7.0
CUBE = np.full((2, 2, 2), 0.5)


def view(projection="perspective", size=9, near=1.0, far=5.0):
    """From (0, 0, -3) along z; an odd size has a ray through the middle."""
    depths = {"width": size, "height": size, "near": near, "far": far}
    if projection == "perspective":
        return js.Camera.look_at((0, 0, -3.0), (0, 0, 0.0), fov_degrees=20.0, **depths)
    return js.Camera.orthographic((0, 0, -3.0), (0, 0, 0.0), view_height=1.0, **depths)


def impact(camera, center):
    """Distance from a centre to every ray, in float64."""
    rays = Rays.of(camera)
    away = np.linalg.norm(np.cross(center - rays.start, rays.direction), axis=1) / rays.slant
    return away.reshape(camera.height, camera.width)


def whole(b, radius=RADIUS, extinction=EXTINCTION, profile="gaussian"):
    """Optical thickness of a whole point at a distance b of the ray, in closed form."""
    half = np.sqrt(np.maximum(1 - (b / radius) ** 2, 0))
    if profile == "ball":
        return extinction * radius * 2 * half
    root = math.sqrt(4.5)
    gauss = math.sqrt(math.pi) / root * np.vectorize(math.erf)(root * half)
    return extinction * radius * np.exp(-4.5 * (b / radius) ** 2) * gauss


def points(position, color=RED, **options):
    given = {"radius": RADIUS, "extinction": EXTINCTION} | options
    return js.Points.from_arrays(np.atleast_2d(np.asarray(position, np.float64)), color=color, **given)


def reference(camera, samples=32, **parts):
    return js.reference.render(js.Scene(**parts), camera, js.Settings(samples=samples))


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("spread", ["chords", "feet", "centres"])
@pytest.mark.parametrize("profile", ["gaussian", "ball"])
def test_one_point_alone_lets_through_what_the_closed_form_says(profile, spread, projection):
    camera, place = view(projection), np.array([0.03, -0.02, 0.1])
    b = impact(camera, place)
    image = reference(camera, points=points(place, profile=profile, spread=spread))
    expected = np.exp(-whole(b, profile=profile))
    assert (b < RADIUS).sum() > 9 and (b > RADIUS).any()
    np.testing.assert_allclose(image.transmittance, expected, rtol=0, atol=1e-6)  # a radius and a place are rounded to float32
    np.testing.assert_allclose(image.color[..., 0], 1 - expected, rtol=0, atol=1e-6)
    assert not image.color[..., 1:].any()


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_a_chord_is_laid_where_it_is_whatever_slant_it_crosses_samples_at(projection):
    place, first = np.array([0.4, 0.3, 0.1]), view(projection, far=3.1)
    half = np.sqrt(np.maximum(RADIUS**2 - impact(first, place) ** 2, 0))
    cut = Rays.of(first).within([place], [RADIUS**2]).reshape(half.shape)
    assert ((cut > 0) & (cut < 1.99 * half)).any()
    for number in (1, 16):
        image = reference(first, number, points=points(place, profile="ball"))
        np.testing.assert_allclose(image.transmittance, np.exp(-EXTINCTION * cut), rtol=0, atol=1e-5)


@pytest.mark.parametrize(("front", "back"), [(-0.5, 0.5), (0.5, -0.5)])
def test_of_two_points_one_behind_the_other_the_nearer_hides_the_farther(front, back):
    camera = view(size=1)
    both = (points((0, 0, front), RED), points((0, 0, back), BLUE))
    opacity = 1 - np.exp(-whole(np.zeros(1)))[0]
    nearer, farther = opacity, (1 - opacity) * opacity
    expected = (nearer, 0, farther) if front < back else (farther, 0, nearer)
    for given in (both, both[::-1]):
        for mix in ("extinction", "opacity"):
            image = reference(camera, points=given, mix=mix)
            np.testing.assert_allclose(image.color[0, 0], expected, rtol=0, atol=1e-6)
            np.testing.assert_allclose(image.transmittance[0, 0], (1 - opacity) ** 2, rtol=0, atol=1e-6)


@pytest.mark.parametrize("mix", ["extinction", "opacity"])
@pytest.mark.parametrize("medium", ["volume", "particles"])
def test_in_one_sample_colours_mix_as_asked(mix, medium):
    camera, density = view(size=1, near=2.5, far=3.5), 1.5
    look = js.TransferFunction.from_points([0.0, 1.0], [RED, RED], [density, density])
    grid = {"volume": js.Volume.from_array(CUBE.astype(np.float32), (-1, -1, -1), 2.0), "volume_transfer": look}
    gas_parts = grid if medium == "volume" else {"particles": js.Particles.from_arrays([(0.0, 0, 0)], 2.0, 0.5), "transfer": look}
    stars = points([(0, 0, 0.1), (0, 0, -0.1)], color=(BLUE, (0, 1, 0)), extinction=(EXTINCTION, EXTINCTION / 3))
    image = reference(camera, 1, **gas_parts, points=stars, mix=mix)
    gas, ball = density * 1.0, whole(np.zeros(1))[0]
    total, star = gas + ball * 4 / 3, ball * 4 / 3
    shares = np.array([gas, ball / 3, ball])
    np.testing.assert_allclose(image.transmittance[0, 0], np.exp(-total), rtol=1e-5)
    if mix == "extinction":
        expected = (1 - np.exp(-total)) * shares / total
    else:
        expected = np.array([1 - np.exp(-gas), *((1 - np.exp(-star)) * shares[1:] / star)])
    np.testing.assert_allclose(image.color[0, 0], expected, rtol=1e-5)


def test_a_ball_in_a_constant_medium_is_the_integral_of_emission_and_absorption():
    camera, density, samples = view(size=1, near=2.0, far=4.0), 0.9, 4096
    grid = js.Volume.from_array(CUBE.astype(np.float32), (-1, -1, -1), 2.0)
    look = js.TransferFunction.from_points([0.0, 1.0], [RED, RED], [density, density])
    stars = points((0, 0, 0), BLUE, profile="ball")
    front = 1 - RADIUS  # of the medium alone, from depth 2 on
    before, inside = np.exp(-density * front), np.exp(-(density + EXTINCTION) * 2 * RADIUS)
    share = density / (density + EXTINCTION)
    red = (1 - before) + before * (1 - inside) * share + before * inside * (1 - np.exp(-density * front))
    for mix in ("extinction", "opacity"):
        image = reference(camera, samples, volume=grid, volume_transfer=look, points=stars, mix=mix)
        np.testing.assert_allclose(image.color[0, 0], (red, 0, before * (1 - inside) * (1 - share)), rtol=2e-3)
        np.testing.assert_allclose(image.transmittance[0, 0], before * inside * before, rtol=1e-5)


@pytest.mark.parametrize("spread", ["feet", "centres"])
def test_feet_and_centres_put_all_of_a_point_in_one_sample(spread):
    """Off the axis feet lie nearer or farther than the centre, from ray to ray."""
    camera, place = view(size=31), np.array([0.3, 0.0, 0.7])
    b, rays, at = impact(camera, place), Rays.of(camera), np.full((31, 31), 3.7)
    if spread == "feet":  # rays begin at the eye: directions are of depth 1
        at = (((place - rays.start) * rays.direction).sum(1) / rays.slant**2).reshape(31, 31)
        assert np.ptp(at[b < RADIUS]) > 0.04
    assert b.min() < RADIUS
    for far in (3.69, 3.71):
        image = reference(view(size=31, far=far), points=points(place, spread=spread))
        expected = np.where(at < np.float32(far), np.exp(-whole(b)), 1)
        np.testing.assert_allclose(image.transmittance, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("spread", ["feet", "centres"])
def test_what_lies_in_front_of_the_first_sample_or_behind_the_last_is_not_there(spread):
    for near, far, seen in ((1, 2.9, False), (3.1, 5, False), (2.9, 3.1, True)):
        image = reference(view(size=1, near=near, far=far), points=points((0, 0, 0), spread=spread))
        assert (image.transmittance[0, 0] < 1) == seen


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_points_far_from_the_eye_are_splats(projection):
    """In one place of a clipped view a chord is cut, and a splat is whole or gone."""
    camera = view(projection, size=1, far=3.1)
    cut, gone = (reference(camera, points=points((0, 0, 0.15), splats_beyond=beyond)) for beyond in (3.2, 3.1))
    assert gone.transmittance[0, 0] - cut.transmittance[0, 0] > 0 and gone.transmittance[0, 0] == 1
    aside = np.array([0.2, 0, 0.0])  # farther than its depth, where rays spread from the eye
    near = reference(view(projection, size=3, far=3.001), points=points(aside, splats_beyond=3.002))
    far = reference(view(projection, size=3, far=3.001), points=points(aside, spread="centres"))
    assert np.array_equal(near.transmittance, far.transmittance) == (projection == "perspective")


def test_tables_and_functions_are_the_profiles_that_they_spell():
    camera = view(size=5)
    ball = reference(camera, points=points((0.05, 0, 0), profile="ball"))
    table = reference(camera, points=points((0.05, 0, 0), profile=[1.0, 1.0, 1.0]))
    shaped = reference(camera, points=points((0.05, 0, 0), profile=lambda offset, _: jnp.ones_like(offset[0])))
    cone = reference(view(size=1), points=points((0, 0, 0), profile=[1.0, 0.0]))
    np.testing.assert_allclose(table.transmittance, ball.transmittance, atol=1e-13)
    np.testing.assert_allclose(shaped.transmittance, ball.transmittance, atol=1e-13)
    np.testing.assert_allclose(cone.transmittance[0, 0], np.exp(-EXTINCTION * RADIUS), rtol=1e-6)


def test_functions_are_asked_for_offsets_along_the_worlds_axes_and_for_attributes():
    """A slab across x: a ray along x crosses its thickness, one along z all of the point."""

    def slab(offset, attributes):
        x, y, z = offset
        assert x.dtype == y.dtype == z.dtype == jnp.float64
        return attributes["strength"] * (1 + x)

    stars = points((0, 0, 0), profile=slab, attributes={"strength": (0.5,)}, extinction=2.0)
    for eye, expected in (((-3.0, 0, 0), 1.0), ((0, 0.0, -3), 1.0)):
        camera = js.Camera.look_at(eye, (0, 0, 0.0), fov_degrees=1.0, width=1, height=1, near=2, far=4)
        half = js.Camera.look_at(eye, (0, 0, 0.0), fov_degrees=1.0, width=1, height=1, near=2, far=3)
        all_of_it, front = (-np.log(reference(seen, points=stars).transmittance[0, 0]) for seen in (camera, half))
        np.testing.assert_allclose(all_of_it, 2.0 * 0.5 * 2 * RADIUS * expected, rtol=1e-6)
        share = 0.25 if eye[0] else 0.5  # 1 + x is small on the near side of x
        np.testing.assert_allclose(front / all_of_it, share, rtol=1e-6)


def test_padding_rests_and_every_are_respected():
    place = 1e4 + np.array([1 / 3, 0.2, 0.1])
    narrow = {"fov_degrees": 0.5, "width": 8, "height": 8, "near": 1, "far": 5}
    stars = points(place, radius=0.01, extinction=90.0, capacity=7)
    assert stars.position_rest is not None and stars.num_points == 1
    camera = js.Camera.look_at(place - (0, 0, 3.0), place, **narrow)
    image, centred = reference(camera, points=stars), points((0, 0, 0), radius=0.01, extinction=90.0)
    truth = reference(js.Camera.look_at((0, 0, -3.0), (0, 0, 0.0), **narrow), points=centred)
    assert truth.transmittance.min() < 0.9
    np.testing.assert_allclose(image.transmittance, truth.transmittance, atol=1e-5)
    some = js.reference.render(js.Scene(points=stars), camera, js.Settings(samples=32), every=3)
    np.testing.assert_array_equal(some.color, image.color[1::3, 1::3])
