"""What an image says of itself: after a fault nothing is certified, and no error is told that is not known."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from forced import ran
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.engine.frame.finish import faults_of_settings
from jaxsph.engine.frame.stages import limits_of
from jaxsph.numerics import faults

ALL = [bit for bit in faults.MESSAGES if not bit & faults.TOLD]


@pytest.fixture(scope="module")
def drawn(frames):
    """Three frames side by side of a plan with little room, of a transfer function and an extent that may be anything."""
    rng = np.random.default_rng(3)
    scene, camera, plan = frames.scene(rng, decades=0), frames.camera(rng), frames.plan()
    plan = dataclasses.replace(plan, lists=dataclasses.replace(plan.lists, list_capacity=96))

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    @jax.vmap
    def draw(grown, change, at):
        particles = dataclasses.replace(scene.particles, support=scene.particles.support * grown)
        look = dataclasses.replace(scene.transfer, colors=scene.transfer.colors.at[at, 0].add(change))
        look = dataclasses.replace(look, extinction=look.extinction.at[at].add(change))
        return js.render(js.Scene(particles=particles, transfer=look), camera, frames.settings, plan=plan)

    return draw


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0.01, 0.1, 1.0, 3.0]),
            st.sampled_from([0.0, 1e-9, 0.3, -0.3, 5.0, -5.0, np.nan, np.inf]),
            st.integers(0, 4),
        ),
        min_size=3,
        max_size=3,
    )
)
def test_no_image_with_a_fault_is_certified_and_its_bound_is_1(drawn, given):
    images = drawn(*(np.array(column) for column in zip(*given, strict=True)))
    for nth, (grown, change, _) in enumerate(given):
        image = jax.tree.map(lambda leaf, nth=nth: np.asarray(leaf)[nth], images)
        faulty = int(image.faults) != 0
        assert bool(image.certified) != faulty
        assert (image.error_bound == (1 if faulty else 0)).all()
        assert np.isfinite(image.color).all() and bool(image.fault_messages) == faulty
        if not np.isfinite(change) or abs(change) >= 5 or grown == 3:
            assert faulty


OVER_DEVICES = """
import dataclasses, json
import jax
import numpy as np
import jaxsph as js

scene, camera = js.scenes.load("checker_board", 400, width=40, height=24)
settings = js.Settings(samples=16)
plan = js.plan(scene, camera, settings)

@jax.jit
def draw(grown):
    particles = dataclasses.replace(scene.particles, support=grown * scene.particles.support)
    return js.render(dataclasses.replace(scene, particles=particles), camera, settings, plan=plan, devices="all")

told = {}
for grown in (1.0, 4.0):
    image = draw(grown)
    told[str(grown)] = [int(image.faults) != 0, bool(image.certified), np.unique(image.error_bound).tolist()]
print(json.dumps(told))
"""


def test_over_devices_a_fault_of_any_is_one_of_the_image():
    assert ran(OVER_DEVICES, devices=2) == {"1.0": [False, True, [0.0]], "4.0": [True, False, [1.0]]}


@given(
    st.sampled_from([None, 0.0, 0.01, -0.01, np.nan, np.inf]),
    st.sampled_from([0.0, 1.0, -0.1, 2.0, np.nan]),
    st.sampled_from([0.0, 0.005, 0.01, 0.5, 1.5, -1.0, np.nan]),
)
@examples(200)
def test_over_mesh_numbers_are_faults_where_known_ones_are_refused(tolerance, relax, least):
    values = {"tolerance": tolerance, "relax": relax, "min_transmittance": least}
    try:
        given, refused = js.Settings(**values), False
    except ValueError:
        given, refused = js.Settings(integrator="samples", tolerance=None if tolerance is None else 0.1), True
    given = jax.tree.unflatten(jax.tree.structure(given), [value for value in values.values() if value is not None])
    assert bool(jax.jit(faults_of_settings)(given)) == refused
    if refused:
        with pytest.raises(ValueError, match="must"):
            given.require_numbers()


@functools.partial(jax.jit, static_argnames=("plan", "samples"), compiler_options=QUICKLY)
def by_tolerance(scene, camera, tolerance, *, plan, samples):
    return js.render(scene, camera, js.Settings(samples=samples, integrator="samples", tolerance=tolerance), plan=plan)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_a_traced_tolerance_out_of_range_certifies_nothing(frames, value):
    rng = np.random.default_rng(0)
    scene, camera = frames.scene(rng), frames.camera(rng)
    plan = js.plan(scene, camera, dataclasses.replace(frames.settings, tolerance=0.05))
    image = by_tolerance(scene, camera, value, plan=plan, samples=frames.samples)
    assert int(image.faults) == faults.BAD_SETTINGS and not image.certified and (np.asarray(image.error_bound) == 1).all()
    kept = by_tolerance(scene, camera, 0.05, plan=plan, samples=frames.samples)
    assert not int(kept.faults) and kept.certified and np.asarray(kept.error_bound).max() <= 0.05


def test_only_point_samples_know_their_error_at_full_rate(frames, quick_programs):
    rng = np.random.default_rng(1)
    scene, camera = frames.scene(rng), frames.camera(rng)
    reference = js.render(scene, camera, frames.settings, plan=frames.plan())
    assert reference.certified and (np.asarray(reference.error_bound) == 0).all()
    plan = dataclasses.replace(frames.plan(), integrator="segments")
    image = js.render(scene, camera, dataclasses.replace(frames.settings, integrator="segments"), plan=plan)
    assert not image.certified and np.isinf(image.error_bound).all() and not image.faults
    assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(image))  # or `jax_debug_nans` stops it
    assert "error unknown" in repr(image) and "error unknown" in image._repr_html_()


@pytest.mark.parametrize("bit", ALL)
def test_every_fault_has_words_and_is_raised_by_check(bit):
    layer = np.zeros((2, 2), np.float32)
    image = js.Image(np.zeros((2, 2, 3), np.float32), layer, layer, layer, layer, False, bit, {})
    assert image.fault_messages == (faults.MESSAGES[bit],)
    with pytest.raises(ValueError, match="this frame") as raised:
        image.check()
    assert isinstance(raised.value, js.CapacityError) == bool(bit & faults.OVERFLOWS)
    fine = dataclasses.replace(image, faults=faults.TOLERANCE_MISSED)
    assert fine.check() is fine and len(fine.fault_messages) == 1


def test_an_image_that_is_traced_cannot_be_checked(frames):
    layer = np.zeros((2, 2), np.float32)
    with pytest.raises(ValueError, match="outside"):
        jax.jit(lambda word: js.Image(layer, layer, layer, layer, layer, False, word, {}).check())(0)


@given(st.floats(0, 1))
def test_a_tolerance_in_float32_is_no_more_than_was_asked_for_and_hardly_less(tolerance):
    told, _ = limits_of(js.Settings(integrator="samples", tolerance=tolerance), jnp.float32)
    assert told.dtype == jnp.float32
    assert float(told) <= tolerance <= float(told) * (1 + 2.0**-22) + 2.0**-148


def test_full_rate_has_no_limits():
    assert limits_of(js.Settings(), jnp.float32) is None
