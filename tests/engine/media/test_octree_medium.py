"""Particles in an octree are their field at any point, and points the sum of what each has.

A scene in octrees shows the same, and integrators that choose where they ask take it; `render` does that by itself.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from extreme import spoilt
from images import error_of, seen_from

import jaxsph as js
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.octree_medium import OctreeParticles, OctreePoints, in_octree
from jaxsph.model.medium import optics
from jaxsph.numerics import faults

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=32)
COUNT, TASKS, SAMPLES = 40, 6, 5
RNG = np.random.default_rng(3)
POSITION, RADIUS = RNG.uniform(-0.8, 0.8, (COUNT, 3)), 10 ** RNG.uniform(-1, -0.2, COUNT)
COLOR, EXTINCTION, BRIGHTNESS = RNG.uniform(0, 1, (COUNT, 3)), RNG.uniform(0.2, 2, COUNT), RNG.uniform(0.5, 1, COUNT)


def particles(kernel="poly6", count=60, decades=0.7, seed=1):
    rng = np.random.default_rng(seed)
    support = (0.6 * 10 ** -rng.uniform(0, decades, count)).astype(np.float32)
    position, quantity = rng.uniform(-0.8, 0.8, (count, 3)).astype(np.float32), rng.uniform(0, 1, count).astype(np.float32)
    return js.Particles.from_arrays(position, support, quantity, rng.uniform(0.2, 1, count).astype(np.float32), kernel)


def transfer():
    return js.TransferFunction.from_points([0, 0.4, 1], [[1, 0, 0], [0, 1, 0.2], [0.1, 0, 1]], [0.2, 2.0, 1.0])


def camera(projection="perspective", width=20, height=16):
    return seen_from((0.6, 0.5, -3.0), projection, 42.0, 2.2, width=width, height=height, near=1.5, far=5.0)


def alone(found):
    return js.Scene(media=(OctreeParticles.of(found, transfer()),))


def test_a_constant_is_rendered_as_that_constant():
    found = dataclasses.replace(particles(), quantity=np.full(particles().capacity, 0.37, np.float32))
    image = js.render(alone(found), camera(), SETTINGS)
    color, _ = jax.jit(js.TransferFunction.__call__)(transfer(), np.float32(0.37))
    np.testing.assert_allclose(image.color, np.asarray(color) * (1 - np.asarray(image.transmittance))[..., None], atol=2e-7)


def shaped(offset, attributes):
    x, y, z = offset
    return (1 - x * x - 0.5 * y * y) * (1 + 0.3 * z) / attributes["brightness"]


def points(profile="gaussian", dtype=np.float32, **more):
    columns = (value.astype(dtype) for value in (POSITION, RADIUS, COLOR, EXTINCTION))
    given = {"attributes": {"brightness": BRIGHTNESS.astype(dtype)}, "capacity": COUNT} | more
    return js.Points.from_arrays(*columns, profile, **given)


def slabs(projection, dtype=np.float32):
    """Packets of two columns and three rows, and samples anywhere along them."""
    rng = np.random.default_rng(4)
    spread = 0.35 if projection == "perspective" else 1.0
    u, v = rng.uniform(-spread, spread, (TASKS, 2)), rng.uniform(-spread, spread, (TASKS, 3))
    border = np.sort(rng.uniform(2.2, 4.2, (TASKS, SAMPLES + 1)), 1)
    middle = 0.5 * (border[:, 1:] + border[:, :-1])
    u, v, middle, border = (value.astype(dtype) for value in (u, v, middle, border))
    return SlabTask(None, np.arange(TASKS), np.arange(TASKS), u, v, middle, border, projection == "perspective")


@functools.partial(jax.jit, compiler_options=QUICKLY)
def asked(given, view, task):
    """Positions and optics of samples."""
    medium = given.seen_by(view)
    return medium.fault, task.positions(), optics(medium, medium.gather(task), task)


@pytest.mark.parametrize("projection", ["perspective", pytest.param("orthographic", marks=pytest.mark.slow)])
def test_extinctions_add_up_and_colours_weigh_by_them(projection):
    view = camera(projection)
    word, place, optics = asked(OctreePoints.of(points(shaped)), view, slabs(projection))
    assert int(word) == 0
    axes, eye = (np.asarray(part, np.float64) for part in (view.axes, view.eye))
    at = np.stack([np.asarray(part, np.float64) for part in place], -1) @ axes + eye
    offset = (at[..., None, :] - POSITION.astype(np.float32)) / RADIUS[:, None]
    inside = (offset**2).sum(-1) < 1
    each = np.where(inside, shaped(np.moveaxis(offset, -1, 0), {"brightness": BRIGHTNESS}), 0) * EXTINCTION
    total, color = each.sum(-1), each @ COLOR
    filled = total > 0
    assert 0.1 < filled.mean() < 1
    close = np.abs(np.sqrt((offset**2).sum(-1)) - 1).min(-1) < 1e-5  # at the edge of a point either is right
    np.testing.assert_allclose(np.where(close, total, optics[3]), total, rtol=2e-5, atol=1e-6)
    for k in range(3):
        wanted = color[..., k][filled & ~close] / total[filled & ~close]
        np.testing.assert_allclose(np.asarray(optics[k])[filled & ~close], wanted, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("given", "name"), [({"spread": "centres"}, "spread"), ({"splats_beyond": 2.0}, "splats_beyond")])
def test_what_has_no_extinction_at_a_point_is_refused_by_name(given, name):
    with pytest.raises(ValueError, match=f"`{name}` must be left at its default.*integrator='samples'"):
        OctreePoints.of(points(**given))


def test_points_that_mean_nothing_are_a_fault():
    broken = spoilt(points(shaped), "radius", np.nan, 3)
    word, _, optics = asked(OctreePoints.of(broken), camera(), slabs("perspective"))
    assert int(word) == faults.BAD_POINTS and np.isfinite(np.stack(optics)).all()


STEPS = js.Settings(samples=32, integrator="step_doubling", step_tolerance=1e-3)
FEW, WIDTH, HEIGHT = 16, 14, 12
VIEW = camera(width=WIDTH, height=HEIGHT)
FIXED = np.random.default_rng(1)
CLOSE, COLORS = FIXED.uniform(-0.7, 0.7, (FEW, 3)).astype(np.float32), FIXED.uniform(0, 1, (FEW, 3))


def both_parts():
    """Particles and points, in octrees of one shape."""
    look = js.TransferFunction.from_points([0, 0.4, 1], [[1, 0, 0], [0, 1, 0.2], [0.1, 0, 1]], [0.2, 2.0, 1.0])
    found = js.Particles.from_arrays(CLOSE, 0.56, FIXED.uniform(0, 1, FEW).astype(np.float32), capacity=FEW)
    points = js.Points.from_arrays(CLOSE, 0.56, COLORS, 1.0, capacity=FEW)
    return {"particles": found, "transfer": look}, {"points": points}


PARTICLES, POINTS = both_parts()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parts", "tolerances", "most"),
    [(PARTICLES | POINTS, 4, 0.05), (POINTS, 3, 0.02)],  # of points by their exact chords; a profile ends at exp(-4.5), not at 0
    ids=["both", "points"],
)
def test_images_by_step_doubling_are_the_reference_of_many_samples(parts, tolerances, most):
    """Without a word about octrees."""
    image = js.render(js.Scene(**parts), VIEW, STEPS)
    fine = js.reference.render(js.Scene(**parts), VIEW, js.Settings(samples=512))
    assert 0.3 < np.asarray(image.alpha).max() < 1
    error = error_of(image, fine)
    assert (error <= tolerances * STEPS.step_tolerance).mean() > 0.98 and error.max() < most


def test_parts_become_media_and_the_rest_stays():
    scene = js.Scene(**PARTICLES, points=(POINTS["points"],), mix="opacity")
    found = in_octree(scene)
    assert [type(medium) for medium in found.media] == [OctreeParticles, OctreePoints]
    assert found.particles is found.points is found.transfer is None and found.mix == "opacity"
    assert in_octree(found).media == found.media  # nothing is left to do


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
