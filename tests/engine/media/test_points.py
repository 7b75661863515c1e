"""Points are what the reference says of them, wherever they are, however they are spread, among whatever else there is."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from chords import Rays
from derivatives import QUICKLY
from extreme import spoilt
from images import error_of, same_bits, seen_from

import jaxsph as js
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.planning.plan import Plan
from jaxsph.numerics import faults
from jaxsph.reference.image import sample_borders

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=24)
TOLD = {"pixels": "tolerance=None", "quadtree": "integrator='samples'"}  # where points leave their chords
WIDTH, HEIGHT, CAPACITY = 21, 18, 64
PLAN = Plan(WIDTH, HEIGHT, 24, 192, 4, 1, ListPlan(2, 2, 1024, 4096), CastPlan(64, 4, 128), 0)
"""For all images, such that those of the same parts share programs: all point sets have one capacity, all volumes one shape."""
RNG = np.random.default_rng(8)
COUNT = 40
POSITION = RNG.uniform(-1.2, 1.2, (COUNT, 3))
RADIUS = 10.0 ** RNG.uniform(-2.2, -0.2, COUNT)
COLOR = RNG.uniform(0, 1, (COUNT, 3))
EXTINCTION = RNG.uniform(0.1, 3, COUNT) / RADIUS


def points(position=POSITION, radius=RADIUS, color=COLOR, extinction=EXTINCTION, **more):
    return js.Points.from_arrays(position, radius, color, extinction, **({"capacity": CAPACITY} | more))


def shown(scene, view=None):
    """By the one plan."""
    return js.render(scene, view or camera(), SETTINGS, plan=PLAN)


def camera(projection="perspective", distance=3.0, **more):
    where = {"width": WIDTH, "height": HEIGHT, "near": max(distance - 1.5, 0.05), "far": distance + 1.5} | more
    return seen_from((0.3 * distance, 0.4 * distance, -distance), projection, 50.0, 2.5, **where)


def field(**more):
    values = np.random.default_rng(2).uniform(0, 1, (6, 7, 5)).astype(np.float32)
    look = js.TransferFunction.from_points([0.2, 0.5, 0.8], [[1, 0.2, 0], [0, 1, 0.3], [0.1, 0, 1]], [0.0, 2.0, 0.5])
    return {"volume": js.Volume.from_array(values, (-1.1, -0.9, -1.0), 0.4), "volume_transfer": look} | more


def particles():
    rng = np.random.default_rng(1)
    look = js.TransferFunction.from_points([0.2, 0.5, 0.8], [[1, 0.2, 0], [0, 1, 0.3], [0.1, 0, 1]], [0.5, 2.0, 0.5])
    position = rng.uniform(-1, 1, (30, 3)).astype(np.float32)
    return {"particles": js.Particles.from_arrays(position, 0.6, rng.uniform(0, 1, 30).astype(np.float32)), "transfer": look}


def shaped(offset, attributes):
    x, y, z = offset
    return jnp.exp(-4 * (x * x + 4 * y * y + z * z)) * attributes["brightness"]


def assert_is_reference(scene, view):
    error = error_of(shown(scene, view), js.reference.render(scene, view, SETTINGS))
    assert (error <= 1e-4).mean() >= 0.999, f"{(error > 1e-4).sum()} of {error.size} pixels, worst {error.max()}"


@pytest.mark.parametrize(
    ("spread", "projection"),
    [
        ("chords", "perspective"),
        ("centres", "orthographic"),
        ("feet", "perspective"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("chords", "orthographic"), ("centres", "perspective"))),
    ],
)
def test_an_image_is_that_of_the_reference(spread, projection):
    assert_is_reference(js.Scene(points=points(spread=spread)), camera(projection))


@pytest.mark.parametrize("profile", [shaped, pytest.param("gaussian", id="splats", marks=pytest.mark.slow)])
def test_any_profile_is_that_of_the_reference(profile):
    """Of balls and tables: `test_conformance`."""
    more = {"attributes": {"brightness": RNG.uniform(0.5, 1, COUNT)}} if profile is shaped else {"splats_beyond": 3.0}
    assert_is_reference(js.Scene(points=points(profile=profile, **more)), camera())


def test_feet_have_all_of_a_point_in_one_sample():
    """That which its centre's foot on the ray is in; what a ray meets in all is what its chord has."""
    place, view = np.array([0.7, 0.4, 0.2]), camera()
    alone = [points(place[None], [0.7], COLOR[:1], [8.0], spread=spread) for spread in ("feet", "chords")]
    image, chords = (shown(js.Scene(points=one), view) for one in alone)
    np.testing.assert_allclose(image.transmittance, chords.transmittance, atol=1e-6)
    rays, borders = Rays.of(view), sample_borders(view, SETTINGS.samples)
    foot = (((place - rays.start) * rays.direction).sum(1) / rays.slant**2).reshape(HEIGHT, WIDTH)
    sample = np.searchsorted(borders, foot) - 1
    hidden = np.asarray(image.transmittance) < 0.4
    depth = np.asarray(image.depth)[hidden]
    assert hidden.sum() > 9 and np.ptp(sample[hidden]) >= 1
    assert (borders[sample[hidden]] <= depth).all() and (depth <= borders[sample[hidden] + 1]).all()


@pytest.mark.parametrize("screen", ["pixels", "quadtree"])
@pytest.mark.parametrize("how", [{"spread": "feet"}, {"spread": "centres"}, {"splats_beyond": 2.0}])
def test_a_tolerance_is_refused_where_points_leave_their_chords(how, screen):
    told = f"`tolerance` is kept against the light integral.*`{next(iter(how))}=.*; give `{TOLD[screen]}`, or points with"
    settings = js.Settings(tolerance=0.01, integrator="segments", screen=screen)
    with pytest.raises(ValueError, match=told):
        js.render(js.Scene(points=points(**how)), camera(), settings)


def test_slopes_of_feet_are_those_of_differences(x64):
    """Of all numbers of points, some of them splats, away from where a foot comes to lie in another sample."""
    few, rng = {"width": 4, "height": 3}, np.random.default_rng(4)
    columns = rng.uniform(-0.5, 0.5, (6, 3)), rng.uniform(0.3, 0.6, 6), rng.uniform(0.1, 0.9, (6, 3)), rng.uniform(1, 3, 6)
    some, settings = js.Points.from_arrays(*columns, spread="feet", splats_beyond=3.4, capacity=6), js.Settings(samples=8)
    view = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), camera(**few))
    plan = js.plan(js.Scene(points=some), view, settings)

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def sloped(columns):
        def light(columns):
            changed = dataclasses.replace(some, **columns)
            return (js.render(js.Scene(points=changed), view, settings, plan=plan).color ** 2).sum()

        return jax.value_and_grad(light)(columns)

    given = {name: np.asarray(getattr(some, name)) for name in ("position", "radius", "color", "extinction")}
    _, slopes = sloped(given)
    for name, values in given.items():
        way, step = rng.normal(size=values.shape), 1e-7
        ahead, behind = (float(sloped(given | {name: values + sign * step * way})[0]) for sign in (1, -1))
        assert np.isfinite(slopes[name]).all() and abs((slopes[name] * way).sum()) > 1e-3
        assert (ahead - behind) / (2 * step) == pytest.approx(float((slopes[name] * way).sum()), rel=1e-5)


def test_an_eye_among_points_sees_them_from_inside():
    assert_is_reference(js.Scene(points=points()), camera(distance=0.3))


def test_points_that_touch_only_the_ends_of_rays_are_met():
    """They lie before the first sample and behind the last one, within the intervals that those stand for."""
    view = js.Camera.look_at((0, 0, 0), (0, 0, 1), width=WIDTH, height=HEIGHT, near=1.0, far=3.0)
    told = jax.tree.map(np.asarray, view)
    rays = [told.axes.T @ np.stack([told.column(x + 0.5), told.row(y + 0.5), 1.0]) for x, y in ((10, 9), (4, 5))]
    first, last = 3.0 ** (np.array([0.5, 23.5]) / 24)
    assert first > 1 + 2 * 0.008 and last < 3 - 2 * 0.03
    ends = points(np.stack([1.008 * rays[0], 2.97 * rays[1]]), [0.008, 0.03], COLOR[:2], [100.0, 30.0])
    assert_is_reference(js.Scene(points=ends), view)
    left = np.asarray(shown(js.Scene(points=ends), view).transmittance)
    assert left[9, 10] < 0.7 and left[5, 4] < 0.7


@pytest.mark.slow
def test_a_single_sample_stands_for_all_of_a_ray():
    scene, view, one = js.Scene(points=points()), camera(), js.Settings(samples=1)
    assert (error_of(js.render(scene, view, one), js.reference.render(scene, view, one)) <= 1e-4).mean() >= 0.999


MIXES = "extinction", pytest.param("opacity", marks=pytest.mark.slow)


@pytest.mark.parametrize("mix", MIXES)
def test_points_among_a_volume_and_particles_are_those_of_the_reference(mix):
    several = (
        points(position=POSITION[:20], radius=RADIUS[:20], color=COLOR[:20], extinction=EXTINCTION[:20]),
        points(profile="ball"),
    )
    assert_is_reference(js.Scene(points=several, mix=mix, **field(), **particles()), camera())


@pytest.mark.slow
def test_two_volumes_share_rays():
    first, second = field(), field()
    both = {name: (first[name], dataclasses.replace(second[name])) for name in first}
    moved = js.Volume.from_array(np.asarray(first["volume"].values)[::-1], (-0.2, -0.9, -1.4), 0.35)
    assert_is_reference(js.Scene(**(both | {"volume": (first["volume"], moved)})), camera())


@pytest.mark.parametrize("mix", MIXES)
def test_a_medium_that_is_absent_or_empty_changes_no_bit(mix):
    nobody = js.Points.from_arrays(np.zeros((0, 3)), 1.0, extinction=1.0, capacity=CAPACITY)
    empty = field(volume_transfer=js.TransferFunction.from_points([0.0, 0.5, 1.0], [[1, 1, 1]] * 3, [0.0] * 3))
    gas, alone = (shown(js.Scene(mix=mix, **parts)) for parts in (field(), {"points": points()}))
    for image, parts in (
        (gas, {**field(), "points": nobody}),
        (alone, {**empty, "points": points()}),
        (alone, {"points": (points(), nobody)}),
    ):
        same_bits(shown(js.Scene(mix=mix, **parts)), image)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def traced(scene):
    return js.render(scene, camera(), SETTINGS, plan=PLAN)


@pytest.mark.parametrize("name", ["position", "radius", "color", "extinction"])
def test_numbers_that_mean_nothing_are_a_fault_under_jit(name):
    scene = js.Scene(points=points())
    broken = spoilt(scene.points, name, np.nan, 3)
    image = traced(dataclasses.replace(scene, points=broken))
    assert "a point has" in faults.describe(int(image.faults)) and np.isfinite(image.color).all()
    with pytest.raises(ValueError, match="a point has"):
        shown(dataclasses.replace(scene, points=broken))


def test_all_points_in_one_place_are_all_counted():
    crowd = js.Points.from_arrays(np.zeros((CAPACITY, 3)), 0.3, (1, 1, 1), 10 / CAPACITY, capacity=CAPACITY)
    one = js.Points.from_arrays(np.zeros((1, 3)), 0.3, (1, 1, 1), 10.0, capacity=CAPACITY)
    together, alone = (shown(js.Scene(points=some)) for some in (crowd, one))
    np.testing.assert_allclose(together.color, alone.color, atol=1e-5)
