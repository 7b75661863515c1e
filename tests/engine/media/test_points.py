"""Points are what the reference says of them, wherever they are, however they are spread, among whatever else there is."""

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
from jaxsph.engine.planning.plan import Plan
from jaxsph.numerics import faults

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=24)
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
    where = {"eye": (0.3 * distance, 0.4 * distance, -distance), "target": (0.0, 0.0, 0.0), "width": WIDTH, "height": HEIGHT}
    where |= {"near": max(distance - 1.5, 0.05), "far": distance + 1.5} | more
    if projection == "orthographic":
        return js.Camera.orthographic(**where, view_height=2.5)
    return js.Camera.look_at(**where, fov_degrees=50.0)


def fog(lower, spacing, extinction):
    """Red and the same everywhere in a box."""
    look = js.TransferFunction.from_points([0.0, 0.5, 1.0], [[1, 0, 0]] * 3, [extinction] * 3)
    return {"volume": js.Volume.from_array(np.ones((6, 7, 5), np.float32), lower, spacing), "volume_transfer": look}


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


def off(image, truth):
    """Largest difference of colour and transmittance."""
    color = np.abs(np.asarray(image.color, float) - truth.color).max(-1)
    return np.maximum(color, np.abs(np.asarray(image.transmittance, float) - truth.transmittance))


def assert_is_reference(scene, view):
    error = off(shown(scene, view), js.reference.render(scene, view, SETTINGS))
    assert (error <= 1e-4).mean() >= 0.999, f"{(error > 1e-4).sum()} of {error.size} pixels, worst {error.max()}"


@pytest.mark.parametrize(
    ("spread", "projection"),
    [
        ("chords", "perspective"),
        ("centres", "orthographic"),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in (("chords", "orthographic"), ("centres", "perspective"))),
    ],
)
def test_an_image_is_that_of_the_reference(spread, projection):
    assert_is_reference(js.Scene(points=points(spread=spread)), camera(projection))


TABLE = np.exp(-3 * np.linspace(0, 1, 33) ** 2).astype(np.float32)


@pytest.mark.parametrize(
    "profile",
    [
        pytest.param("ball", marks=pytest.mark.slow),
        pytest.param(TABLE, id="table", marks=pytest.mark.slow),
        pytest.param(shaped, id="shaped"),
        pytest.param("gaussian", id="splats", marks=pytest.mark.slow),
    ],
)
def test_any_profile_is_that_of_the_reference(profile):
    more = {"attributes": {"brightness": RNG.uniform(0.5, 1, COUNT)}} if profile is shaped else {}
    more |= {"splats_beyond": 3.0} if isinstance(profile, str) and profile == "gaussian" else {}
    assert_is_reference(js.Scene(points=points(profile=profile, **more)), camera())


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
    assert (off(js.render(scene, view, one), js.reference.render(scene, view, one)) <= 1e-4).mean() >= 0.999


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


def layers(front):
    """A sheet of red fog, and blue points in front of it or behind."""
    across = np.linspace(-0.6, 0.6, 8)
    place = np.stack([np.repeat(across, 8), np.tile(across, 8), np.full(64, -0.8 if front else 0.8)], 1)
    blue = js.Points.from_arrays(place, 0.25, (0, 0, 1), opacity=0.8, capacity=CAPACITY)
    return js.Scene(**fog((-2, -2, -0.2), (0.8, 0.7, 0.1), 4.0), points=blue)


@pytest.mark.slow
def test_to_swap_two_layers_in_depth_is_seen_and_no_pasting_of_their_images_shows_it():
    view = js.Camera.look_at((0, 0, -3), (0, 0, 0), width=WIDTH, height=HEIGHT, near=1.5, far=4.5)
    scenes = [layers(front) for front in (True, False)]
    front, behind = (shown(scene, view) for scene in scenes)
    middle = slice(HEIGHT // 2 - 2, HEIGHT // 2 + 2), slice(WIDTH // 2 - 2, WIDTH // 2 + 2)
    assert (np.asarray(front.color)[middle][..., 2] > 0.5).all() and (np.asarray(behind.color)[middle][..., 2] < 0.5).all()
    for scene, together in zip(scenes, (front, behind), strict=True):
        assert_is_reference(scene, view)
        gas = shown(js.Scene(volume=scene.volume, volume_transfer=scene.volume_transfer), view)
        alone = shown(js.Scene(points=scene.points), view)
        pasted = [one.color + one.transmittance[..., None] * other.color for one, other in ((gas, alone), (alone, gas))]
        wrong = [float(jnp.abs(image - together.color).max()) for image in pasted]
        assert min(wrong) < 1e-5 < 0.3 < max(wrong)  # one order of pasting is right here, the other one there


def test_what_is_mixed_within_a_fog_is_no_pasting_of_any_order():
    everywhere = fog((-2, -2, -2), 0.8, 1.0)
    given = {**everywhere, "points": points()}, {"points": points()}, everywhere
    together, alone, gas = (jax.tree.map(np.asarray, shown(js.Scene(**parts))) for parts in given)
    for one, other in ((gas, alone), (alone, gas)):
        assert np.abs(one.color + one.transmittance[..., None] * other.color - together.color).max() > 0.1


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
        again = shown(js.Scene(mix=mix, **parts))
        for name in ("color", "transmittance", "depth"):
            np.testing.assert_array_equal(getattr(again, name), getattr(image, name))


@functools.partial(jax.jit, compiler_options=QUICKLY)
def traced(scene):
    return js.render(scene, camera(), SETTINGS, plan=PLAN)


@pytest.mark.slow
def test_an_image_in_bands_is_the_same():
    scene, view = js.Scene(points=points(splats_beyond=3.0), **field()), camera()
    image, plan = js.render(scene, view, SETTINGS), js.plan(scene, view, SETTINGS)
    limited = dataclasses.replace(SETTINGS, memory_limit=plan.bytes // 2 + 40_000)
    assert js.plan(scene, view, limited).bands > 1
    in_bands = js.render(scene, view, limited)
    np.testing.assert_array_equal(in_bands.color, image.color)


@pytest.mark.slow
def test_a_quadtree_of_rays_shows_points_too():
    scene, view = js.Scene(points=points(), **field()), camera(width=40, height=30)
    every, chosen = (js.render(scene, view, js.Settings(samples=24, screen=screen)) for screen in ("pixels", "quadtree"))
    np.testing.assert_allclose(chosen.color, every.color, atol=2e-6)


def test_a_tolerance_is_refused_by_name_and_so_are_steps_of_any_length_under_a_trace():
    scene, view, steps = js.Scene(points=points()), camera(), js.Settings(samples=24, integrator="step_doubling")
    plan = dataclasses.replace(PLAN, integrator="step_doubling", step_tolerance=steps.step_tolerance)
    with pytest.raises(ValueError, match=r"`tolerance` does not cover `Scene\(points=...\)` yet"):
        js.render(scene, view, js.Settings(samples=24, integrator="samples", tolerance=0.01))
    with pytest.raises(ValueError, match=r"`Scene\(points=...\)` cannot answer.*`jaxsph.engine.media.octree_medium.in_octree`"):
        jax.eval_shape(lambda scene: js.render(scene, view, steps, plan=plan).color, scene)


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


def gentle():
    """Points and a volume in float64, none of whose rims is met so sharply that differences would not see a slope."""
    gas = field()
    values = np.asarray(gas["volume"].values, float)
    volume = js.Volume.from_array(values, np.float64((-1.1, -0.9, -1.0)), 0.4)
    some = points(radius=np.maximum(RADIUS, 0.15), color=0.2 + 0.5 * COLOR, extinction=2.0, capacity=COUNT)
    return js.Scene(points=some, volume=volume, volume_transfer=gas["volume_transfer"])


def moved(scene, view, step):
    """All numbers of a scene and its camera, moved by one step each."""
    some, gas = scene.points, scene.volume
    place = some.position + step["position"] * jnp.sin(jnp.arange(some.position.size)).reshape(-1, 3)
    some = dataclasses.replace(
        some,
        position=place,
        radius=some.radius * (1 + step["radius"]),
        color=some.color * (1 + step["color"] * some.position),
        extinction=some.extinction * (1 + step["extinction"]),
    )
    gas = dataclasses.replace(gas, values=gas.values * (1 + step["values"]))
    view = dataclasses.replace(
        view,
        eye=view.eye + step["eye"] * jnp.array([0.3, -0.2, 0.5]),
        half_height=view.half_height * (1 + step["opening"]),
        near=view.near * (1 + step["near"]),
    )
    return dataclasses.replace(scene, points=some, volume=gas), view


@pytest.mark.slow
def test_derivatives_of_media_that_are_mixed_by_opacity_are_those_of_differences_in_both_modes(x64):
    """By extinction: `test_conformance`."""
    names = "position", "radius", "color", "extinction", "values", "eye", "opening", "near"
    scene, view = dataclasses.replace(gentle(), mix="opacity"), camera()
    wide = jax.tree.map(lambda leaf: leaf.astype(jnp.float64), view)
    plan, settings = js.plan(scene, wide, SETTINGS), SETTINGS
    weights = np.random.default_rng(0).uniform(-1, 1, (HEIGHT, WIDTH, 4))
    still = {name: jnp.float64(0) for name in names}

    def total(step):
        shown, seen = moved(scene, wide, step)
        image = js.render(shown, seen, settings, plan=plan)
        return (jnp.concatenate([image.color, image.transmittance[..., None]], -1) * weights).sum()

    program = jax.jit(lambda at, move: (*jax.jvp(total, (at,), (move,)), jax.grad(total)(at)), compiler_options=QUICKLY)
    gradient = program(still, still)[2]
    for name in names:
        unit = still | {name: jnp.float64(1)}
        forward = float(program(still, unit)[1])
        ahead, behind = (float(program(still | {name: jnp.float64(step)}, still)[0]) for step in (1e-8, -1e-8))
        assert forward == pytest.approx(float(gradient[name]), rel=1e-9, abs=1e-9), name
        assert forward == pytest.approx((ahead - behind) / 2e-8, rel=1e-4, abs=1e-4), name
        assert abs(forward) > 1e-3, name


@pytest.mark.slow
def test_a_profile_is_learned(x64):
    table = jnp.linspace(1.0, 0.1, 5)
    given = points(radius=np.maximum(RADIUS, 0.15), extinction=2.0, profile=np.asarray(table), capacity=COUNT)
    view = camera()
    plan = js.plan(js.Scene(points=given), view, SETTINGS)

    def total(values):
        shown = dataclasses.replace(given, profile=dataclasses.replace(given.profile, values=values))
        return js.render(js.Scene(points=shown), view, SETTINGS, plan=plan).color.sum()

    program = jax.jit(jax.value_and_grad(total), compiler_options=QUICKLY)
    gradient = np.asarray(program(table)[1])
    for k in range(5):
        step = 1e-6 * np.eye(5)[k]
        assert gradient[k] == pytest.approx(float(program(table + step)[0] - program(table - step)[0]) / 2e-6, rel=1e-4)
