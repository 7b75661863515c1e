"""Particles in an octree are their field at any point, and points the sum of what each has; with all derivatives of either."""

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
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.octree_medium import OctreeParticles, OctreePoints
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


def in_octree(found):
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
    found = dataclasses.replace(particles(), quantity=np.full(particles().capacity, 0.37, np.float32))
    image = js.render(in_octree(found), camera(), SETTINGS)
    color, _ = jax.jit(js.TransferFunction.__call__)(transfer(), np.float32(0.37))
    np.testing.assert_allclose(image.color, np.asarray(color) * (1 - np.asarray(image.transmittance))[..., None], atol=2e-7)


@pytest.mark.slow
def test_derivatives_are_those_of_particles_that_are_marched_by_lists():
    found, view, weights = particles(count=30, decades=0.3), camera(width=9, height=8), jnp.arange(1.0, 4)
    look = transfer()
    medium = OctreeParticles.of(found, look)

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
    return medium.faults(), task.positions(), medium.optics(medium.gather(task), task)


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
        def optics(table, axes, depth, factor):
            common = seen.seen.common[0], axes
            shown = dataclasses.replace(seen, seen=dataclasses.replace(seen.seen, table=table, common=common))
            there = dataclasses.replace(task, depth=depth, u=task.u * factor, v=task.v * factor)
            return shown.optics(shown.gather(there), there)

        found, tangents = jax.jvp(optics, (table, axes, depth, factor), tuple(move))
        total, places = seen.pull(seen.no_cotangents(), seen.gather(task), task, weights)
        return found, tangents, (total.seen.table, total.seen.common[1], places.depth, places.factor)

    _, tangents, pulled = both(seen.seen.table, seen.seen.common[1], task.depth, np.float64(1))
    forward = sum(np.vdot(one, weight) for one, weight in zip(tangents, weights, strict=True))
    parts = [np.vdot(one, way) for one, way in zip(pulled, move, strict=True)]
    assert min(map(abs, parts)) > 1e-3
    assert forward == pytest.approx(sum(parts), rel=1e-10)


@pytest.mark.parametrize(("given", "name"), [({"spread": "feet"}, "spread"), ({"splats_beyond": 2.0}, "splats_beyond")])
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
