"""What is asked of a surface is checked when it is made, and a level that no ray meets is told with the range of the field."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
import pytest
from extreme import spoilt

import jaxsph as js
from jaxsph.model.scene import widened

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=12)


def some(number=30, support=0.4, kernel="wendland_c2"):
    rng = np.random.default_rng(1)
    return js.Particles.from_arrays(rng.uniform(-0.5, 0.5, (number, 3)), support, rng.uniform(0, 1, number), 0.01, kernel)


def camera():
    return js.Camera.look_at((0.0, 0.0, -3.0), (0.0, 0.0, 0.0), width=8, height=8, near=1.5, far=4.5, fov_degrees=30.0)


@functools.cache
def plan():
    """For all pictures of some particles."""
    return js.plan(js.Scene(particles=some(), surface=js.Surface(50.0)), camera(), SETTINGS)


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"level": 0.0}, "`level` must be > 0, but level = 0.0; coverage is 0 away from a fluid"),
        ({"level": np.nan}, "`level` must be finite"),
        ({"level": (1.0, 2.0)}, r"`level` must have shape \(\), got \(2,\); give one number"),
        ({"smoothing": -1.0}, "`smoothing` must be > 0"),
        ({"of": "density"}, "`of` must be one of 'coverage', 'quantity', 'extinction_quantity', got 'density'"),
        ({"color": (1.0, 0.5, 2.0)}, r"`color` must lie in \[0, 1\]"),
        ({"ambient": -0.1}, r"`ambient` must lie in \[0, 1\]"),
    ],
)
def test_a_surface_that_is_none_is_refused_by_name(given, match):
    with pytest.raises(ValueError, match=match):
        js.Surface(**given)


def test_a_scene_with_a_surface_needs_particles_and_no_transfer_function():
    js.Scene(particles=some(), surface=js.Surface()).check()
    with pytest.raises(ValueError, match="`surface` is that of `particles`, got None"):
        js.Scene(surface=js.Surface()).check()
    with pytest.raises(ValueError, match=r"`surface` must be a `jaxsph.Surface`, got float"):
        js.Scene(particles=some(), surface=0.5)
    for refused in (js.reference.render, js.reference.integral):
        with pytest.raises(ValueError, match="`surface` is unknown to the reference"):
            refused(js.Scene(particles=some(), surface=js.Surface()), camera())


def test_smoothing_widens_supports_once_and_keeps_volumes():
    scene = js.Scene(particles=some(), surface=js.Surface(0.3, smoothing=1.5))
    wide = widened(widened(scene))
    np.testing.assert_allclose(wide.particles.support, 1.5 * np.asarray(scene.particles.support), rtol=1e-6)
    np.testing.assert_array_equal(wide.particles.volume, scene.particles.volume)
    assert float(wide.surface.smoothing) == 1 and jax.tree.structure(wide) == jax.tree.structure(widened(scene))


@pytest.mark.parametrize(
    ("of", "given", "match"),
    [
        ("extinction_quantity", {}, "`surface` is of the 'extinction_quantity' of `particles`, which have one quantity"),
        ("quantity", {"quantity": [-1.0, 2.0]}, "a quantity that may not be negative, got -1: shift it, and the level"),
        (
            "quantity",
            {"quantity": [1e-30, 1.0], "volume": 1e-12},
            "leaves the range of float32; give the quantity in other units",
        ),
        ("quantity", {"quantity": [1e30, 1.0], "volume": 1e12}, "leaves the range of float32; give the quantity in other units"),
    ],
)
def test_a_quantity_that_makes_no_field_is_refused_by_name(of, given, match):
    columns = {"position": np.zeros((2, 3)), "support": 1.0, "quantity": [1.0, 2.0], "volume": 1.0} | given
    with pytest.raises(ValueError, match=match):
        js.Scene(particles=js.Particles.from_arrays(**columns), surface=js.Surface(of=of)).check()


def test_a_surface_of_a_quantity_is_that_of_the_coverage_by_particles_of_so_much_more_volume():
    particles, more = some(), np.random.default_rng(2).uniform(0.5, 3, 30)
    second = dataclasses.replace(particles, extinction_quantity=np.ones_like(particles.quantity))
    scene = widened(js.Scene(particles=second, surface=js.Surface(2.0, of="extinction_quantity", smoothing=1.2)))
    np.testing.assert_allclose(scene.particles.volume, particles.volume, rtol=1e-6)
    given = spoilt(particles, "quantity", more, np.s_[:30])
    scene = widened(js.Scene(particles=given, surface=js.Surface(2.0, of="quantity")))
    assert scene.surface.of == "coverage" and jax.tree.structure(scene) == jax.tree.structure(widened(scene))
    np.testing.assert_allclose(np.asarray(scene.particles.volume)[:30], 0.01 * more, rtol=1e-6)


def test_a_level_of_a_quantity_that_no_ray_meets_is_told_with_its_range():
    with pytest.warns(UserWarning, match=r"level 50: the particles' quantity, smoothed by their kernels, is 0\.\d+ to [\d.]+ at"):
        js.render(js.Scene(particles=some(), surface=js.Surface(50.0, of="quantity")), camera(), SETTINGS, plan=plan())


def test_a_level_that_no_ray_meets_is_an_empty_picture_and_told_with_the_range():
    scene = js.Scene(particles=some(), surface=js.Surface(50.0))
    with pytest.warns(
        UserWarning, match=r"no ray meets the surface of level 50: the coverage by particles is 0\.\d+ to [\d.]+ at"
    ):
        image = js.render(scene, camera(), SETTINGS, plan=plan())
    color, left, depth = map(np.asarray, (image.color, image.transmittance, image.depth))
    assert not color.any() and (left == 1).all() and np.isinf(depth).all()
    nobody = dataclasses.replace(scene.particles, valid=np.zeros_like(scene.particles.valid))
    with pytest.warns(UserWarning, match="0, as there are no particles"):
        js.render(dataclasses.replace(scene, particles=nobody), camera(), SETTINGS, plan=plan())


def test_a_camera_is_fitted_to_a_surface_without_a_transfer_function_as_to_an_even_fog():
    particles = some(200, 0.2)
    even = js.TransferFunction.from_points([0.0, 1.0], np.ones((2, 3)), [1.0, 1.0])
    fog = js.Camera.fitted(js.Scene(particles=particles, transfer=even))
    assert js.Camera.fitted(js.Scene(particles=particles, surface=js.Surface())).describe() == fog.describe()
