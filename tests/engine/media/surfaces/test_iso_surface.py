"""An iso-surface is where the field crosses its level, shaded by the gradient, in order among other media."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from chords import Rays
from images import seen_from

import jaxsph as js

pytestmark = pytest.mark.usefixtures("quick_programs")

POINTS, RADIUS, COLOR, AMBIENT = 25, 0.7, (0.9, 0.5, 0.2), 0.25
SETTINGS = js.Settings(samples=48)


def ball(points=POINTS):
    """The distance from the origin, which is trilinear but for some 1e-3."""
    x = np.linspace(-1, 1, points)
    distance = np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2).astype(np.float32)
    return js.Volume.from_array(distance, (-1, -1, -1), 2 / (points - 1))


def surface(level=RADIUS, **kwargs):
    return js.IsoSurface.from_volume(ball(), level, COLOR, AMBIENT, **kwargs)


def camera(projection, width=24, height=20):
    return seen_from((0.5, 0.8, -3.0), projection, 42.0, 2.2, width=width, height=height, near=1.5, far=5.0)


@pytest.mark.parametrize("projection", ["perspective", pytest.param("orthographic", marks=pytest.mark.slow)])
def test_a_ball_is_opaque_in_its_place_and_shaded(projection):
    view = camera(projection)
    image = js.render(js.Scene(media=(surface(),)), view, SETTINGS)
    rays = Rays.of(view)
    (depth, _), *beside = (rays.chords(np.zeros((1, 3)), (share * RADIUS) ** 2) for share in (1, 0.97, 1.01))
    inside, outside = ((begin != end).reshape(view.height, view.width) for begin, end in beside)
    outside, depth = ~outside, depth.reshape(view.height, view.width)
    place = rays.start + depth.reshape(-1, 1) * rays.direction
    facing = (np.abs((place * rays.direction).sum(1)) / RADIUS / rays.slant).reshape(depth.shape)
    assert inside.sum() > 100 < outside.sum()
    np.testing.assert_array_equal(np.asarray(image.transmittance)[inside], 0)
    np.testing.assert_array_equal(np.asarray(image.transmittance)[outside], 1)
    step = np.diff(js.reference.sample_depths(view, 48)).max()
    assert (np.abs(np.asarray(image.depth)[inside] - depth[inside]) <= step).all()
    wanted = np.asarray(COLOR) * (AMBIENT + (1 - AMBIENT) * facing)[..., None]
    np.testing.assert_allclose(np.asarray(image.color)[inside], wanted[inside], atol=0.02)


@pytest.mark.parametrize("within", [None, js.Sphere((0.0, 0.0, 0.0), 5.0)], ids=["everywhere", "within a clip"])
def test_a_ball_that_lies_between_samples_is_within_what_is_told(within):
    """Neither picture is certified, as the coarser one misses it."""
    scene, view = js.Scene(media=(surface(0.12),), within=within), camera("perspective")
    images = [js.render(scene, view, dataclasses.replace(SETTINGS, samples=samples)) for samples in (4, 48)]
    few, many = (np.asarray(image.alpha, np.float64) for image in images)
    assert (np.abs(few - many) <= sum(np.asarray(image.error_bound) for image in images)).all()
    assert many.max() == 1 > few.max() and not any(image.certified for image in images)


def test_no_surface_is_where_values_are_nan():
    values = np.array(ball().values)
    values[POINTS // 2 :] = np.nan
    half, view = js.Volume.from_array(values, (-1, -1, -1), 2 / (POINTS - 1)), camera("perspective")
    whole, image = (
        js.render(js.Scene(media=(js.IsoSurface.from_volume(of, RADIUS, COLOR, AMBIENT),)), view, SETTINGS)
        for of in (ball(), half)
    )
    alpha, of_whole = 1 - np.asarray(image.transmittance), 1 - np.asarray(whole.transmittance)
    assert np.isfinite(image.color).all() and 0.2 < alpha.sum() / of_whole.sum() < 0.8
    same = (alpha > 0.99) & (np.asarray(image.depth) == np.asarray(whole.depth))
    assert same.sum() > 30 and (np.abs(np.asarray(image.color) - np.asarray(whole.color)).max(-1)[same] < 0.05).mean() > 0.8


@pytest.mark.parametrize(
    ("changed", "match"),
    [
        ({"level": np.nan}, "`level`"),
        ({"color": (2, 0, 0)}, "color"),
        ({"color": 1.0}, "`color`"),
        ({"ambient": -1}, "`ambient`"),
    ],
)
def test_what_makes_no_surface_is_refused_by_name(changed, match):
    with pytest.raises(ValueError, match=match):
        js.IsoSurface.from_volume(ball(3), **{"level": 0.5} | changed)
