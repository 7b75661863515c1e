"""Errors to the light integral: where they are taken, and what they are the differences of."""

import dataclasses

import numpy as np
import pytest

import jaxsph as js
from jaxsph.trade.contenders import IntegralAt, layers_of

WIDTH, HEIGHT = 9, 6


@pytest.fixture(scope="module")
def view():
    return js.scenes.load("radial", 40, width=WIDTH, height=HEIGHT)


def test_errors_are_the_differences_to_the_light_integral_of_each_pixel(view):
    truth, image = js.reference.integral(*view, tolerance=1e-8), js.reference.render(*view, js.Settings(samples=8))
    expected = np.abs(layers_of(image) - layers_of(truth)).max(-1)
    taken = IntegralAt.of(*view, 20)
    assert taken.errors(layers_of(image)) == pytest.approx(expected[taken.rows, taken.columns], abs=2e-6)
    assert taken.errors(layers_of(image)).max() > 1e-3
    assert (taken.at(truth.transmittance) == truth.transmittance[taken.rows, taken.columns]).all()


def test_pixels_are_different_ones_all_over_the_image_and_always_the_same(view):
    taken, again = IntegralAt.of(*view, 20), IntegralAt.of(*view, 20)
    assert len(set(zip(taken.rows, taken.columns, strict=True))) == 20
    assert (taken.rows == again.rows).all() and (taken.columns == again.columns).all() and (taken.light == again.light).all()
    everywhere = IntegralAt.of(*view, 10 * WIDTH * HEIGHT)
    assert len(set(zip(everywhere.rows, everywhere.columns, strict=True))) == WIDTH * HEIGHT


def test_of_no_pixels_and_of_media_that_are_unknown_there_is_none(view):
    scene, camera = view
    assert IntegralAt.of(scene, camera, 0) is None
    x = np.linspace(-1, 1, 4)
    surface = js.IsoSurface.from_volume(
        js.Volume.from_array(x[:, None, None] + np.zeros((4, 4, 4)), (-1, -1, -1), 0.5), level=0.1
    )
    assert IntegralAt.of(dataclasses.replace(scene, media=(surface,)), camera, 5) is None
