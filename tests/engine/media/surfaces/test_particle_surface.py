"""The surface of particles is where their coverage first crosses its level, lit by its gradient; derivatives are implicit."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import AGREE, QUICKLY, along, stepped, still
from hypothesis import given, strategies as st
from surfaced import ball, crossing, view_of_ball

import jaxsph as js
from jaxsph.engine.access.view import view_particles
from jaxsph.engine.media.surfaces.particle_surface import ParticleSurface, Surroundings
from jaxsph.numerics import faults
from jaxsph.reference.where import ray_coordinates, to_view

pytestmark = pytest.mark.usefixtures("quick_programs")

WIDTH, HEIGHT, AMBIENT = 16, 14, 0.2
SETTINGS, COARSE = js.Settings(samples=40), js.Settings(samples=8)
CLOSE = 1e-5  # of the least support, what a depth may be off in float32
ALL = js.Plane((0.0, 0.0, 9.0), (0.0, 0.0, -1.0))  # a clip of nothing, whose programs are those of one that cuts
GRAZED = 2e-3  # of the level: a field that comes so near to it without crossing may be on either side of rounding
ZERO = [np.zeros((1, 1), np.float32)] * 3
STEP = 1e-6  # of a difference: so small that no other ray meets the surface
DIFFERENCE = 1e-6  # of the sum of a slope's terms, what one may be off


def camera(projection="perspective", **more):
    return view_of_ball(projection, WIDTH, HEIGHT, **more)


def check(scene, view, settings=SETTINGS, close=CLOSE, within=None):
    """Depths of all pixels against those by definition; pixels that the field nearly reaches may be on either side."""
    image, truth = js.render(scene, view, settings), crossing(scene, view, within)
    depth = np.asarray(image.depth, np.float64)
    sure = truth.clearance > GRAZED
    met = np.isfinite(truth.depth)
    assert met.sum() > 40
    np.testing.assert_array_equal(np.isfinite(depth)[sure], met[sure])
    np.testing.assert_array_equal(1 - np.asarray(image.transmittance), np.isfinite(depth))
    both = sure & met
    steep = np.abs(truth.facing) > 0.02
    assert np.abs(depth[both & steep] - truth.depth[both & steep]).max() <= close * np.asarray(scene.particles.support).min()
    return image, truth, both


@pytest.mark.parametrize(
    ("projection", "integrator", "kernel", "smoothing"),
    [
        ("perspective", "samples", "cubic_spline", 1.0),
        pytest.param("orthographic", "segments", "wendland_c2", 1.4, marks=pytest.mark.slow),
        pytest.param("orthographic", "samples", "poly6", 0.9, marks=pytest.mark.slow),
    ],
)
def test_a_ball_is_in_its_place_without_holes_and_lit_by_its_gradient(projection, integrator, kernel, smoothing):
    look = js.TransferFunction.from_points([-0.5, 0.5], [[0.1, 0.5, 0.9], [0.9, 0.5, 0.1]], [1.0, 1.0])
    surface = js.Surface(0.45, smoothing=smoothing, ambient=AMBIENT)
    scene = js.Scene(particles=ball(kernel), transfer=look, surface=surface)
    view = camera(projection)
    image, truth, both = check(scene, view, dataclasses.replace(SETTINGS, integrator=integrator))
    share = (truth.quantity + 0.5)[..., None]
    wanted = np.array([0.1, 0.5, 0.9]) * (1 - share) + np.array([0.9, 0.5, 0.1]) * share
    wanted = wanted * (AMBIENT + (1 - AMBIENT) * truth.facing)[..., None]
    np.testing.assert_allclose(np.asarray(image.color)[both], wanted[both], atol=1e-3)
    in_view = np.asarray(image.normal, np.float64) @ np.asarray(view.axes, np.float64).T
    np.testing.assert_allclose(in_view[both], truth.normal[both], atol=1e-3)
    np.testing.assert_array_equal(in_view[np.isinf(truth.depth)], 0)
    np.testing.assert_array_equal(np.asarray(image.color)[np.isinf(truth.depth)], 0)
    assert image.stats["evaluations"] > 0


def lit(level=0.45, **more):
    surface = js.Surface(level, color=(0.8, 0.6, 0.4), ambient=AMBIENT)
    return js.Scene(particles=ball(), surface=surface, **({"within": ALL} | more))


@pytest.mark.parametrize("settings", [SETTINGS, COARSE], ids=["fine", "coarse"])
def test_nothing_is_certified_of_what_samples_may_miss(settings):
    """At no number of samples, eagerly or under a trace."""
    images = [js.render(lit(), camera(), settings)]
    if settings is COARSE:
        plan = js.plan(lit(), camera(), settings)
        images.append(jax.jit(lambda of: js.render(of, camera(), settings, plan=plan), compiler_options=QUICKLY)(lit()))
    for image in images:
        assert not image.certified and not image.faults and (np.asarray(image.error_bound) == np.inf).all()
    assert "not certified" in repr(images[0]) and "error at most" not in images[0]._repr_html_()


def test_in_double_precision_depths_are_good_to_many_digits(x64):
    scene = js.Scene(particles=ball(dtype=np.float64), surface=js.Surface(0.45))
    view = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), camera())
    image, *_ = check(scene, view, close=1e-7)
    assert image.depth.dtype == jnp.float64


def test_a_lower_level_lies_farther_out_and_compiles_nothing(compiled):
    high = js.render(lit(), camera(), SETTINGS).depth
    compiled.clear()
    low = js.render(lit(0.3), camera(), SETTINGS).depth
    assert (np.asarray(low) <= np.asarray(high)).all() and not compiled


def test_what_is_not_exact_is_no_farther_in_front_than_the_surface_and_near_it_where_rays_do_not_graze():
    scene = lit(within=None)
    found, rough = (
        js.render(dataclasses.replace(scene, surface=dataclasses.replace(scene.surface, exact=exact)), camera(), SETTINGS)
        for exact in (True, False)
    )
    depth, other = (np.asarray(one.depth, np.float64) for one in (found, rough))
    support = np.asarray(scene.particles.support).min()
    met = np.isfinite(other)
    assert met.sum() > 40 and np.isfinite(depth[met]).all() and (other[met] >= depth[met] - 0.01 * support).all()
    steep = met & (np.abs(crossing(scene, camera()).facing) > 0.3)
    assert np.abs((other - depth)[steep]).max() <= 0.01 * support
    assert not np.asarray(rough.color)[~met].any()


def test_a_level_that_makes_no_surface_is_a_fault_under_jit():
    scene = lit()

    @jax.jit
    def word(level):
        viewed = view_particles(scene.particles, camera(), jnp.linspace(1.2, 3.2, 40), 3)
        surface = dataclasses.replace(scene.surface, level=level)
        return ParticleSurface.seen(surface, scene.particles, viewed, None, None, camera()).fault

    assert [int(word(np.float32(level))) for level in (0.45, 0, -1, np.nan, np.inf)] == [0, *4 * [faults.BAD_SURFACE]]


@pytest.mark.slow
def test_from_within_the_fluid_the_first_crossing_is_where_a_ray_leaves_it():
    scene = js.Scene(particles=ball(), surface=js.Surface(0.45))
    check(scene, camera(eye=(0.0, 0.02, -0.05), near=0.01))


@pytest.mark.parametrize("of", ["quantity", pytest.param("extinction_quantity", marks=pytest.mark.slow)])
def test_a_surface_of_a_quantity_is_where_that_has_the_level_and_coloured_by_what_it_is_made_of(of):
    """A ball whose quantity grows from one side to the other: it is cut off where there is little of it."""
    particles = ball()
    grows = np.where(particles.valid, np.asarray(particles.position)[:, 0] + np.float32(0.5), 0)
    given = {"quantity": grows} if of == "quantity" else {"extinction_quantity": grows}
    look = js.TransferFunction.from_points([-0.5, 1.0], [[0.1, 0.5, 0.9], [0.9, 0.5, 0.1]], [1.0, 1.0])
    surface = js.Surface(0.28, of=of, ambient=1.0)
    scene = js.Scene(particles=dataclasses.replace(particles, **given), transfer=look, surface=surface)
    image, truth, both = check(scene, camera())
    share = ((truth.quantity + 0.5) / 1.5)[..., None]
    color = (1 - share) * np.array([0.1, 0.5, 0.9]) + share * np.array([0.9, 0.5, 0.1])
    np.testing.assert_allclose(np.asarray(image.color)[both], color[both], atol=2e-3)
    whole = np.isfinite(crossing(dataclasses.replace(scene, surface=js.Surface(0.28)), camera()).depth)
    assert 40 < np.isfinite(truth.depth).sum() < 0.9 * whole.sum()


CLIPS = {
    "plane": (js.Plane((0.05, 0.0, -0.05), (-0.3, 0.2, 1.0)), lambda x: (x - [0.05, 0, -0.05]) @ [-0.3, 0.2, 1.0] >= 0),
    "~sphere": (~js.Sphere((0.1, 0.1, -0.4), 0.3), lambda x: np.linalg.norm(x - [0.1, 0.1, -0.4], axis=-1) >= 0.3),
}


@pytest.mark.parametrize("name", ["plane", pytest.param("~sphere", marks=pytest.mark.slow)])
def test_a_clip_cuts_the_surface_and_closes_nothing(name):
    """At a face of the clip by the very ray; what lies behind is seen through the cut."""
    clip, inside = CLIPS[name]
    scene = lit(within=clip)
    _, truth, both = check(scene, camera(), within=inside)
    whole = crossing(dataclasses.replace(scene, within=None), camera()).depth
    assert (truth.depth[both] > whole[both] + 0.05).sum() > 20


def test_pixels_at_silhouettes_have_the_mean_of_their_rays_and_all_others_their_own():
    """As an image of four times as many pixels each way has them; eagerly, under a trace, and in parts."""
    view, number = camera(), 4
    smooth = lit(within=None)
    smooth = dataclasses.replace(smooth, surface=dataclasses.replace(smooth.surface, antialias=number))
    own = js.render(lit(within=None), view, SETTINGS)
    fine = js.render(lit(within=None), dataclasses.replace(view, width=number * WIDTH, height=number * HEIGHT), SETTINGS)
    image, plan = js.render(smooth, view, SETTINGS), js.plan(smooth, view, SETTINGS)
    traced = jax.jit(lambda of: js.render(of, view, SETTINGS, plan=plan), compiler_options=QUICKLY)(smooth)

    def rays(layer):
        layer = np.asarray(layer)
        apart = layer.reshape(HEIGHT, number, WIDTH, number, *layer.shape[2:])
        return np.moveaxis(apart, 2, 1).reshape(HEIGHT, WIDTH, number**2, *layer.shape[2:])

    alpha = rays(fine.alpha).mean(2)
    changed = np.abs(np.asarray(image.alpha) - np.asarray(own.alpha)) > 1e-3
    assert changed.sum() > 15 and ((alpha > 0) & (alpha < 1))[changed].all() and len(np.unique(np.asarray(image.alpha))) > 8
    several = np.abs(np.asarray(image.color) - np.asarray(own.color)).max(-1) > 1e-5
    for name in ("color", "alpha"):
        mean = rays(getattr(fine, name)).mean(2)
        np.testing.assert_allclose(np.asarray(getattr(image, name))[several], mean[several], atol=1e-5)
        np.testing.assert_allclose(
            np.asarray(getattr(image, name))[~several], np.asarray(getattr(own, name))[~several], atol=1e-5
        )
    np.testing.assert_allclose(np.asarray(image.depth)[several], np.sort(rays(fine.depth), 2)[several][:, 7], rtol=1e-5)
    np.testing.assert_array_equal(np.isfinite(image.depth), np.asarray(image.alpha) >= 0.5)
    for name in ("color", "depth", "normal"):
        np.testing.assert_allclose(np.asarray(getattr(traced, name)), np.asarray(getattr(image, name)), atol=1e-5)
    assert image.stats["evaluations"] < image.stats["evaluations_full"] and not image.certified


def test_a_lamp_lights_from_its_side_and_folds_lie_in_the_dark():
    light, view = np.array([-0.5, 0.8, 0.7]), camera()
    scene = lit(within=None)
    lamp = dataclasses.replace(scene, surface=dataclasses.replace(scene.surface, light=light, occlusion=1.0))
    image, truth = js.render(lamp, view, SETTINGS), crossing(scene, view)
    both = np.isfinite(truth.depth) & (truth.clearance > GRAZED)
    facing = 0.5 * (1 + truth.normal @ (light * [1, 1, -1] / np.linalg.norm(light)))
    wanted = np.array([0.8, 0.6, 0.4]) * (AMBIENT + (1 - AMBIENT) * facing)[..., None]
    share = (np.asarray(image.color) / wanted)[both]
    assert share.max() <= 1.001 and share.min() > 0.7  # a ball that bulges everywhere hides little of the sky
    cavity = [np.full((1, 1), one, np.float32) for one in to_view(np.zeros((1, 3)), view)[0]]
    around = jax.jit(lambda own, n: Surroundings.of(own, jnp.float32(0.45), view).hidden(cavity, n))
    inside, outside = (around(scene.particles, n) for n in (ZERO, (ZERO[0] + 9, *ZERO[1:])))
    assert float(inside[0, 0]) > 0.5 and float(outside[0, 0]) == 0


@pytest.mark.parametrize("strays", [1, 30])
@pytest.mark.parametrize("seen", [False, True])
def test_strays_leave_occlusion_as_it_is(strays, seen):
    rng, view = np.random.default_rng(5), camera()
    fluid, far = rng.uniform(-1, 1, (970, 3)), rng.uniform(300, 3000, (strays, 3))
    place = [np.full((1, 1), one, np.float32) for one in to_view(np.array([[0.2, 0.1, -0.3]]), view)[0]]

    def around(position, shown):
        particles = js.Particles.from_arrays(position, 0.3, 0.0, 8 / 970, capacity=1024)
        return Surroundings.of(particles, jnp.float32(0.5), view, np.pad(shown, (0, 1024 - len(shown))))

    one = around(fluid, np.ones(970, bool))
    other = around(np.concatenate([fluid, far]), np.append(np.ones(970, bool), np.full(strays, seen)))
    assert float(one.away) == pytest.approx(float(other.away), rel=0.05)
    normal = tuple(np.full((1, 1), n, np.float32) for n in (0, 1, 0))
    hidden = [float(own.hidden(place, normal)[0, 0]) for own in (one, other)]
    assert hidden[0] > 0.5 and hidden[1] == pytest.approx(hidden[0], abs=0.05)


def sheet(z, radius=0.1, extinction=20.0):
    """Points of even extinction side by side."""
    grid = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 5), np.linspace(-0.5, 0.5, 5)), -1).reshape(-1, 2)
    position = np.concatenate([grid, np.full((25, 1), z)], 1).astype(np.float32)
    return js.Points.from_arrays(position, np.full(25, radius), np.ones((25, 3)), np.full(25, extinction))


def test_what_lies_in_front_is_seen_and_what_lies_behind_is_hidden():
    scene, view = js.Scene(particles=ball(), surface=js.Surface(0.45, color=(0.0, 0.0, 0.0))), camera(eye=(0.0, 0.0, -2.1))
    alone, front, behind = (js.render(dataclasses.replace(scene, points=sheet(z)), view, SETTINGS) for z in (9.0, -0.7, 0.7))
    hit = np.isfinite(np.asarray(alone.depth))
    assert np.asarray(front.color)[hit].max() > 0.05 and not np.asarray(behind.color)[hit].any()
    through = hit & (np.asarray(front.color).max(-1) < 0.45)
    np.testing.assert_array_equal(np.asarray(front.depth)[through], np.asarray(alone.depth)[through])
    assert (np.asarray(front.depth)[hit] <= np.asarray(alone.depth)[hit]).all() and through.sum() < hit.sum()


def droplets(seed, share):
    """Twelve particles here and there, and a level that each reaches alone."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-0.4, 0.4, (12, 3)).astype(np.float32)
    particles = js.Particles.from_arrays(position, rng.uniform(0.06, 0.12, 12), np.zeros(12), rng.uniform(1e-4, 2e-4, 12))
    real = np.asarray(particles.valid)
    support, volume = (np.asarray(column, np.float64)[real] for column in (particles.support, particles.volume))
    peak = 315 / (64 * np.pi) * volume / support**3
    return js.Scene(particles=particles, surface=js.Surface(float(share * peak.min()))), peak, support


@functools.cache
def plan_for_droplets():
    return js.plan(droplets(0, 0.5)[0], camera(), COARSE, headroom=8)


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.2, 0.9))
def test_droplets_of_one_particle_are_found_however_far_samples_are_apart(seed, share):
    """Eight samples a ray, two to four supports apart: every ray on which one particle reaches the level meets a surface."""
    (scene, peak, support), view = droplets(seed, share), camera()
    depth = np.asarray(js.render(scene, view, COARSE, plan=plan_for_droplets()).depth)
    u, v = np.meshgrid(*ray_coordinates(view, np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5))
    way = np.stack([u, v, np.ones_like(u)], -1)
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    center = to_view(scene.particles.exact_position(), view)[np.asarray(scene.particles.valid)]
    foot = way @ center.T
    square = np.maximum((center**2).sum(1) - foot**2, 0) / support**2
    most = peak * np.maximum(1 - square, 0) ** 3
    alone = (most >= (1 + GRAZED) * float(scene.surface.level)).any(-1)
    assert alone.any() and np.isfinite(depth[alone]).all()
    nothing = most.sum(-1) < (1 - GRAZED) * float(scene.surface.level)
    assert np.isinf(depth[nothing]).all()


def interior(depth):
    """Rays whose neighbours meet the surface as well: silhouettes do not move in derivatives."""
    met = np.isfinite(np.asarray(depth))
    inner = met.copy()
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        inner &= np.roll(met, shift, (0, 1))
    return inner


@functools.cache
def both_modes(kernel="poly6", projection="perspective", integrator="samples", coloured=True, fogged=False):
    """A frame of float64, its look, and programs of its derivatives: forward, what is linear of them, and that backward."""
    colors = np.array([[0.1, 0.5, 0.9], [0.3, 0.8, 0.2], [0.7, 0.2, 0.4], [0.9, 0.5, 0.1]])
    look = js.TransferFunction.from_points(np.linspace(-0.5, 0.5, 4), colors, np.ones(4))
    numbers = {"level": 0.45, "smoothing": 1.1, "color": np.array([0.4, 0.6, 0.8]), "ambient": 0.3}
    if coloured:
        numbers["light"] = np.array([-0.5, 0.8, 0.7])
    surface = js.Surface(**{name: jnp.asarray(value, jnp.float64) for name, value in numbers.items()})
    scene = js.Scene(
        particles=ball(kernel, np.float64),
        surface=surface,
        transfer=look if coloured else None,
        points=sheet(-0.7, 0.2, 1.0) if fogged else None,
    )
    camera, settings = view_of_ball(projection, dtype=np.float64), js.Settings(samples=40, integrator=integrator)
    plan = js.plan(scene, camera, settings)

    def seen(inputs, weights):
        particles, surface, camera = inputs
        image = js.render(dataclasses.replace(scene, particles=particles, surface=surface), camera, settings, plan=plan)
        depth = jnp.where(jnp.isfinite(image.depth), image.depth, 0)[..., None]
        return (jnp.concatenate([image.color, image.normal, depth], -1) * weights).sum(), image.depth

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def forward(inputs, move, weights):
        return jax.jvp(lambda inputs: seen(inputs, weights), (inputs,), (move,), has_aux=True)

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def linear(inputs, weights):
        return jax.vjp(lambda inputs: seen(inputs, weights)[0], inputs)[1]

    backward = jax.jit(lambda pull, one: pull(one)[0], compiler_options=QUICKLY)
    return (scene.particles, surface, camera), look, forward, linear, backward


@pytest.mark.parametrize(
    ("kernel", "projection", "integrator", "coloured", "fogged"),
    [
        ("poly6", "perspective", "samples", True, False),
        pytest.param("cubic_spline", "orthographic", "segments", False, False, marks=pytest.mark.slow),
        pytest.param("wendland_c2", "perspective", "samples", False, True, marks=pytest.mark.slow),
        pytest.param("cubic_spline", "orthographic", "segments", True, True, marks=pytest.mark.slow),
    ],
)
def test_both_modes_are_central_differences_and_backward_another_program_finds_depths_again(
    kernel, projection, integrator, coloured, fogged, x64
):
    """As without an outer `jit`, where what goes backward is compiled by itself, and rounds otherwise."""
    inputs, _, forward, linear, backward = both_modes(kernel, projection, integrator, coloured, fogged)
    rng, (_, _, camera) = np.random.default_rng(5), inputs
    depth = forward(inputs, still(inputs), np.zeros((camera.height, camera.width, 7)))[2]
    inner = interior(depth)
    weights = rng.normal(size=(*inner.shape, 7)) * inner[..., None]
    gradient = backward(linear(inputs, weights), np.float64(1))
    for _ in range(3):  # all parts of particles, surface and camera, as shares of them
        move = jax.tree.map(
            lambda leaf, none: none if none.dtype == jax.dtypes.float0 else leaf * rng.normal(size=leaf.shape),
            inputs,
            still(inputs),
        )
        pushed = float(forward(inputs, move, weights)[1])
        ahead, behind = (forward(stepped(inputs, move, by), move, weights)[0] for by in (STEP, -STEP))
        pulled, size = along(gradient, move)
        assert abs(pushed) > 1e-3
        assert abs(float(ahead - behind) / (2 * STEP) - pushed) <= DIFFERENCE * max(size, 1)
        assert abs(pulled - pushed) <= 1e3 * AGREE * max(size, 1)


def test_on_control_points_both_modes_paint_with_the_slope_that_begins_there(x64):
    """Though backward the root is found again, a rounding away, and so is the quantity there."""
    (particles, surface, camera), look, forward, linear, backward = both_modes()
    halves = np.where(np.asarray(particles.position)[:, 0] > 0, look.values[2], look.values[1])
    inputs, rng = (dataclasses.replace(particles, quantity=halves), surface, camera), np.random.default_rng(2)
    weights = rng.normal(size=(camera.height, camera.width, 7)) * ([1] * 3 + [0] * 4)
    move, nothing = rng.normal(size=halves.shape), still(inputs)
    pushed = float(forward(inputs, (dataclasses.replace(nothing[0], quantity=move), *nothing[1:]), weights)[1])
    along_it = np.asarray(backward(linear(inputs, weights), np.float64(1))[0].quantity) * move
    assert abs(pushed - along_it.sum()) <= 1e3 * AGREE * abs(along_it).sum()
