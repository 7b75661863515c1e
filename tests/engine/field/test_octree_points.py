"""Points in an octree are the sum of what each has, anywhere; to sum along steps is nearly what chords have exactly."""

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
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.engine.media.octree_points import OctreePoints
from jaxsph.numerics import faults

COUNT, TASKS, SAMPLES = 40, 6, 5
PLAN = OctreePlan(1, 512, 512, (LevelSizes(8, 2048),), 2048)
RNG = np.random.default_rng(3)
POSITION, RADIUS = RNG.uniform(-0.8, 0.8, (COUNT, 3)), 10 ** RNG.uniform(-1, -0.2, COUNT)
COLOR, EXTINCTION, BRIGHTNESS = RNG.uniform(0, 1, (COUNT, 3)), RNG.uniform(0.2, 2, COUNT), RNG.uniform(0.5, 1, COUNT)
TABLE = np.exp(-3 * np.linspace(0, 1, 9) ** 2)


def shaped(offset, attributes):
    x, y, z = offset
    return (1 - x * x - 0.5 * y * y) * (1 + 0.3 * z) / attributes["brightness"]


def points(profile="gaussian", dtype=np.float32, **more):
    columns = (value.astype(dtype) for value in (POSITION, RADIUS, COLOR, EXTINCTION))
    given = {"attributes": {"brightness": BRIGHTNESS.astype(dtype)}, "capacity": COUNT} | more
    return js.Points.from_arrays(*columns, profile, **given)


def camera(projection="perspective"):
    where = {"eye": (0.6, 0.5, -3.0), "target": (0.0, 0.0, 0.0), "width": 20, "height": 16, "near": 1.5, "far": 5.0}
    if projection == "orthographic":
        return js.Camera.orthographic(**where, view_height=2.2)
    return js.Camera.look_at(**where, fov_degrees=42.0)


def slabs(projection, dtype=np.float32):
    """Packets of two columns and three rows, and samples anywhere along them."""
    rng = np.random.default_rng(4)
    spread = 0.35 if projection == "perspective" else 1.0
    u, v = rng.uniform(-spread, spread, (TASKS, 2)), rng.uniform(-spread, spread, (TASKS, 3))
    border = np.sort(rng.uniform(2.2, 4.2, (TASKS, SAMPLES + 1)), 1)
    middle = 0.5 * (border[:, 1:] + border[:, :-1])
    u, v, middle, border = (jnp.asarray(value, dtype) for value in (u, v, middle, border))
    return SlabTask(None, jnp.arange(TASKS), jnp.arange(TASKS), u, v, middle, border, projection == "perspective")


@functools.partial(jax.jit, compiler_options=QUICKLY)
def asked(given, view, task):
    """Positions and optics of samples."""
    medium = OctreePoints.from_points(given, PLAN).seen_by(view)
    return medium.faults(), task.positions(), medium.optics(medium.gather(task), task)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def in_view(given, view):
    return OctreePoints.from_points(given, PLAN).seen_by(view)


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
    word, place, optics = asked(points(profile), view, slabs(projection))
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


def test_cotangents_are_the_transpose_of_tangents(x64):
    """By all numbers of the points, of a profile, of the camera and of where samples are: <c, J t> = <J^T c, t>."""
    view, rng = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), camera()), np.random.default_rng(5)
    seen, task = in_view(points(shaped, np.float64), view), slabs("perspective", np.float64)
    weights = [jnp.asarray(rng.normal(size=task.shape)) for _ in range(4)]
    move = [jnp.asarray(rng.normal(size=np.shape(part))) for part in (seen.seen.table, seen.seen.common[1], task.depth, 1.0)]

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

    _, tangents, pulled = both(seen.seen.table, seen.seen.common[1], task.depth, jnp.float64(1))
    forward = sum(float((one * weight).sum()) for one, weight in zip(tangents, weights, strict=True))
    parts = [float((one * way).sum()) for one, way in zip(pulled, move, strict=True)]
    assert min(map(abs, parts)) > 1e-3
    assert forward == pytest.approx(sum(parts), rel=1e-10)


@pytest.mark.parametrize(("given", "name"), [({"spread": "feet"}, "spread"), ({"splats_beyond": 2.0}, "splats_beyond")])
def test_what_has_no_extinction_at_a_point_is_refused_by_name(given, name):
    with pytest.raises(ValueError, match=f"`{name}` must be left at its default.*integrator='samples'"):
        OctreePoints.from_points(points(**given), PLAN)


def test_points_that_mean_nothing_are_a_fault():
    broken = points(shaped)
    broken = dataclasses.replace(broken, radius=broken.radius.at[3].set(jnp.nan))
    word, _, optics = asked(broken, camera(), slabs("perspective"))
    assert int(word) == faults.BAD_POINTS and bool(jnp.isfinite(jnp.stack(optics)).all())


def test_where_there_are_none_there_is_no_extinction():
    nobody = dataclasses.replace(points(shaped), valid=jnp.zeros(COUNT, bool))
    word, _, optics = asked(nobody, camera(), slabs("perspective"))
    assert int(word) == 0 and not np.asarray(optics[3]).any()
