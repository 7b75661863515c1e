"""What a clip leaves is what the reference shows of it, by every integrator; faces move, and have derivatives."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from images import error_of, seen_from
from rows import Fog

import jaxsph as js
from jaxsph.engine.access.grid import whole_cells

PLANE, BOX, BALL = (
    js.Plane((0.1, 0.2, -0.1), (1, 0.4, -2)),
    js.Box((-0.5, -0.4, -0.9), (0.6, 0.7, 0.3)),
    js.Sphere((0.2, 0, 0.1), 0.5),
)
CLIPS = {"plane": PLANE, "box": BOX, "outside": ~BALL, "both": PLANE & ~BALL, "either": BALL | ~PLANE}
BEYOND = js.Plane((0, 0, 9), (0, 0, -1)) & ~js.Sphere((9, 9, 9), 0.5)  # cuts nothing, by the programs of "both"
pytestmark = pytest.mark.usefixtures("quick_programs")
TRANSFER = js.TransferFunction.from_points([0.0, 0.5, 1.0], [[1, 0.2, 0], [0, 1, 0.3], [0.1, 0, 1]], [0.4, 2.0, 5.0])


def camera(projection="perspective", side=16):
    return seen_from((1.4, 1.1, -2.6), projection, width=side, height=side, near=1.2, far=5.0)


def scene(within=None, parts="particles"):
    """Supports that overlap several times, and a field that changes slowly."""
    rng = np.random.default_rng(1)
    position = rng.uniform(-1, 1, (150, 3)).astype(np.float32)
    particles = js.Particles.from_arrays(position, 0.55, 0.5 + 0.4 * np.sin(2 * position[:, 0] + position[:, 1]))
    made = js.Scene(particles=particles, transfer=TRANSFER, within=within)
    if parts == "all":
        x = np.linspace(0, 1, 9, dtype=np.float32)
        volume = js.Volume.from_array(x[:, None, None] * x[:, None] + 0 * x, (-0.7, -0.9, -0.8), 0.18)
        points = js.Points.from_arrays(rng.uniform(-0.8, 0.8, (20, 3)), 0.15, (1, 1, 0.3), opacity=0.6)
        made = dataclasses.replace(made, volume=volume, volume_transfer=TRANSFER, points=points)
    return made


def test_what_is_cut_out_is_not_evaluated_and_what_is_left_is_that_of_the_reference():
    """In float32: a sample on a face is inside or not. By other clips, in float64: `test_conformance`."""
    shown, settings = scene(CLIPS["both"], "all"), js.Settings(samples=32, integrator="samples")
    image, truth = js.render(shown, camera(), settings), js.reference.render(shown, camera(), settings)
    assert 0.05 < np.asarray(truth.alpha).mean() < 0.98
    assert (error_of(image, truth) < 2e-5).mean() > 0.99
    assert image.stats["evaluations"] < js.render(scene(BEYOND, "all"), camera(), settings).stats["evaluations"]


@pytest.mark.parametrize("samples", [5, pytest.param(33, marks=pytest.mark.slow)])
def test_a_slab_of_constant_extinction_is_cut_to_the_digit(samples):
    """By planes: what is left of the light is an exponential of the way between them, however long segments are."""
    particles = js.Particles.from_arrays(np.zeros((1, 3)), 10.0, 0.5)
    even = js.TransferFunction.from_points([0.0, 1.0], [[1, 1, 1]] * 2, [0.7, 0.7])
    slab = js.Plane((0, 0, 0.123), (0, 0, 1)) & js.Plane((0, 0, 0.821), (0, 0, -1))
    view = js.Camera.orthographic(eye=(0, 0, -2), target=(0, 0, 0), width=8, height=8, near=0.5, far=4.0, view_height=1.0)
    made = js.Scene(particles=particles, transfer=even, within=slab)
    image = js.render(made, view, js.Settings(samples=samples, integrator="segments"))
    np.testing.assert_allclose(image.transmittance, np.exp(-0.7 * 0.698), rtol=2e-6)
    outside = js.render(dataclasses.replace(made, within=~slab), view, js.Settings(samples=samples, integrator="segments"))
    np.testing.assert_allclose(outside.transmittance, np.exp(-0.7 * (3.5 - 0.698)), rtol=2e-6)


@pytest.mark.slow
def test_one_of_several_media_may_be_clipped_by_itself():
    """Wrapped, where the scene is not."""
    ball = Fog.of(3.0, radius=0.8)
    settings = js.Settings(samples=24, integrator="samples")
    alone, together = js.Scene(media=(js.Within(ball, BOX),)), js.Scene(media=(ball,), within=BOX)
    images = [js.render(one, camera(), settings) for one in (alone, together)]
    np.testing.assert_allclose(images[1].color, images[0].color, atol=1e-6)
    beside = js.Within(ball, js.Box((0.7, 0.7, 0.7), (0.8, 0.8, 0.8)))
    assert np.asarray(images[0].alpha).max() > 0.5 > float(js.render(js.Scene(media=(beside,)), camera(), settings).alpha.max())


@pytest.mark.slow
@pytest.mark.parametrize(
    "how", [{"tolerance": 0.05}, {"tolerance": 0.02, "super_pixels": False}, {"tolerance": 0.004, "estimator": "pilot"}], ids=str
)
def test_a_tolerance_is_kept_where_faces_cut(how):
    """Bounds are theorems: cells that a face may cross are at full rate, and others are as they were."""
    rng = np.random.default_rng(0)
    position = rng.uniform(0, 1, (400, 3))
    particles = js.Particles.from_arrays(position, 0.35, position[:, 0] + 0.1 * position[:, 1])
    view = js.Camera.look_at(eye=(2, 1.8, 3), target=(0.5, 0.5, 0.5), width=64, height=64, near=1.2, far=5.0, fov_degrees=30)
    clip = js.Plane((0.5, 0.5, 0.5), (1, 0.3, -0.5)) & ~js.Sphere((0.5, 0.7, 0.4), 0.3)
    made = js.Scene(particles=particles, transfer=TRANSFER, within=clip)
    settings = js.Settings(samples=512, integrator="samples", **how)
    full = js.render(made, view, dataclasses.replace(settings, tolerance=None))
    image = js.render(made, view, settings)
    error = error_of(image, jax.tree.map(np.asarray, full))
    assert image.stats["evaluations"] < full.stats["evaluations"]
    assert error.max() <= settings.tolerance
    if image.certified:
        assert (error <= np.asarray(image.error_bound)).all()


def test_a_cell_is_whole_where_all_of_its_slabs_are():
    slabs = np.array([[True], [True], [True], [True], [True], [False]])
    ended, cut = jax.jit(lambda slabs: (whole_cells(slabs, 4), whole_cells(slabs[:5], 4)))(slabs)
    assert np.array_equal(ended, [[True], [False]]) and np.array_equal(cut, [[True], [True]])
