"""Particles in an octree are the field of Hochstetter et al. 2016, equation 2, at any point; and have its derivatives."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY

import jaxsph as js
from jaxsph.engine.access.octree_build import LevelSizes, OctreePlan
from jaxsph.engine.media.octree_particles import OctreeParticles
from jaxsph.numerics import faults

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=32)
PLAN = OctreePlan(1, 400, 400, (LevelSizes(8, 2048),), 2048)


def particles(kernel="poly6", count=60, decades=0.7, seed=1):
    rng = np.random.default_rng(seed)
    support = (0.6 * 10 ** -rng.uniform(0, decades, count)).astype(np.float32)
    position, quantity = rng.uniform(-0.8, 0.8, (count, 3)).astype(np.float32), rng.uniform(0, 1, count).astype(np.float32)
    return js.Particles.from_arrays(position, support, quantity, rng.uniform(0.2, 1, count).astype(np.float32), kernel)


def transfer():
    return js.TransferFunction.from_points([0, 0.4, 1], [[1, 0, 0], [0, 1, 0.2], [0.1, 0, 1]], [0.2, 2.0, 1.0])


def camera(projection="perspective", width=20, height=16):
    where = {"eye": (0.6, 0.5, -3.0), "target": (0.0, 0.0, 0.0), "width": width, "height": height, "near": 1.5, "far": 5.0}
    if projection == "orthographic":
        return js.Camera.orthographic(**where, view_height=2.2)
    return js.Camera.look_at(**where, fov_degrees=42.0)


def in_octree(found):
    return js.Scene(media=(built(found, transfer(), PLAN),))


@functools.partial(jax.jit, static_argnames="plan", compiler_options=QUICKLY)
def built(found, look, plan):
    return OctreeParticles.from_particles(found, look, plan)


@pytest.mark.parametrize(
    ("kernel", "projection"),
    [
        ("poly6", "perspective"),
        pytest.param("cubic_spline", "orthographic", marks=pytest.mark.slow),
        pytest.param("wendland_c2", "perspective", marks=pytest.mark.slow),
    ],
)
def test_an_image_is_that_of_the_reference(kernel, projection, compare):
    found, view = particles(kernel), camera(projection)
    truth = js.reference.render(js.Scene(particles=found, transfer=transfer()), view, SETTINGS)
    image = js.render(in_octree(found), view, SETTINGS)
    assert truth.alpha.max() > 0.1 and truth.alpha.min() == 0
    compare(image, truth, 1e-4, 0.999)


@pytest.mark.slow
def test_step_doubling_may_ask_for_points_of_its_own():
    found, view = particles(decades=0.1), camera()
    settings = js.Settings(samples=32, integrator="step_doubling", step_tolerance=1e-3)
    fine = js.render(js.Scene(particles=found, transfer=transfer()), view, js.Settings(samples=2048))
    image = js.render(in_octree(found), view, settings)
    assert (np.abs(image.color - fine.color).max(-1) <= 3e-3).mean() > 0.98
    assert (np.abs(image.transmittance - fine.transmittance) <= 3e-3).mean() > 0.98


def test_a_constant_is_rendered_as_that_constant():
    found = dataclasses.replace(particles(), quantity=jnp.full_like(particles().quantity, 0.37))
    image = js.render(in_octree(found), camera(), SETTINGS)
    color, _ = transfer()(jnp.float32(0.37))
    np.testing.assert_allclose(image.color, np.asarray(color) * np.asarray(image.alpha)[..., None], atol=2e-7)


@pytest.mark.slow
def test_derivatives_are_those_of_particles_that_are_marched_by_lists():
    found, view, weights = particles(count=30, decades=0.3), camera(width=9, height=8), jnp.arange(1.0, 4)
    look = transfer()
    medium = built(found, look, PLAN)

    def scene(position, quantity, support, extinction, in_tree):
        moved = dataclasses.replace(found, position=position, quantity=quantity, support=support)
        shown = dataclasses.replace(look, extinction=extinction)
        if in_tree:
            return js.Scene(media=(dataclasses.replace(medium, particles=moved, transfer=shown),))
        return js.Scene(particles=moved, transfer=shown)

    given = found.position, found.quantity, found.support, look.extinction
    results = []
    for in_tree in (True, False):
        plan = js.plan(scene(*given, in_tree), view, SETTINGS)

        def light(*values, in_tree=in_tree, plan=plan):
            image = js.render(scene(*values, in_tree), view, SETTINGS, plan=plan)
            return (image.color * weights).sum() + image.transmittance.sum()

        results.append(jax.jit(jax.value_and_grad(light, (0, 1, 2, 3)))(*given))
    (value, slopes), (wanted, wanted_slopes) = results
    np.testing.assert_allclose(value, wanted, rtol=1e-5)
    for slope, other in zip(slopes, wanted_slopes, strict=True):
        assert float(jnp.abs(other).max()) > 0
        np.testing.assert_allclose(slope, other, rtol=1e-3, atol=1e-3 * float(jnp.abs(other).max()))


@pytest.mark.slow
def test_octree_particles_share_rays_with_other_media():
    """Two halves of a set, one in an octree and one in lists, mixed: dark halves are where either is."""
    found, view = particles(), camera()
    both = dataclasses.replace(in_octree(found), particles=particles(seed=5), transfer=transfer())
    alone = js.render(in_octree(found), view, SETTINGS)
    other = js.render(js.Scene(particles=particles(seed=5), transfer=transfer()), view, SETTINGS)
    image = js.render(both, view, SETTINGS)
    np.testing.assert_allclose(image.transmittance, alone.transmittance * other.transmittance, rtol=2e-5, atol=1e-6)


def test_an_octree_that_was_too_small_is_refused_with_what_to_do():
    found = particles()
    wide = dataclasses.replace(found, support=8 * found.support)
    assert int(built(found, transfer(), PLAN).faults()) == 0
    assert int(built(wide, transfer(), PLAN).faults()) == faults.OCTREE_OVERFLOW
    with pytest.raises(ValueError, match="plan_octree"):
        js.render(in_octree(wide), camera(), SETTINGS)
