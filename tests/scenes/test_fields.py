"""The made volumes are what their names say, at any resolution, and fill the picture."""

import numpy as np
import pytest

import jaxsph as js
from jaxsph.scenes import fields

SHAPES = {"engine": (32, 24, 16), "dragon": (32, 32, 16), "mixing_layer": (32, 3, 6)}


@pytest.mark.parametrize("name", SHAPES)
def test_a_volume_has_its_shape_and_repeats(name):
    made = getattr(fields, f"{name}_values")
    values = made(32)[0]
    assert values.shape == SHAPES[name] and values.dtype == (np.uint8 if name == "engine" else np.float32)
    np.testing.assert_array_equal(values, made(32)[0])
    assert np.isfinite(values).all() and np.ptp(values) > 0


def test_the_engine_holds_air_aluminium_and_steel():
    values, _ = fields.engine_values(96)
    air, aluminium, steel = values == 0, values == fields.ALUMINIUM, values > 200
    assert 0.5 < air.mean() < 0.8 and aluminium.mean() > 0.04 and 0.004 < steel.mean() < 0.1


def test_the_dragon_is_a_distance():
    """But for rings and a neck that thickens it changes by the spacing from point to point, and it is negative inside."""
    values, _, spacing = fields.dragon_values(64)
    assert values.min() < 0 < values.max()
    assert max(np.abs(np.diff(values, axis=axis)).max() for axis in range(3)) < 1.5 * spacing


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_a_picture_shows_something_that_is_not_clipped(name):
    scene, camera = getattr(fields, name)(48, width=64, height=48)
    image = js.render(scene, camera, js.Settings(samples=64))
    shown = np.asarray(image.alpha) > 0.1
    assert 0.1 < shown.mean() < 0.9 and np.asarray(image.color).max() > 0.4
