"""A periodic set is shown as its 27 explicit copies are within the box: images, integrals, grids and their derivatives."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from images import error_of, seen_from

import jaxsph as js

pytestmark = pytest.mark.usefixtures("quick_programs")
SIDES = np.array([1.0, 1.25, 0.75])
COUNT, LARGEST = 40, 0.3
TRANSFER = js.TransferFunction.from_points([0.0, 0.5, 1.0], [[1, 0.2, 0], [0, 1, 0.3], [0.1, 0, 1]], [1.0, 3.0, 6.0])


def columns_of(seed=0):
    """On multiples of 2^-12, so that no copy is rounded."""
    rng = np.random.default_rng(seed)
    position = np.floor(rng.uniform(0, 1, (COUNT, 3)) * SIDES * 4096) / 4096
    return position, rng.uniform(0.1, LARGEST, COUNT), rng.uniform(0, 1, COUNT), rng.uniform(0.5, 1, COUNT)


def periodic(dtype=np.float32):
    return js.Particles.from_arrays(*(column.astype(dtype) for column in columns_of()), box=SIDES)


def copies(dtype=np.float32):
    """All 27, those in the box first."""
    position, *others = columns_of()
    turns = sorted(itertools.product((-1, 0, 1), repeat=3), key=any)
    places = np.concatenate([position + SIDES * turn for turn in turns])
    return js.Particles.from_arrays(places.astype(dtype), *(np.tile(column, 27).astype(dtype) for column in others))


def box(dtype=np.float32):
    return js.Box(np.zeros(3, dtype), SIDES.astype(dtype))


def camera(projection="perspective", side=12, dtype=np.float32):
    eye, target = np.array([1.9, 1.6, -1.7], dtype), np.array([0.5, 0.6, 0.4], dtype)
    place = {"width": side, "height": side, "near": dtype(1.0), "far": dtype(4.5)}
    return seen_from(eye, projection, 40.0, dtype(1.6), target=target, **place)


def scenes(dtype=np.float32):
    look = jax.tree.map(lambda leaf: leaf.astype(dtype), TRANSFER)
    return [
        js.Scene(particles=periodic(dtype), transfer=look),
        js.Scene(particles=copies(dtype), transfer=look, within=box(dtype)),
    ]


@pytest.mark.parametrize(
    ("integrator", "projection"), [("samples", "perspective"), pytest.param("segments", "orthographic", marks=pytest.mark.slow)]
)
def test_images_are_those_of_explicit_copies_within_the_box(integrator, projection):
    settings = js.Settings(samples=24, integrator=integrator)
    found, truth = (js.render(scene, camera(projection), settings) for scene in scenes())
    assert 0.3 < np.asarray(found.alpha).mean() < 0.95
    assert error_of(found, truth).max() <= 1e-6


def test_the_reference_and_its_integral_are_those_of_explicit_copies():
    for render in (
        lambda scene: js.reference.render(scene, camera(), js.Settings(samples=24)),
        lambda scene: js.reference.integral(scene, camera(side=6), tolerance=1e-7),
    ):
        found, truth = (render(scene) for scene in scenes())
        assert 0.3 < np.mean(1 - truth.transmittance) < 0.95
        assert error_of(found, truth).max() <= 1e-6


def test_a_set_that_was_centred_elsewhere_shows_another_period_of_the_same_field():
    """Values on a lattice that both periods share."""
    lower, spacing, shape = np.zeros(3), SIDES / 8, (9, 9, 9)
    at = SIDES * (0.75, 0.25, 1.5)
    home = np.asarray(js.resample(periodic(), lower, spacing, shape, fill=-1.0).values)
    moved = np.asarray(js.resample(periodic().centered(at), at - SIDES / 2, spacing, shape, fill=-1.0).values)
    rolled = home[:8, :8, :8]
    for axis, turn in enumerate((-2, 2, -8)):
        rolled = np.roll(rolled, turn, axis)
    np.testing.assert_allclose(moved[:8, :8, :8], rolled, atol=2e-6)
    np.testing.assert_allclose(home[8], home[0], atol=2e-6)  # both faces show the same


def test_a_grid_of_a_periodic_set_is_that_of_explicit_copies_and_ends_at_its_faces():
    lower, spacing, shape = np.array([-0.2, 0.1, -0.1]), 0.11, (14, 11, 9)
    found, truth = (js.resample(one, lower, spacing, shape, fill=-1.0).values for one in (periodic(), copies()))
    place = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1) * spacing + lower
    inside = ((place >= 0) & (place <= SIDES)).all(-1)
    assert 0.2 < inside.mean() < 0.8 and (np.asarray(found)[~inside] == -1).all()
    np.testing.assert_allclose(np.asarray(found)[inside], np.asarray(truth)[inside], atol=1e-6)


@pytest.mark.slow
def test_a_jitted_frame_is_the_same_of_particles_that_were_moved_by_a_period():
    scene, settings, view = scenes()[0], js.Settings(samples=8, integrator="samples"), camera(side=6)
    plan = js.plan(scene, view, settings, headroom=1.5)

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def picture(shift):
        moved = dataclasses.replace(scene.particles, position=scene.particles.position + shift)
        image = js.render(dataclasses.replace(scene, particles=moved), view, settings, plan=plan)
        return image.color, image.faults

    around, faults = picture(jnp.asarray(SIDES, jnp.float32))
    np.testing.assert_allclose(around, picture(jnp.zeros(3))[0], atol=1e-5)
    assert int(faults) == 0 and picture._cache_size() == 1
