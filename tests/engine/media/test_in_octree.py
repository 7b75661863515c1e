"""A scene in octrees shows the same, and integrators that choose where they ask take it; `render` does that by itself."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxsph as js
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.media.in_octree import in_octree
from jaxsph.engine.media.octree_medium import OctreeParticles, OctreePoints
from jaxsph.engine.planning.plan import Plan

pytestmark = pytest.mark.usefixtures("quick_programs")

STEPS = js.Settings(samples=32, integrator="step_doubling", step_tolerance=1e-3)
COUNT, WIDTH, HEIGHT = 16, 14, 12
RNG = np.random.default_rng(1)
POSITION, COLOR = RNG.uniform(-0.7, 0.7, (COUNT, 3)).astype(np.float32), RNG.uniform(0, 1, (COUNT, 3))


def parts():
    """Particles and points, in octrees of one shape."""
    look = js.TransferFunction.from_points([0, 0.4, 1], [[1, 0, 0], [0, 1, 0.2], [0.1, 0, 1]], [0.2, 2.0, 1.0])
    found = js.Particles.from_arrays(POSITION, 0.56, RNG.uniform(0, 1, COUNT).astype(np.float32), capacity=COUNT)
    points = js.Points.from_arrays(POSITION, 0.56, COLOR, 1.0, capacity=COUNT)
    return {"particles": found, "transfer": look}, {"points": points}


PARTICLES, POINTS = parts()


def camera():
    return js.Camera.look_at((0.6, 0.5, -3.0), (0.0, 0.0, 0.0), fov_degrees=42.0, width=WIDTH, height=HEIGHT, near=1.5, far=5.0)


def off(image, truth):
    color = np.abs(np.asarray(image.color, float) - np.asarray(truth.color, float)).max(-1)
    return np.maximum(color, np.abs(np.asarray(image.transmittance, float) - np.asarray(truth.transmittance, float)))


@pytest.mark.slow
def test_particles_and_points_by_step_doubling_are_the_reference_of_many_samples():
    """Without a word about octrees."""
    scene = js.Scene(**PARTICLES, **POINTS)
    image = js.render(scene, camera(), STEPS)
    fine = js.reference.render(scene, camera(), js.Settings(samples=512))
    assert 0.3 < np.asarray(image.alpha).max() < 1
    error = off(image, fine)
    assert (error <= 4 * STEPS.step_tolerance).mean() > 0.98 and error.max() < 0.05


@pytest.mark.slow
def test_points_by_step_doubling_are_nearly_their_exact_chords():
    image = js.render(js.Scene(**POINTS), camera(), STEPS)
    chords = js.reference.render(js.Scene(**POINTS), camera(), js.Settings(samples=512))
    assert 0.3 < np.asarray(image.alpha).max() < 1
    error = off(image, chords)
    assert (error <= 3 * STEPS.step_tolerance).mean() > 0.98 and error.max() < 0.02  # a profile ends at exp(-4.5), not at 0


@pytest.mark.slow
def test_particles_by_step_doubling_are_the_reference_of_many_samples():
    image = js.render(js.Scene(**PARTICLES), camera(), STEPS)
    fine = js.reference.render(js.Scene(**PARTICLES), camera(), js.Settings(samples=1024))
    assert np.asarray(image.alpha).max() > 0.3
    assert (off(image, fine) <= 3 * STEPS.step_tolerance).mean() > 0.98


def test_parts_become_media_and_the_rest_stays():
    scene = js.Scene(**PARTICLES, points=(POINTS["points"],), mix="opacity")
    found = in_octree(scene)
    assert [type(medium) for medium in found.media] == [OctreeParticles, OctreePoints]
    assert found.particles is found.points is found.transfer is None and found.mix == "opacity"
    assert in_octree(found).media == found.media  # nothing is left to do


@pytest.mark.slow
def test_the_same_samples_show_the_same():
    scene, settings = js.Scene(**PARTICLES), js.Settings(samples=32)
    images = [js.render(shown, camera(), settings) for shown in (scene, in_octree(scene))]
    assert off(*images).max() < 1e-4


def test_under_a_trace_what_has_no_octree_is_refused_and_says_how_to_make_one():
    lists, cast = ListPlan(2, 2, 64, 64), CastPlan(64, 4, 128)
    plan = Plan(WIDTH, HEIGHT, 32, 64, 1, 1, lists, cast, 0, integrator="step_doubling", step_tolerance=STEPS.step_tolerance)

    def color(view, scene):
        return js.render(scene, view, STEPS, plan=plan).color

    for parts, name in ((PARTICLES, "particles"), (POINTS, "points")):
        shown = js.Scene(**parts)
        with pytest.raises(ValueError, match=rf"`Scene\({name}=...\)` cannot answer; .*`jaxsph.engine.media.in_octree`"):
            jax.eval_shape(lambda view, shown=shown: color(view, shown), camera())
    inside = jax.eval_shape(lambda scene: color(camera(), scene), in_octree(js.Scene(**PARTICLES)))
    assert inside.shape == (HEIGHT, WIDTH, 3)


def test_under_a_trace_no_octree_is_built_and_it_says_where_to_build_it():
    scene = js.Scene(**PARTICLES)
    with pytest.raises(ValueError, match=r"`scene` must be of concrete arrays.*outside of `jax.jit` and `jax.grad`"):
        jax.eval_shape(in_octree, scene)
    quantity = scene.particles.quantity
    with pytest.raises(ValueError, match=r"`scene` must be of concrete arrays.*give them the scene that it returns"):
        jax.grad(lambda value: in_octree(js.Scene(**moved(quantity=value))).media[0].octree.side)(quantity)


def moved(**columns):
    """The particles with other columns."""
    return PARTICLES | {"particles": dataclasses.replace(PARTICLES["particles"], **columns)}


@pytest.mark.slow
def test_images_are_differentiated_by_what_the_octree_holds():
    """By particles and transfer function as without an octree, under `jit`."""
    settings, shown, slopes = js.Settings(samples=16), js.Scene(**PARTICLES), []
    for scene in (in_octree(shown), shown):
        plan = js.plan(scene, camera(), settings)

        def total(scene, plan=plan):
            return js.render(scene, camera(), settings, plan=plan).color.sum()

        slopes.append(jax.jit(jax.grad(total, allow_int=True))(scene))
    (inside,), outside = slopes[0].media, slopes[1]
    for name in ("position", "support", "quantity", "volume"):
        wanted = getattr(outside.particles, name)
        np.testing.assert_allclose(getattr(inside.particles, name), wanted, atol=1e-3 * np.abs(wanted).max())
    for name in ("values", "colors", "extinction"):
        wanted = getattr(outside.transfer, name)
        np.testing.assert_allclose(getattr(inside.transfer, name), wanted, atol=1e-3 * np.abs(wanted).max())


@pytest.mark.slow
def test_a_picture_in_stages_takes_them_too():
    settings = dataclasses.replace(STEPS, tolerance=0.01)
    last = list(js.progressive(js.Scene(**POINTS), camera(), settings))[-1]
    assert off(last, js.render(js.Scene(**POINTS), camera(), STEPS)).max() < 0.05


@pytest.mark.slow
def test_float64_stays_float64(x64):
    wide = dataclasses.replace(PARTICLES["particles"], **{
        name: getattr(PARTICLES["particles"], name).astype(jnp.float64) for name in ("position", "support", "quantity", "volume")
    })  # fmt: skip
    scene = js.Scene(particles=wide, transfer=PARTICLES["transfer"])
    image = js.render(scene, camera(), STEPS)
    assert in_octree(scene).dtype == image.color.dtype == jnp.float64
    fine = js.reference.render(scene, camera(), js.Settings(samples=1024))
    assert (off(image, fine) <= 3 * STEPS.step_tolerance).mean() > 0.98
