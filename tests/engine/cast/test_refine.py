"""Slabs that are marched again for a tolerance: what is promised of images with `integrator="segments"` and a tolerance."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import jaxsph as js
from jaxsph.numerics import faults

pytestmark = pytest.mark.filterwarnings("ignore:.*give more `samples`")  # where a tolerance is missed
SEGMENTS = js.Settings(integrator="segments", samples=96, tolerance=0.01)


def frame(size: int = 48, particles: int = 2000) -> tuple[js.Scene, js.Camera]:
    return js.scenes.load("flubber", particles=particles, width=size, height=size)


def errors(image: js.Image, scene: js.Scene, camera: js.Camera) -> np.ndarray:
    truth = js.reference.integral(scene, camera, every=4)
    color, alpha = np.asarray(image.color)[2::4, 2::4], np.asarray(image.alpha)[2::4, 2::4]
    return np.maximum(np.abs(color - truth.color).max(-1), np.abs(alpha - truth.alpha))


@pytest.mark.slow
def test_a_tolerance_is_kept_against_the_light_integral() -> None:
    scene, camera = frame()
    image = js.render(scene, camera, SEGMENTS)
    found = errors(image, scene, camera)
    assert (found > 0.01).mean() <= 0.01 and found.max() < 0.03
    assert not image.certified and image.faults in (0, faults.TOLERANCE_MISSED)


@pytest.mark.core
def test_one_program_keeps_two_tolerances_on_few_particles(frames, compiled, quick_programs) -> None:
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng, decades=0.3), frames.camera(rng)
    settings = dataclasses.replace(SEGMENTS, samples=frames.samples)
    plan, images = js.plan(scene, camera, settings), []
    for tolerance in (0.1, 0.01):
        compiled.clear()
        images.append(js.render(scene, camera, dataclasses.replace(settings, tolerance=tolerance), plan=plan))
        found = errors(images[-1], scene, camera)
        assert (found > tolerance).mean() <= 0.05 and found.max() < 3 * tolerance
        assert not images[-1].certified and images[-1].faults in (0, faults.TOLERANCE_MISSED)
    assert not compiled, "the second tolerance needs no other program"
    assert images[1].stats["evaluations"] > images[0].stats["evaluations"]
    assert np.asarray(images[1].error_bound).mean() < np.asarray(images[0].error_bound).mean()


@pytest.mark.parametrize("thin", [1e-5, 1e-7, 1e-9])
def test_where_errors_are_small_rounding_belongs_to_what_is_told(frames, quick_programs, thin) -> None:
    """Of what hardly takes light, whose segments differ by less than float32 rounds sums of light by."""
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng, decades=0.3), frames.camera(rng)
    settings = dataclasses.replace(SEGMENTS, samples=frames.samples)
    plan = js.plan(scene, camera, settings)
    scene = dataclasses.replace(scene, transfer=dataclasses.replace(scene.transfer, extinction=thin * scene.transfer.extinction))
    image = js.render(scene, camera, settings, plan=plan)
    told = np.asarray(image.error_bound, np.float64)[2::4, 2::4]
    assert (errors(image, scene, camera) <= told).all() and told.max() < 1e-4 and not int(image.faults)


@pytest.mark.slow
def test_gaps_between_two_samples_that_see_particles_are_seen_by_what_supports_cover() -> None:
    """Two particles behind one another, half of a first sample apart: both resolutions that are compared miss the gap."""
    rng, support, step = np.random.default_rng(0), 0.2, 2.2 / 24
    across = np.stack(np.meshgrid([-0.6, 0, 0.6], [-0.6, 0, 0.6]), -1).reshape(-1, 2)
    near = np.column_stack([across, rng.uniform(-0.5, -0.4, 9)])
    far = near + np.column_stack([np.zeros((9, 2)), 2 * support + rng.uniform(0.4, 0.8, 9) * step])
    look = js.TransferFunction.from_points([0.0, 1.0], [[1, 0.2, 0], [0, 0.4, 1]], [2.7, 2.7])
    scene = js.Scene(particles=js.Particles.from_arrays(np.concatenate([near, far]), support, 0.5), transfer=look)
    camera = js.Camera.look_at((0, 0, 40), (0, 0, 0), fov_degrees=2.6, width=32, height=32, near=38.9, far=38.9 + 24 * step)
    image = js.render(scene, camera, dataclasses.replace(SEGMENTS, samples=48))
    truth = js.reference.integral(scene, camera)
    found = np.maximum(np.abs(image.color - truth.color).max(-1), np.abs(image.alpha - truth.alpha))
    assert found.max() <= SEGMENTS.tolerance


@pytest.mark.slow
def test_a_tolerance_that_cannot_be_kept_is_told() -> None:
    scene, camera = frame(24)
    hopeless = dataclasses.replace(SEGMENTS, samples=8, tolerance=1e-5)
    with pytest.warns(UserWarning, match="give more `samples`"):
        image = js.render(scene, camera, hopeless)
    assert image.faults == faults.TOLERANCE_MISSED
    assert (np.asarray(image.error_bound) > 1e-5).any()


def test_a_plan_with_a_tolerance_is_refused_without_one(frames, quick_programs) -> None:
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng, decades=0.3), frames.camera(rng)
    asked = dataclasses.replace(SEGMENTS, samples=2 * (frames.samples // 2))
    plan = js.plan(scene, camera, asked)
    with pytest.raises(ValueError, match="samples"):
        js.render(scene, camera, dataclasses.replace(asked, tolerance=None), plan=plan)
    twice = dataclasses.replace(asked, tolerance=None, samples=frames.samples // 2)
    with pytest.raises(ValueError, match="was made for a tolerance"):
        js.render(scene, camera, twice, plan=plan)


@pytest.mark.slow
def test_bands_and_shards_do_not_change_a_refined_image() -> None:
    scene, camera = frame(96)
    whole = js.render(scene, camera, SEGMENTS)
    limit = int(0.75 * js.plan(scene, camera, SEGMENTS).bytes)
    banded = js.render(scene, camera, dataclasses.replace(SEGMENTS, memory_limit=limit))
    difference = np.abs(np.asarray(whole.color) - np.asarray(banded.color))
    assert difference.max() <= SEGMENTS.tolerance  # batches are of other slabs: what is in front is known at other times


@pytest.mark.slow
def test_volumes_and_points_are_refined_with_particles() -> None:
    scene, camera = frame(32, 500)
    lower, upper = np.asarray(scene.particles.position).min(0), np.asarray(scene.particles.position).max(0)
    grid = np.linspace(0, 1, 9)
    values = (np.sin(5 * grid)[:, None, None] + grid[None, :, None] * grid[None, None, :]).astype(np.float32)
    volume = js.Volume.from_array(values, lower, (upper - lower) / 8)
    look = js.TransferFunction.from_points([0.0, 1.0], [[0, 0, 1], [1, 1, 0]], [0.0, 2.0])
    points = js.Points.from_arrays(np.asarray(scene.particles.position)[:5], 0.2, [1.0, 0.2, 0.2], 3.0)
    both = dataclasses.replace(scene, volume=volume, volume_transfer=look, points=points)
    image = js.render(both, camera, SEGMENTS)
    assert (errors(image, both, camera) > 0.01).mean() <= 0.02
