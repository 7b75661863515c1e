"""Errors to the light integral: where they are taken, and what they are the differences of."""

import dataclasses

import numpy as np
import pytest

import jaxsph as js
from jaxsph.trade.sweep import integral_at, layers_of

WIDTH, HEIGHT = 9, 6


@pytest.fixture(scope="module")
def view():
    return js.scenes.load("radial", 40, width=WIDTH, height=HEIGHT)


def test_errors_are_the_differences_to_the_light_integral_of_each_pixel(view):
    truth, image = js.reference.integral(*view, tolerance=1e-8), js.reference.render(*view, js.Settings(samples=8))
    expected = np.abs(layers_of(image) - layers_of(truth)).max(-1)
    pixels, light = integral_at(*view, 20)
    errors = np.abs(layers_of(image)[pixels] - light).max(-1)
    assert errors == pytest.approx(expected[pixels], abs=2e-6) and errors.max() > 1e-3


def test_pixels_are_different_ones_all_over_the_image_and_always_the_same(view):
    (pixels, light), (again, once_more) = integral_at(*view, 20), integral_at(*view, 20)
    assert len(set(zip(*pixels, strict=True))) == 20
    assert (np.array(pixels) == np.array(again)).all() and (light == once_more).all()
    everywhere, _ = integral_at(*view, 10 * WIDTH * HEIGHT)
    assert len(set(zip(*everywhere, strict=True))) == WIDTH * HEIGHT


def test_of_no_pixels_and_of_media_that_are_unknown_there_is_none(view):
    scene, camera = view
    assert integral_at(scene, camera, 0) is None
    x = np.linspace(-1, 1, 4)
    surface = js.IsoSurface.from_volume(
        js.Volume.from_array(x[:, None, None] + np.zeros((4, 4, 4)), (-1, -1, -1), 0.5), level=0.1
    )
    assert integral_at(dataclasses.replace(scene, media=(surface,)), camera, 5) is None
