"""Projections against the float64 oracle, against what is known in closed form, and under the transforms of JAX."""

import dataclasses
import functools
import itertools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.analysis.projection.columns import _cubics, nesting, nesting_found
from jaxsph.analysis.projection.plan import ProjectionPlan, plan_projection
from jaxsph.analysis.projection.project import _cut
from jaxsph.engine.access.lists import ListPlan
from jaxsph.engine.request import scaled
from jaxsph.model.particles import columns, kernels
from jaxsph.model.particles.columns import emission_measure, held_by
from jaxsph.numerics import faults
from jaxsph.numerics.checks import array_of
from jaxsph.reference.where import lines, ray_coordinates, to_view

NAMES = sorted(kernels.KERNELS)
pytestmark = pytest.mark.usefixtures("quick_programs")
SIZE = {"width": 20, "height": 13}


CAPACITY = 256
LISTS = ListPlan(1, 2, 1024, 4096, 1)  # room for all that is projected here, such that programs are compiled once


def plan_of(pixel, capacity):
    kinds = ("cut", "shares", "whole") if pixel == "mean" else ("cut", "whole")  # no support has the pixels for others
    return ProjectionPlan(20, 13, capacity, pixel, 1, tuple((kind, LISTS) for kind in kinds))


@functools.cache
def jitted(pixel, plan, names):
    """One program of all stages, as few kinds of sums are asked for twice."""

    def projected(particles, camera, what, more):
        return js.project(particles, camera, *what, pixel=pixel, plan=plan, **more, **dict(names))

    return jax.jit(projected, compiler_options=QUICKLY)


def project(particles, camera, *what, pixel="mean", **more):
    names = tuple((name, value) for name, value in more.items() if isinstance(value, str))
    numbers = {name: value for name, value in more.items() if not isinstance(value, str)}
    return jitted(pixel, plan_of(pixel, particles.capacity), names)(particles, camera, what, numbers).check()


def particles_of(seed=0, kernel="cubic_spline", count=40, decades=1.2, dtype=np.float32):
    rng = np.random.default_rng(seed)
    support = 0.9 * 10 ** -rng.uniform(0, decades, count)
    columns = (rng.uniform(-1, 1, (count, 3)), support, rng.uniform(-1, 1, count), rng.uniform(0.1, 1, count))
    return js.Particles.from_arrays(*(column.astype(dtype) for column in columns), kernel, capacity=CAPACITY)


def camera_of(projection="orthographic", near=0.5, far=6.0, **more):
    place = {"eye": (1.0, 0.7, 2.9), "target": (0.05, 0, 0), "near": near, "far": far} | SIZE | more
    if projection == "orthographic":
        return js.Camera.orthographic(view_height=3.6, **place)
    return js.Camera.look_at(fov_degrees=55.0, **place)


PROJECTIONS = "orthographic", "perspective"
IN_TURN = set(zip(NAMES, itertools.cycle(PROJECTIONS))) | {("cubic_spline", projection) for projection in PROJECTIONS}


@functools.cache
def rays_in_turn(projection):
    """By the kernels that have their turn with this projection, in one program."""
    given = {name: particles_of(1, name) for name, of in sorted(IN_TURN) if of == projection}

    def found(given, camera):
        plan = plan_of("ray", CAPACITY)
        return {name: js.project(one, camera, pixel="ray", plan=plan).values for name, one in given.items()}

    return jax.jit(found, compiler_options=QUICKLY)(given, camera_of(projection))


@pytest.mark.parametrize(("kernel", "projection"), [
    pytest.param(*pair, marks=() if pair in IN_TURN else pytest.mark.slow) for pair in itertools.product(NAMES, PROJECTIONS)
])  # fmt: skip
def test_rays_are_those_of_the_oracle(kernel, projection):
    particles, camera = particles_of(1, kernel), camera_of(projection)
    truth = js.reference.project(particles, camera, pixel="ray").values
    together = (kernel, projection) in IN_TURN
    found = rays_in_turn(projection)[kernel] if together else project(particles, camera, pixel="ray").values
    np.testing.assert_allclose(found, truth, atol=3e-5 * truth.max())


@pytest.mark.parametrize("projection", ["orthographic", "perspective"])
def test_parts_of_rays_are_those_of_the_oracle_and_add_up(projection):
    particles, camera = particles_of(2), camera_of(projection, near=1.9, far=3.1)
    truth = js.reference.project(particles, camera, pixel="ray").values
    part = project(particles, camera, pixel="ray")
    np.testing.assert_allclose(part.values, truth, atol=3e-5 * truth.max())
    whole = project(particles, camera, pixel="ray", depth_range=(0.1, 9.0)).values
    others = [project(particles, camera, pixel="ray", depth_range=ends).values for ends in ((0.1, 1.9), (3.1, 9.0))]
    np.testing.assert_allclose(np.sum([part.values, *others], 0), whole, atol=3e-5 * truth.max())


@pytest.mark.parametrize(("projection", "near"), [("orthographic", 0.5), ("orthographic", 2.4), ("perspective", 2.4)])
def test_means_over_pixels_are_those_of_the_oracle(projection, near):
    particles, camera = particles_of(3, decades=0.15), camera_of(projection, near=near)
    truth = js.reference.project(particles, camera, subrays=12).values
    np.testing.assert_allclose(project(particles, camera).values, truth, atol=3e-4 * truth.max())


def test_means_of_large_supports_and_their_mass_are_those_of_the_oracle():
    rng = np.random.default_rng(3)
    particles = js.Particles.from_arrays(rng.uniform(-0.3, 0.3, (12, 3)), rng.uniform(0.5, 0.6, 12), 0.0, 1.0, "wendland_c2")
    camera = js.Camera.orthographic((0, 0, 5), (0, 0, 0), view_height=2.0, near=1, far=9, width=64, height=64)
    plan = js.plan_projection(particles, camera)
    image = jitted("mean", plan, ())(particles, camera, (), {}).check()
    assert [kind for kind, _ in plan.lists] == ["smooth"]
    truth = js.reference.project(particles, camera, subrays=6).values
    np.testing.assert_allclose(image.values, truth, atol=3e-5 * truth.max())
    assert float(image.total()) == pytest.approx(12, rel=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_interpolation_is_off_by_at_most_what_nesting_says(name):
    rng, number = np.random.default_rng(0), 24
    for spacings in (4.0, 6.5, 11.0):
        middle, fine = number / 2 + rng.uniform(-0.5, 0.5, 2), 8
        nodes, pixels = np.arange(number + 4) - 2, (np.arange(number * fine) + 0.5) / fine - 0.5
        of_nodes, truth = (
            columns.whole_column(name, ((at[:, None] - middle[0]) ** 2 + (at - middle[1]) ** 2) / spacings**2, np)
            for at in (nodes, pixels)
        )
        weights = _cubics(number * fine, fine)
        off = np.abs(weights @ of_nodes @ weights.T - truth).max() / columns.whole_column(name, np.float64(0), np)
        assert off < nesting(name) * spacings**-3.5


@pytest.mark.parametrize("name", NAMES)
def test_nesting_is_little_above_what_is_found(name):
    assert 1 <= nesting(name) / nesting_found(name) <= 1.15


@pytest.mark.parametrize("pixel", ["mean", pytest.param("ray", marks=pytest.mark.slow)])
def test_nested_supports_are_those_of_the_oracle_to_the_tolerance_with_derivatives(pixel):
    rng, tolerance = np.random.default_rng(3), 1e-2
    place, support = rng.uniform(-0.6, 0.6, (12, 3)), rng.uniform(0.5, 0.9, 12)
    particles = js.Particles.from_arrays(place, support, 0.0, support**2, "cubic_spline")  # such that all have one peak
    camera = js.Camera.orthographic((0, 0, 5), (0, 0, 0), view_height=2.0, near=1, far=9, width=70, height=61)
    plan = js.plan_projection(particles, camera, pixel=pixel, tolerance=tolerance)

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def found(place):
        def values(place):
            image = js.project(dataclasses.replace(particles, position=place), camera, pixel=pixel, plan=plan)
            return image.values[20, 30], image.values

        return jax.grad(values, has_aux=True)(place)

    def true(place):
        return js.reference.project(dataclasses.replace(particles, position=place), camera, pixel=pixel, subrays=4).values

    slope, values = map(np.asarray, found(particles.position))
    truth, step = true(particles.position), 1e-3 * rng.normal(size=place.shape).astype(np.float32)
    ahead, behind = (true(np.asarray(particles.position) + side * step)[20, 30] for side in (1, -1))
    peak = columns.whole_column("cubic_spline", np.float64(0), np)
    assert plan.levels == 2 and 1e-5 * peak < np.abs(values - truth).max() < tolerance * peak
    assert abs((slope * step).sum() - (ahead - behind) / 2) < 0.05 * abs(ahead - behind) / 2
    image = js.project(particles, camera, pixel=pixel, tolerance=tolerance)
    np.testing.assert_allclose(image.values, values, atol=2e-5 * truth.max())
    assert 0 < dict(image.metadata)["jaxsph.tolerance"] <= tolerance


def test_means_of_small_supports_are_those_of_the_oracle_where_rays_hardly_spread():
    particles = particles_of(3, count=20, decades=0.1)
    particles = dataclasses.replace(particles, support=array_of(0.4 * np.asarray(particles.support)))
    camera = js.Camera.look_at((10, 7, 29), (0.05, 0, 0), fov_degrees=6.5, near=25, far=40, **SIZE)
    truth = js.reference.project(particles, camera, subrays=24).values
    np.testing.assert_allclose(project(particles, camera).values, truth, atol=3e-3 * truth.max())


def test_double_precision_is_exact(x64):
    particles, camera = particles_of(4, "wendland_c2", dtype=np.float64), camera_of("perspective", near=np.float64(2.0))
    camera = jax.tree.map(lambda leaf: leaf.astype(np.float64), camera)
    truth = js.reference.project(particles, camera, pixel="ray").values
    found = project(particles, camera, pixel="ray").values
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, truth, atol=1e-9 * truth.max())


@pytest.mark.parametrize(
    "kernel", ["cubic_spline", *(pytest.param(name, marks=pytest.mark.slow) for name in ("poly6", "wendland_c2"))]
)
def test_no_mass_is_lost_however_small_supports_are(kernel):
    rng = np.random.default_rng(5)
    mass, pixel = rng.uniform(0.5, 2, 200).astype(np.float32), 2.6 / 13
    camera = js.Camera.orthographic((0, 0, 5), (0, 0, 0), view_height=2.6, near=0, far=10, **SIZE)
    for size in (4.0, 1e-3, 0.3, 1.7):
        position = rng.uniform(-1, 1, (200, 3)) * (2 - size * pixel, 1.3 - size * pixel, 1)
        particles = js.Particles.from_arrays(position, size * pixel, 0.0, mass, kernel, capacity=CAPACITY)
        assert abs(float(project(particles, camera).total()) / mass.sum() - 1) < 1.5e-6  # 1e-6, to its digit


def test_mass_between_two_depths_is_kept_where_they_cut_small_supports():
    rng = np.random.default_rng(6)
    position = rng.uniform(-1, 1, (200, 3)) * (1.5, 1, 0)
    particles = js.Particles.from_arrays(position, 0.05, 0.0, 1.0, "cubic_spline", capacity=CAPACITY)
    camera = js.Camera.orthographic((0, 0, 5), (0, 0, 0), view_height=2.6, near=0, far=5, **SIZE)
    assert abs(float(project(particles, camera).total()) / 100 - 1) < 1e-4


@pytest.mark.parametrize(
    ("kernel", "spacings"), [("cubic_spline", 4.2), pytest.param("wendland_c2", 5.2, marks=pytest.mark.slow)]
)
def test_a_uniform_box_has_its_column_density_to_7e_5(kernel, spacings):
    axis = (np.arange(24) + 0.5) / 12 - 1
    position = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    particles = js.Particles.from_arrays(position, spacings / 12, 0.0, 3.0 * 12.0**-3, kernel)
    turned = js.Camera.orthographic((0, 0, 5), (0, 0, 0), view_height=0.7, near=1, far=9, **SIZE)
    plan = plan_projection(particles, turned)
    (_, lists), *_ = plan.lists
    plan = dataclasses.replace(plan, lists=(*plan.lists, ("cut", lists)))  # where depths do
    found = functools.partial(jitted("mean", plan, ()), particles, turned, ())
    np.testing.assert_allclose(found({"depth_range": (1.0, 9.0)}).check().values, 3.0 * 2, rtol=7e-5)
    part = found({"depth_range": (4.6, 5.3)}).check().values
    np.testing.assert_allclose(part, 3.0 * 0.7, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("spacings", "ends"), [(4.0, (1, 9)), (4.0, (4.25, 5.75))], ids=["pixels", "depths"])
def test_a_plan_has_room_however_programs_round(spacings, ends, monkeypatch):
    """Of a lattice, whole layers lie on borders of pixels and at the ends of depths: a plan without any slack still serves."""
    monkeypatch.setattr(sys.modules["jaxsph.analysis.projection.plan"], "capacity_class", lambda count: count)
    axis = (np.arange(12) - 6) / 8
    position = np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)
    view = js.Camera.orthographic((0, 0, 5), (0, 0, 0), view_height=13 / 8, near=ends[0], far=ends[1], **SIZE)
    particles = js.Particles.from_arrays(position, spacings / 8, 0.0, 1.0)
    plan = plan_projection(particles, view)
    eps, still = np.finfo(np.float32).eps, js.project(particles, view, plan=plan).values
    for seed in range(3):
        off = np.random.default_rng(seed).uniform(-3, 3, (2, len(position), 3)) * eps
        moved = js.Particles.from_arrays(position + off[0], spacings / 8 * (1 + off[1][:, 0]), 0.0, 1.0)
        image = js.project(moved, view, plan=plan)
        np.testing.assert_allclose(image.values, still, rtol=1e-4, atol=1e-4)


def test_small_points_seen_in_perspective_keep_their_mass():
    rng = np.random.default_rng(7)
    position = rng.uniform(-0.5, 0.5, (100, 3))
    particles = js.Particles.from_arrays(position, 1e-3, 0.0, 1.0, "cubic_spline", capacity=CAPACITY)
    camera = js.Camera.look_at((0, 0.1, 3), (0, 0, 0), near=1, far=5, **SIZE)
    offset = position - camera.exact_eye()
    depth = offset @ np.asarray(camera.axes, np.float64)[2]
    seen = (np.linalg.norm(offset, axis=1) / depth**3).sum()  # of 1 / area at each depth, along slanted rays
    image = project(particles, camera)
    assert abs(float(np.asarray(image.values).sum() * image.pixel_area) / seen - 1) < 1e-4


def test_a_mean_of_a_constant_is_that_constant_and_nothing_where_nothing_is():
    particles = dataclasses.replace(particles_of(8, decades=0.2), quantity=jnp.full(CAPACITY, 7.0))
    image = project(particles, camera_of(), weight="volume")
    values, weight = np.asarray(image.values), np.asarray(image.weight)
    np.testing.assert_allclose(values[weight > 0], 7.0, rtol=2e-6)
    assert np.isnan(values[weight == 0]).all() and (weight == 0).any()


def test_means_are_those_of_the_oracle():
    particles, camera = particles_of(9, decades=0.3), camera_of()
    mass = np.random.default_rng(0).uniform(1e40, 2e40, particles.num_particles)  # that float32 cannot hold
    found, truth = (one(particles, camera, weight=mass) for one in (js.project, js.reference.project))
    solid = truth.weight > 1e-3 * truth.weight.max()
    np.testing.assert_allclose(np.asarray(found.values)[solid], truth.values[solid], atol=2e-3)


def test_amounts_that_float32_cannot_hold_are_projected():
    particles, camera = particles_of(10), camera_of()
    large = dataclasses.replace(particles, position=100 * particles.position, support=100 * particles.support)
    place = {"near": 50, "far": 600, "view_height": 360} | SIZE
    camera = js.Camera.orthographic((100, 70, 290), (5, 0, 0), **place)
    mass = np.full(particles.num_particles, 1e39)
    truth = js.reference.project(large, camera, mass, pixel="ray").values
    np.testing.assert_allclose(js.project(large, camera, mass, pixel="ray").values, truth, atol=3e-5 * truth.max())


def test_emission_of_power_one_is_the_column_density_and_others_weigh_by_density():
    mass, density = np.array([1.0, 2.0]), np.array([3.0, 5.0])
    np.testing.assert_allclose(emission_measure(mass, density, power=1), mass)
    np.testing.assert_allclose(emission_measure(mass, density, 0.5), 0.5 * density * mass)
    np.testing.assert_allclose(jax.jit(emission_measure)(mass, density), density * mass, rtol=1e-6)


def test_a_plan_grows_to_what_is_needed():
    few, many, camera = particles_of(15, count=10), particles_of(16), camera_of()
    small, large = plan_projection(few, camera), plan_projection(many, camera)
    grown = plan_projection(many, camera, like=small)
    for kind, lists in large.lists:
        assert dict(grown.lists)[kind].list_capacity >= lists.list_capacity
    assert plan_projection(few, camera, like=grown) == grown
    np.testing.assert_allclose(*(jitted("mean", plan, ())(few, camera, (), {}).values for plan in (small, grown)), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("pixel", ["mean", "ray"])
def test_bands_change_nothing(pixel):
    particles = particles_of(11)
    camera = camera_of(height=40)
    whole = plan_projection(particles, camera, pixel=pixel)
    cut = dataclasses.replace(whole, bands=3)
    cut = dataclasses.replace(cut, lists=tuple((kind, dataclasses.replace(one, tile_rows=1)) for kind, one in cut.lists))
    images = [js.project(particles, camera, pixel=pixel, plan=plan).values for plan in (whole, cut)]
    np.testing.assert_allclose(*images, rtol=1e-5, atol=1e-6 * np.max(images[0]))


@pytest.mark.parametrize(
    ("pixel", "projection"),
    [
        ("mean", "orthographic"),
        pytest.param("ray", "perspective", marks=pytest.mark.slow),
        pytest.param("mean", "perspective", marks=pytest.mark.slow),
        pytest.param("ray", "orthographic", marks=pytest.mark.slow),
    ],
)
def test_gradients_are_those_of_differences(pixel, projection, x64):
    particles = particles_of(12, "wendland_c2", 12, decades=1.0, dtype=np.float64)
    camera = jax.tree.map(lambda leaf: leaf.astype(np.float64), camera_of(projection, near=2.2, far=3.4))
    plan = plan_projection(particles, camera, pixel=pixel)
    pattern = np.random.default_rng(0).normal(size=(13, 20))

    def loss(position, support, mass, eye, far):
        moved = dataclasses.replace(particles, position=position, support=support)
        seen = dataclasses.replace(camera, eye=eye, far=far)
        return (js.project(moved, seen, mass, pixel=pixel, plan=plan).values * pattern).sum()

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def looked(inputs, moves):
        return *jax.jvp(loss, inputs, moves), jax.grad(loss, argnums=(0, 1, 2, 3, 4))(*inputs)

    inputs = tuple(map(np.asarray, (particles.position, particles.support, np.linspace(1, 2, CAPACITY), camera.eye, camera.far)))
    rng = np.random.default_rng(1)
    moves = tuple(np.asarray(rng.normal(size=np.shape(value))) for value in inputs)
    _, forward, pulled = jax.tree.map(np.asarray, looked(inputs, moves))
    step = 1e-5
    ends = [
        float(looked(tuple(value + side * step * move for value, move in zip(inputs, moves, strict=True)), moves)[0])
        for side in (1, -1)
    ]
    wanted = (ends[0] - ends[1]) / (2 * step)
    backward = sum((cotangent * move).sum() for cotangent, move in zip(pulled, moves, strict=True))
    assert abs(forward - wanted) < 2e-6 * abs(wanted) + 1e-6
    assert abs(backward - forward) < 1e-9 * abs(forward) + 1e-9


def test_one_program_serves_moved_particles_and_many_at_once():
    particles, camera = particles_of(13), camera_of()
    plan = plan_projection(particles, camera)

    def shifted(shift):
        moved = dataclasses.replace(particles, position=particles.position + shift)
        return js.project(moved, camera, plan=plan).values

    together = np.asarray(jax.jit(jax.vmap(shifted), compiler_options=QUICKLY)(np.float32([0, 0.02])))
    np.testing.assert_allclose(together[0], project(particles, camera).values, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(together[1], jax.jit(shifted, compiler_options=QUICKLY)(0.02), rtol=1e-5, atol=1e-5)


def test_a_plan_is_an_argument_of_jit_and_one_that_is_too_small_is_refused_or_a_fault_that_check_raises():
    particles, camera = particles_of(14), camera_of()
    plan = js.plan_projection(particles, camera, pixel="ray")
    small = dataclasses.replace(plan, lists=tuple((kind, dataclasses.replace(one, list_capacity=3)) for kind, one in plan.lists))
    draw = jax.jit(lambda particles, plan: js.project(particles, camera, pixel="ray", plan=plan), compiler_options=QUICKLY)
    made = draw(particles, small)
    assert len(made.fault_messages) == 1 and int(made.faults) & faults.LIST_OVERFLOW
    with pytest.raises(js.CapacityError, match="plan_projection"):
        js.project(particles, camera, pixel="ray", plan=small)
    for refused in (made.check, lambda: js.project(particles, camera, pixel="ray", plan=dataclasses.replace(plan, lists=()))):
        with pytest.raises(js.CapacityError, match=r"make a new (plan|one) with `(jaxsph.)?plan_projection`"):
            refused()
    assert "plan_projection" in made.fault_messages[0]
    sound = jitted("ray", plan, ())(particles, camera, (), {})
    assert sound.check() is sound and sound.fault_messages == ()


def test_nothing_is_nothing():
    empty = js.Particles.from_arrays(np.zeros((0, 3)), 1.0, 1.0)
    image = js.project(empty, camera_of())
    assert (np.asarray(image.values) == 0).all() and image.to_uint8().shape == (13, 20, 3)


def test_the_share_that_depths_leave_out_is_that_of_the_particles_in_the_picture():
    position = np.array([[0, 0, 1.0], [0.5, 0.2, -1.0], [0, 0.5, 0], [50.0, 0, 2.5]])  # depths 2, 4, 3 and, beside it, 0.5
    particles = js.Particles.from_arrays(position, 0.4, 0.0, kernel="cubic_spline", capacity=CAPACITY)
    mass = np.array([3.0, 1.0, -4.0, 9.0])
    for projection in PROJECTIONS:
        camera = camera_of(projection, eye=(0, 0, 3), target=(0, 0, 0), near=2.5, far=6.0)
        assert _cut(particles, camera, held_by(particles, mass, None)) == pytest.approx(3 / 8)
        assert _cut(particles, camera, held_by(particles, mass, mass**2)) == pytest.approx(9 / 26)
        assert _cut(particles, dataclasses.replace(camera, near=1.0), held_by(particles, mass, None)) == 0
    traced = project(particles, camera, np.pad(mass, (0, CAPACITY - 4)))
    told = dataclasses.replace(traced, metadata=(("jaxsph.cut", 0.375),))
    assert traced.cut == 0 and told.cut == 0.375 and "37.5% cut off by depths" in repr(told)


@examples(25)
@given(
    st.integers(0, 2**31), st.sampled_from(PROJECTIONS), st.sampled_from(["ray", "mean"]), st.sampled_from([(0.5, 6), (2, 2.6)])
)
def test_the_largest_along_a_ray_is_that_of_the_particles_it_meets(seed, projection, pixel, depths):
    """By brute force; supports of a tenth of a pixel to three; a ray within rounding of an edge may or may not meet it."""
    particles, camera = particles_of(seed), camera_of(projection)
    found = js.project(particles, camera, along="max", pixel=pixel, depth_range=depths)
    columns, count = particles.to_numpy(), particles.num_particles
    view = to_view(particles.exact_position()[:count], camera)
    u, v = np.meshgrid(*ray_coordinates(camera, np.arange(20) + 0.5, np.arange(13) + 0.5))
    start, ahead = (one[..., None, :] for one in lines(u, v, camera.is_perspective))
    support = columns["support"].astype(np.float64)
    if pixel == "mean":
        side = 2 * float(camera.half_height) / 13 * (view[:, 2] if camera.is_perspective else 1)
        support = np.maximum(support, side / np.sqrt(2))
    slant = np.linalg.norm(ahead, axis=-1)
    foot = ((view - start) * ahead).sum(-1) / slant**2
    away = np.linalg.norm(start + foot[..., None] * ahead - view, axis=-1) / support
    bounds = []
    for slack in (-1e-9, 1e-9):
        half = np.sqrt(np.maximum((1 + slack) ** 2 - away**2, 0)) * support / slant
        met = (away < 1 + slack) & (foot + half >= depths[0] - slack) & (foot - half <= depths[1] + slack)
        bounds.append(np.where(met, columns["quantity"], -np.inf).max(-1))
    values = np.where(np.isnan(found.values), -np.inf, found.values)
    assert (bounds[0] <= values).all() and (values <= bounds[1]).all() and not np.isfinite(values[bounds[1] == -np.inf]).any()
    assert set(values[np.isfinite(values)].tolist()) <= set(columns["quantity"].tolist())
    np.testing.assert_array_equal(np.asarray(found.weight) > 0, np.isfinite(values))


def test_the_largest_of_a_periodic_set_is_that_of_its_copies_between_the_faces():
    rng, sides = np.random.default_rng(3), np.array([1.5, 1.0, 0.75])
    others, position = (rng.uniform(0.05, 0.3, 30), rng.uniform(-1, 1, 30)), rng.uniform(0, 1, (30, 3)) * sides
    one = js.Particles.from_arrays(position, *others, 1.0, "cubic_spline", box=sides)
    copies = np.concatenate([position + sides * turn for turn in itertools.product((-1, 0, 1), repeat=3)])
    all_of_them = js.Particles.from_arrays(copies, *(np.tile(column, 27) for column in others), 1.0, "cubic_spline")
    camera = js.Camera.along_axis(one, "z", 18, 12)
    eye = float(camera.exact_eye()[2])
    truth = js.project(all_of_them, camera, along="max", pixel="ray", depth_range=(eye - 0.75, eye))
    np.testing.assert_array_equal(js.project(one, camera, along="max", pixel="ray").values, truth.values)


def test_the_largest_is_exact_and_takes_no_tolerance_and_no_plan():
    for name, value in (("tolerance", 0.1), ("plan", plan_of("mean", CAPACITY))):
        with pytest.raises(ValueError, match=rf"`{name}` is of sums .* leave it out"):
            js.project(particles_of(), camera_of(), along="max", **{name: value})


@pytest.mark.parametrize("along", ["sum", "mean", "dispersion", "max"])
def test_of_a_scene_those_are_projected_whose_centres_its_clip_leaves(along):
    given, camera = particles_of(4), camera_of()
    position, mass = given.exact_position()[:40], np.exp(np.random.default_rng(4).normal(size=40))
    inside, columns = position[:, 0] > 0.1, {name: column[:40] for name, column in given.to_numpy().items()}
    left = {name: column[inside] for name, column in columns.items()}
    clip = ~js.Box((-2, -2, -2), (0.1, 2, 2))
    weight, more = (None, mass)[along in ("mean", "dispersion")], {"along": along}
    more |= {} if along == "max" else {"plan": plan_of("mean", CAPACITY)}
    truth = js.project(
        js.Particles.from_arrays(**left, kernel=given.kernel, capacity=CAPACITY),
        camera, mass[inside] ** 2, weight if weight is None else weight[inside], **more,
    )  # fmt: skip
    found = js.project(js.Scene(particles=given, within=clip), camera, mass**2, weight, **more)
    np.testing.assert_allclose(found.values, truth.values, rtol=1e-4, atol=1e-4)
    if along == "max":  # of a period what is in its box, wherever its positions are
        columns["position"] = position + [4, 0, -4]
        moved = js.Particles.from_arrays(**columns, kernel=given.kernel, box=(4, 4, 4)).centered((0, 0, 0))
        unmoved = dataclasses.replace(moved, position=array_of(np.float32(moved.exact_position() + [0, 4, 0])))
        for one in (moved, unmoved):
            found = js.project(js.Scene(particles=one, within=clip), camera, mass**2, along="max", pixel="mean")
            np.testing.assert_array_equal(found.values, truth.values)


@pytest.mark.parametrize("offset", [0.0, 3e3])
def test_a_dispersion_is_that_of_the_values_less_their_mean_and_has_finite_slopes(offset):
    particles, camera = particles_of(4), camera_of()
    speed, mass = np.random.default_rng(4).normal(size=(2, 40))
    mass, plan = np.exp(mass), plan_of("mean", CAPACITY)
    found = js.project(particles, camera, offset + speed, mass, along="dispersion", plan=plan)
    mean, square = (js.project(particles, camera, speed**k, mass, plan=plan).values.astype(np.float64) for k in (1, 2))
    truth = np.sqrt(np.maximum(square - mean**2, 0))
    np.testing.assert_allclose(found.values, truth, atol=3e-3 * speed.std())  # of one particle a root of rounding is left

    def spread(of):
        return jnp.nansum(js.project(particles, camera, of, mass, along="dispersion", plan=plan).values)

    slopes = jax.jit(jax.grad(spread), compiler_options=QUICKLY)(speed)
    assert np.isfinite(slopes).all() and np.abs(slopes).max() > 0


@pytest.mark.parametrize("projection", ["orthographic", pytest.param("perspective", marks=pytest.mark.slow)])
def test_a_projection_in_any_unit_of_length_has_the_same_digits(projection):
    rng = np.random.default_rng(5)
    mass = rng.uniform(1, 2, 24)
    particles = js.Particles.from_arrays(rng.uniform(-1, 1, (24, 3)), rng.uniform(0.2, 0.5, 24), mass, kernel="cubic_spline")
    camera = js.Camera.look_at((0, 0, -3), (0, 0, 0), **SIZE, near=1, far=5)
    if projection == "orthographic":
        camera = js.Camera.orthographic((0, 0, -3), (0, 0, 0), view_height=1.6, **SIZE, near=1, far=5)
    for weight in (None, mass):
        image = js.project(particles, camera, of=mass, weight=weight)
        for digits in (-80, 45, 80):
            unit = 2.0 ** (2 * digits)  # of the amounts, such that those over an area are numbers of float32
            moved, seen = scaled(particles, digits), scaled(camera, digits)
            other = js.project(
                moved, seen, of=mass * (unit if weight is None else 1), weight=None if weight is None else mass * unit
            )
            np.testing.assert_array_equal(other.values, image.values)
            assert dict(other.metadata)["jaxsph.camera"] == seen.describe()
            if projection == "orthographic":
                assert float(other.pixel_area) == float(image.pixel_area) * unit
                if weight is None:
                    assert float(other.total()) == pytest.approx(float(image.total()) * unit, rel=1e-6)
                else:
                    np.testing.assert_array_equal(other.weight, image.weight)


def test_particles_beside_the_picture_are_no_fault():
    """The only ones that no depth cuts, and all there are."""
    position = np.array([[0, 0, 0.9], [0.2, 0.1, -0.9], [5, 0, 0.1]])
    particles = js.Particles.from_arrays(position, 0.5, [1.0, 2.0, 3.0], kernel="cubic_spline")
    for middle, there in ((0.0, True), (30.0, False)):
        for pixel in ("mean", "ray"):
            camera = js.Camera.orthographic((middle, 0, 3), (middle, 0, 0), view_height=1.5, near=2.2, far=3.8, **SIZE)
            found = np.asarray(js.project(particles, camera, of=np.ones(3), pixel=pixel).values)
            assert np.isfinite(found).all() and (found.max() > 0) == there
