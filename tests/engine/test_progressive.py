"""Progressive images: a picture at once, better ones after it, and the image of every pixel at last."""

import dataclasses
import itertools

import jax
import numpy as np
import pytest
from extreme import same_in_another_unit
from images import layers

import jaxsph as js
from jaxsph.engine.request import scaled

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=16, tolerance=0.02)


@pytest.fixture(scope="module")
def view():
    rng = np.random.default_rng(2)
    particles = js.Particles.from_arrays(rng.uniform(-1, 1, (200, 3)), 0.4, rng.uniform(0, 1, 200))
    transfer = js.TransferFunction.from_points([0, 1], [[1, 0.2, 0], [0, 0.2, 1]], [0.5, 3])
    camera = js.Camera.look_at((0, 0, 4), (0, 0, 0), width=53, height=45, near=2, far=6, fov_degrees=45)
    return js.Scene(particles=particles, transfer=transfer), camera


@pytest.mark.slow
def test_every_stage_is_better_and_the_last_keeps_the_tolerance(view):
    reference = layers(js.render(*view, dataclasses.replace(SETTINGS, tolerance=None)))
    images = list(js.progressive(*view, SETTINGS, worst=60))
    errors = [np.sqrt(((layers(image) - reference) ** 2).mean()) for image in images]
    assert len(images) > 3 and errors[-1] < 0.1 * errors[0]
    assert all(after <= 1.05 * before for before, after in itertools.pairwise(errors))
    rays, left = ([image.stats[name] for image in images] for name in ("rays", "rays_left"))
    assert rays == sorted(rays) and left == sorted(left, reverse=True)
    assert [image.stats["stage"] for image in images] == list(range(len(images)))
    last = images[-1]
    assert last.stats["leaves_over"] == 0 and last.stats["max_error"] <= SETTINGS.tolerance and not last.certified
    assert (np.abs(layers(last) - reference).max(-1) > SETTINGS.tolerance).mean() <= 1e-3


def test_it_goes_on_where_it_was_and_begins_anew_for_another_camera_without_compiling(view, compiled):
    scene, camera = view
    stages = js.progressive(scene, camera, SETTINGS, worst=60)
    first, second = next(stages), next(stages)
    third = next(iter(stages))
    assert (first.stats["stage"], second.stats["stage"], third.stats["stage"]) == (0, 1, 2)
    moved = dataclasses.replace(camera, eye=camera.eye + np.float32([0.05, 0, 0]))
    compiled.clear()
    again = next(stages.restart(camera=moved))
    assert again.stats["stage"] == 0 and not compiled
    assert np.abs(layers(again) - layers(first)).max() > 0
    assert next(stages).stats["stage"] == 1


def test_without_a_tolerance_it_ends_with_the_image_of_every_pixel(view):
    settings = dataclasses.replace(SETTINGS, tolerance=None)
    *_, last = js.progressive(*view, settings, share=1)
    np.testing.assert_allclose(layers(last), layers(js.render(*view, settings)), atol=1e-6)
    assert last.stats["rays_left"] == 0 == last.stats["l2_error"]


def test_stages_are_in_the_unit_of_length_that_was_given(view):
    settings = dataclasses.replace(SETTINGS, tolerance=None)
    moved = scaled(view[0], 80), scaled(view[1], 80)
    for image, other in zip(*(js.progressive(*given, settings, share=1) for given in (moved, view)), strict=True):
        same_in_another_unit(image, other, 80)


def test_what_cannot_be_is_refused(view):
    with pytest.raises(ValueError, match="`worst` must be at least 1"):
        js.progressive(*view, SETTINGS, worst=0)
    with pytest.raises(ValueError, match="`share` must lie in"):
        js.progressive(*view, SETTINGS, share=0.0)
    with pytest.raises(ValueError, match=r"call `jaxsph.render` under jit"):
        jax.jit(lambda camera: js.progressive(view[0], camera, SETTINGS))(view[1])
