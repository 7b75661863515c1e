"""Pictures at full rate lie in their brackets: of any media, clips, kernels and projections, eagerly and under `jit`."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adversary import cameras, numbers, scenes
from derivatives import QUICKLY
from examples import examples
from hypothesis import given, strategies as st, target
from rows import CLIPS, Row

import jaxsph as js

pytestmark = pytest.mark.usefixtures("quick_programs")


@functools.partial(jax.jit, static_argnames=("plan", "samples"), compiler_options=QUICKLY)
def drawn(scene, camera, *, plan, samples):
    settings = js.Settings(samples=samples, integrator="samples")
    image = js.render(scene, camera, settings, plan=plan)
    pixels = jnp.concatenate([image.color, 1 - image.transmittance[..., None]], -1)
    return pixels, js.bracket(scene, camera, settings, plan=plan)


def holds(scene, camera, plan, samples):
    """The least that a pixel is off the ends of its bracket."""
    pixels, bracket = jax.tree.map(np.asarray, drawn(scene, camera, plan=plan, samples=samples))
    assert bracket.faults == 0 and bracket.lower.dtype == pixels.dtype
    assert (bracket.lower <= pixels).all() and (pixels <= bracket.upper).all()
    return float(np.minimum(pixels - bracket.lower, bracket.upper - pixels).min())


@st.composite
def with_two_quantities(draw, of_scenes):
    """Scenes whose extinction is looked up by a quantity of its own, with jumps of its own."""
    scene = draw(of_scenes)
    particles, transfer = scene.particles, scene.transfer
    dtype, second = np.asarray(particles.quantity).dtype, draw(numbers(particles.capacity))
    values = np.sort(draw(numbers(transfer.extinction.shape[0], width=16))).astype(dtype)
    particles = dataclasses.replace(particles, extinction_quantity=jnp.asarray(second.astype(dtype)))
    return dataclasses.replace(scene, particles=particles, transfer=dataclasses.replace(transfer, extinction_values=values))


@st.composite
def on_control_points(draw, of_scenes):
    """Scenes with quantities on control points or a rounding beside them."""
    scene = draw(of_scenes)
    values, quantity = np.asarray(scene.transfer.values), np.array(scene.particles.quantity)
    which = draw(st.lists(st.integers(-1, values.size - 1), min_size=quantity.size, max_size=quantity.size))
    beside = np.nextafter(values, values.dtype.type(draw(st.sampled_from([-9, 9]))))
    some = np.where(draw(st.booleans()), beside, values)[np.maximum(which, 0)]
    quantity = np.where(np.array(which) >= 0, some, quantity)
    return dataclasses.replace(scene, particles=dataclasses.replace(scene.particles, quantity=quantity))


SLOW = pytest.mark.slow


@pytest.mark.parametrize(("kernel", "projection", "clip", "kind", "dtype"), [
    ("poly6", "perspective", "~sphere", with_two_quantities, np.float64),
    ("cubic_spline", "orthographic", "everywhere", on_control_points, np.float32),
    pytest.param("wendland_c2", "perspective", "plane & ~sphere", on_control_points, np.float32, marks=SLOW),
    pytest.param("quintic_spline", "orthographic", "box", with_two_quantities, np.float32, marks=SLOW),
    pytest.param("poly6", "perspective", "everywhere", with_two_quantities, np.float32, marks=SLOW),
])  # fmt: skip
def test_pixels_lie_in_the_brackets_of_their_bundles(frames, kernel, projection, clip, kind, dtype):
    plan = frames.plan()

    def attack(scene, camera):
        scene = dataclasses.replace(scene, within=jax.tree.map(lambda leaf: np.asarray(leaf, dtype), CLIPS[clip]))
        target(-holds(scene, camera, plan, frames.samples))

    with jax.enable_x64(dtype is np.float64):
        examples(20)(given(kind(scenes(kernel, dtype)), cameras(frames, projection, dtype))(attack))()


@pytest.mark.parametrize("row", [
    pytest.param(row, id=row.name, marks=() if row.quick else SLOW)
    for row in (
        Row("points", "sphere", quick=("bracket",)),
        Row("volume", "plane", projection="orthographic"),
        Row("by opacity", "~sphere"),
        Row("fluid", "plane"),
        Row("surface"),
        Row("periodic", "box"),
        Row("fog", kernel="wendland_c2"),
        Row("all together"),
    )
])  # fmt: skip
def test_media_without_bounds_are_bracketed_too(row, frames, x64):
    plan = row.plan(frames)
    for seed in (row.seed, row.seed + 1):
        scene, camera = row.inputs(frames, seed)
        holds(scene, camera, plan, row.settings.samples)


def test_points_make_only_slabs_with_points_unknown(frames):
    """Points are left of the second column of bundles; the gas is everywhere, and there as if it were alone."""
    gas = frames.scene(np.random.default_rng(5), "cubic_spline", decades=0.3)
    size = {"width": frames.width, "height": frames.height, "near": 1.3, "far": 4.7}
    camera = js.Camera.orthographic((0, 0, 3), (0, 0, 0), (0, 1, 0), 2.5, **size)
    border = float(camera.column(8.0))

    def among(place, radius):
        near = np.array(place, np.float32) + 0.5 * radius * np.random.default_rng(6).uniform(-1, 1, (12, 3))
        return dataclasses.replace(gas, points=js.Points.from_arrays(near, radius, (0.9, 0.5, 0.2), 5.0))

    plan = js.plan(among((-0.9, 0.0, 0.0), 0.2), camera, frames.settings, headroom=4)
    alone = jax.tree.map(np.asarray, drawn(gas, camera, plan=frames.plan(), samples=frames.samples)[1])

    @examples(20)
    @given(st.floats(0.01, 0.3), st.floats(0, 1), st.floats(-1.2, 1.2), st.floats(-1.6, 1.6))
    def attack(radius, across, up, depth):
        scene = among((border - 1.6 * radius - across, up, depth), radius)
        pixels, bracket = jax.tree.map(np.asarray, drawn(scene, camera, plan=plan, samples=frames.samples))
        assert (bracket.lower <= pixels).all() and (pixels <= bracket.upper).all()
        np.testing.assert_allclose(bracket.lower[:, 8:], alone.lower[:, 8:], atol=1e-4)
        np.testing.assert_allclose(bracket.upper[:, 8:], alone.upper[:, 8:], atol=1e-4)

    attack()


@pytest.fixture
def frame(frames):
    """Of a kind whose program the attack above has compiled."""
    rng = np.random.default_rng(3)
    return frames.scene(rng, "cubic_spline"), frames.camera(rng, "orthographic")


def test_brackets_are_the_same_eagerly_and_under_jit(frame, frames):
    _, traced = drawn(*frame, plan=frames.plan(), samples=frames.samples)
    eager = js.bracket(*frame, frames.settings)
    np.testing.assert_allclose(eager.lower, traced.lower, atol=1e-5)
    np.testing.assert_allclose(eager.upper, traced.upper, atol=1e-5)
    assert eager.faults == 0 and "wide" in repr(eager)


def test_plans_of_tolerances_serve_brackets(frame, frames):
    settings = js.Settings(samples=frames.samples, tolerance=0.01)
    plain, planned = js.bracket(*frame, frames.settings), js.bracket(*frame, settings, plan=js.plan(*frame, settings))
    np.testing.assert_allclose(planned.lower, plain.lower, atol=1e-5)


def test_empty_pixels_have_empty_brackets(frame, frames):
    scene, camera = frame
    away = dataclasses.replace(camera, eye=camera.eye - 100 * camera.axes[2])
    bracket = js.bracket(scene, away, frames.settings, plan=js.plan(*frame, frames.settings))
    assert not np.asarray(bracket.lower).any() and not np.asarray(bracket.upper).any()


def test_after_a_fault_brackets_claim_nothing(frame, frames):
    scene, camera = frame
    camera = dataclasses.replace(camera, half_height=jnp.nan * camera.half_height)
    _, bracket = drawn(scene, camera, plan=frames.plan(), samples=frames.samples)
    assert bracket.faults != 0
    assert np.isneginf(bracket.lower).all() and np.isposinf(bracket.upper).all()


def test_faults_raise_eagerly_and_plans_are_needed_under_jit(frame, frames):
    scene, camera = frame
    with pytest.raises(js.CapacityError, match="too small"):
        plan = js.plan(scene, camera, frames.settings)
        small = dataclasses.replace(plan, lists=dataclasses.replace(plan.lists, list_capacity=1))
        js.bracket(scene, camera, frames.settings, plan=small)
    with pytest.raises(ValueError, match="`plan` is needed"):
        jax.jit(lambda scene: js.bracket(scene, camera, frames.settings).lower)(scene)
