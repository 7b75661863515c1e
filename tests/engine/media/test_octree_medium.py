"""Particles in an octree are their field at any point, and points the sum of what each has; with all derivatives of either.

A scene in octrees shows the same, and integrators that choose where they ask take it; `render` does that by itself.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from extreme import spoilt

import jaxsph as js
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.octree_medium import OctreeParticles, OctreePoints, in_octree
from jaxsph.engine.planning.plan import Plan
from jaxsph.model.medium import Cotangents, optics
from jaxsph.numerics import faults

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=32)
COUNT, TASKS, SAMPLES = 40, 6, 5
RNG = np.random.default_rng(3)
POSITION, RADIUS = RNG.uniform(-0.8, 0.8, (COUNT, 3)), 10 ** RNG.uniform(-1, -0.2, COUNT)
COLOR, EXTINCTION, BRIGHTNESS = RNG.uniform(0, 1, (COUNT, 3)), RNG.uniform(0.2, 2, COUNT), RNG.uniform(0.5, 1, COUNT)
TABLE = np.exp(-3 * np.linspace(0, 1, 9) ** 2)


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


def alone(found):
    return js.Scene(media=(OctreeParticles.of(found, transfer()),))


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
    image = js.render(alone(found), view, SETTINGS)
    assert truth.alpha.max() > 0.1 and truth.alpha.min() == 0
    compare(image, truth, 1e-4, 0.999)


def test_a_constant_is_rendered_as_that_constant():
    found = dataclasses.replace(particles(), quantity=np.full(particles().capacity, 0.37, np.float32))
    image = js.render(alone(found), camera(), SETTINGS)
    color, _ = jax.jit(js.TransferFunction.__call__)(transfer(), np.float32(0.37))
    np.testing.assert_allclose(image.color, np.asarray(color) * (1 - np.asarray(image.transmittance))[..., None], atol=2e-7)


@pytest.mark.slow
def test_octree_particles_share_rays_with_other_media():
    """Two halves of a set, one in an octree and one in lists, mixed: dark halves are where either is."""
    found, view = particles(), camera()
    both = dataclasses.replace(alone(found), particles=particles(seed=5), transfer=transfer())
    first = js.render(alone(found), view, SETTINGS)
    other = js.render(js.Scene(particles=particles(seed=5), transfer=transfer()), view, SETTINGS)
    image = js.render(both, view, SETTINGS)
    np.testing.assert_allclose(image.transmittance, first.transmittance * other.transmittance, rtol=2e-5, atol=1e-6)


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


def fall_off(name, offset, brightness):
    """Of offsets in radii, float64, along the axes of the world."""
    square = (offset**2).sum(-1)
    if name == "shaped":
        return shaped(np.moveaxis(offset, -1, 0), {"brightness": brightness})
    table = np.interp(np.sqrt(square), np.linspace(0, 1, 9), TABLE)
    return {"gaussian": np.exp(-4.5 * square), "ball": np.ones_like(square), "table": table}[name]


@pytest.mark.parametrize(
    ("name", "projection"),
    [
        ("shaped", "perspective"),
        pytest.param("gaussian", "orthographic", marks=pytest.mark.slow),
        pytest.param("ball", "perspective", marks=pytest.mark.slow),
        pytest.param("table", "orthographic", marks=pytest.mark.slow),
    ],
)
def test_extinctions_add_up_and_colours_weigh_by_them(name, projection):
    profile, view = {"shaped": shaped, "table": TABLE}.get(name, name), camera(projection)
    word, place, optics = asked(OctreePoints.of(points(profile)), view, slabs(projection))
    assert int(word) == 0
    axes, eye = (np.asarray(part, np.float64) for part in (view.axes, view.eye))
    at = np.stack([np.asarray(part, np.float64) for part in place], -1) @ axes + eye
    offset = (at[..., None, :] - POSITION.astype(np.float32)) / RADIUS[:, None]
    inside = (offset**2).sum(-1) < 1
    each = np.where(inside, fall_off(name, offset, BRIGHTNESS), 0) * EXTINCTION
    total, color = each.sum(-1), each @ COLOR
    filled = total > 0
    assert 0.1 < filled.mean() < 1
    close = np.abs(np.sqrt((offset**2).sum(-1)) - 1).min(-1) < 1e-5  # at the edge of a point either is right
    np.testing.assert_allclose(np.where(close, total, optics[3]), total, rtol=2e-5, atol=1e-6)
    for k in range(3):
        wanted = color[..., k][filled & ~close] / total[filled & ~close]
        np.testing.assert_allclose(np.asarray(optics[k])[filled & ~close], wanted, rtol=1e-4, atol=1e-6)


SEEN = jax.jit(OctreePoints.seen_by, compiler_options=QUICKLY)


def test_cotangents_are_the_transpose_of_tangents(x64):
    """By all numbers of the points, of a profile, of the camera and of where samples are: <c, J t> = <J^T c, t>."""
    view, rng = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), camera()), np.random.default_rng(5)
    seen, task = SEEN(OctreePoints.of(points(shaped, np.float64)), view), slabs("perspective", np.float64)
    weights = [rng.normal(size=task.shape) for _ in range(4)]
    move = [np.asarray(rng.normal(size=np.shape(part))) for part in (seen.seen.table, seen.seen.common[1], task.depth, 1.0)]

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def both(table, axes, depth, factor):
        def met(table, axes, depth, factor):
            common = seen.seen.common[0], axes
            shown = dataclasses.replace(seen, seen=seen.seen._replace(table=table, common=common))
            there = dataclasses.replace(task, depth=depth, u=task.u * factor, v=task.v * factor)
            return optics(shown, shown.gather(there), there)

        found, tangents = jax.jvp(met, (table, axes, depth, factor), tuple(move))
        nothing = Cotangents(jnp.zeros((0, 8)), jax.tree.map(jnp.zeros_like, seen))
        (_, total), places = seen.pull(nothing, seen.gather(task), task, weights)
        return found, tangents, (total.seen.table, total.seen.common[1], places.depth, places.factor)

    _, tangents, pulled = both(seen.seen.table, seen.seen.common[1], task.depth, np.float64(1))
    forward = sum(np.vdot(one, weight) for one, weight in zip(tangents, weights, strict=True))
    parts = [np.vdot(one, way) for one, way in zip(pulled, move, strict=True)]
    assert min(map(abs, parts)) > 1e-3
    assert forward == pytest.approx(sum(parts), rel=1e-10)


@pytest.mark.parametrize(("given", "name"), [({"spread": "centres"}, "spread"), ({"splats_beyond": 2.0}, "splats_beyond")])
def test_what_has_no_extinction_at_a_point_is_refused_by_name(given, name):
    with pytest.raises(ValueError, match=f"`{name}` must be left at its default.*integrator='samples'"):
        OctreePoints.of(points(**given))


def test_points_that_mean_nothing_are_a_fault():
    broken = spoilt(points(shaped), "radius", np.nan, 3)
    word, _, optics = asked(OctreePoints.of(broken), camera(), slabs("perspective"))
    assert int(word) == faults.BAD_POINTS and np.isfinite(np.stack(optics)).all()


def test_where_there_are_none_there_is_no_extinction():
    nobody = dataclasses.replace(points(shaped), valid=np.zeros(COUNT, bool))
    word, _, optics = asked(OctreePoints.of(nobody), camera(), slabs("perspective"))
    assert int(word) == 0 and not np.asarray(optics[3]).any()


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


def off(image, truth):
    color = np.abs(np.asarray(image.color, float) - np.asarray(truth.color, float)).max(-1)
    return np.maximum(color, np.abs(np.asarray(image.transmittance, float) - np.asarray(truth.transmittance, float)))


@pytest.mark.slow
def test_particles_and_points_by_step_doubling_are_the_reference_of_many_samples():
    """Without a word about octrees."""
    scene = js.Scene(**PARTICLES, **POINTS)
    image = js.render(scene, VIEW, STEPS)
    fine = js.reference.render(scene, VIEW, js.Settings(samples=512))
    assert 0.3 < np.asarray(image.alpha).max() < 1
    error = off(image, fine)
    assert (error <= 4 * STEPS.step_tolerance).mean() > 0.98 and error.max() < 0.05


@pytest.mark.slow
def test_points_by_step_doubling_are_nearly_their_exact_chords():
    image = js.render(js.Scene(**POINTS), VIEW, STEPS)
    chords = js.reference.render(js.Scene(**POINTS), VIEW, js.Settings(samples=512))
    assert 0.3 < np.asarray(image.alpha).max() < 1
    error = off(image, chords)
    assert (error <= 3 * STEPS.step_tolerance).mean() > 0.98 and error.max() < 0.02  # a profile ends at exp(-4.5), not at 0


def test_parts_become_media_and_the_rest_stays():
    scene = js.Scene(**PARTICLES, points=(POINTS["points"],), mix="opacity")
    found = in_octree(scene)
    assert [type(medium) for medium in found.media] == [OctreeParticles, OctreePoints]
    assert found.particles is found.points is found.transfer is None and found.mix == "opacity"
    assert in_octree(found).media == found.media  # nothing is left to do


def test_under_a_trace_what_has_no_octree_is_refused_and_says_how_to_make_one():
    lists, cast = ListPlan(2, 2, 64, 64), CastPlan(64, 4, 128)
    plan = Plan(WIDTH, HEIGHT, 32, 64, 1, 1, lists, cast, 0, integrator="step_doubling", step_tolerance=STEPS.step_tolerance)

    def color(view, scene):
        return js.render(scene, view, STEPS, plan=plan).color

    for parts, name in ((PARTICLES, "particles"), (POINTS, "points")):
        shown = js.Scene(**parts)
        with pytest.raises(
            ValueError, match=rf"`Scene\({name}=...\)` cannot answer; .*`jaxsph.engine.media.octree_medium.in_octree`"
        ):
            jax.eval_shape(lambda view, shown=shown: color(view, shown), VIEW)
    inside = jax.eval_shape(lambda scene: color(VIEW, scene), in_octree(js.Scene(**PARTICLES)))
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
        plan = js.plan(scene, VIEW, settings)

        def total(scene, plan=plan):
            return js.render(scene, VIEW, settings, plan=plan).color.sum()

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
    last = list(js.progressive(js.Scene(**POINTS), VIEW, settings))[-1]
    assert off(last, js.render(js.Scene(**POINTS), VIEW, STEPS)).max() < 0.05


@pytest.mark.slow
def test_float64_stays_float64(x64):
    wide = dataclasses.replace(PARTICLES["particles"], **{
        name: getattr(PARTICLES["particles"], name).astype(jnp.float64) for name in ("position", "support", "quantity", "volume")
    })  # fmt: skip
    scene = js.Scene(particles=wide, transfer=PARTICLES["transfer"])
    image = js.render(scene, VIEW, STEPS)
    assert in_octree(scene).dtype == image.color.dtype == jnp.float64
    fine = js.reference.render(scene, VIEW, js.Settings(samples=1024))
    assert (off(image, fine) <= 3 * STEPS.step_tolerance).mean() > 0.98
