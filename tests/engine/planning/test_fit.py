"""Similar frames share a plan, and with it what is compiled; whatever was rendered before, an image is the same."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from images import same_bits
from rows import Fog

import jaxsph as js
from jaxsph.engine.planning.fit import PLANS, Plans, shape_of
from jaxsph.engine.planning.plan import Demand, next_class
from jaxsph.engine.request import Request
from jaxsph.engine.runtime.clock import Clock
from jaxsph.model.particles.particles import capacity_class
from jaxsph.model.settings import INTEGRATORS

pytestmark = pytest.mark.usefixtures("quick_programs")

SETTINGS = js.Settings(samples=16)


def snapshot(count: int, seed: int = 0, width: int = 24) -> tuple[js.Scene, js.Camera]:
    """A cloud of so many particles, whose supports shrink as their number grows."""
    rng = np.random.default_rng(seed)
    position = rng.normal(size=(count, 3)) * 0.3
    particles = js.Particles.from_arrays(position, 2.0 * count ** (-1 / 3), position[:, 0])
    transfer = js.TransferFunction.from_points([-0.5, 0.5], [(1, 0, 0), (0, 0, 1)], [1.0, 4.0])
    camera = js.Camera.look_at((0, 0, 3), (0, 0, 0), width=width, height=16, near=1.5, far=4.5)
    return js.Scene(particles=particles, transfer=transfer), camera


@pytest.fixture
def plans():
    """No plans kept from other tests, and none kept for them."""
    PLANS.clear()
    yield PLANS
    PLANS.clear()


@pytest.mark.slow
def test_snapshots_whose_number_drifts_by_a_fifth_compile_at_most_three_times(plans, compiles):
    """Up and down by steps that no two frames share, from the middle of a capacity class on."""
    drift = 1 + 0.1 * np.sin(np.linspace(0, 4 * np.pi, 40))
    frames = 0
    for nth, count in enumerate((2000 * drift).astype(int)):
        before = len(compiles)
        image = js.render(*snapshot(count, seed=nth), SETTINGS)
        assert np.asarray(image.alpha).max() > 0.5
        frames += len(compiles) > before
    assert 1 <= frames <= 3


@pytest.mark.slow
def test_an_image_does_not_depend_on_what_was_rendered_before(plans):
    scene, camera = snapshot(1000)
    fresh = js.render(scene, camera, SETTINGS)
    js.render(*snapshot(capacity_class(1000) + 1), SETTINGS)
    plans.clear()
    js.render(*snapshot(capacity_class(1000) + 1, seed=3), SETTINGS)
    after = js.render(scene, camera, SETTINGS)
    same_bits(after, fresh, "color", "transmittance", "depth", "evaluations")
    assert {**after.stats, "seconds": 0} == {**fresh.stats, "seconds": 0}


def test_sets_of_any_usual_size_share_a_plan_where_the_host_makes_lists(plans):
    for count in (1, 700, 3000):
        js.render(*snapshot(count, seed=count), SETTINGS)
    assert len(plans._kept) == 1


def test_a_kept_plan_is_taken_only_with_room_and_at_most_one_class_too_large(plans, monkeypatch):
    monkeypatch.setattr(Demand, "in_common", lambda shape: shape)
    scene, camera = snapshot(1000)
    plans.for_frame(Request.of(scene, camera, SETTINGS), Clock())
    (kept,) = plans._kept
    assert plans._similar(shape_of(Request.of(scene, camera, SETTINGS))).num_particles == kept.num_particles
    smaller = snapshot(kept.num_particles // 2)[0]
    assert plans._similar(shape_of(Request.of(smaller, camera, SETTINGS))).num_particles == smaller.particles.capacity
    narrow = dataclasses.replace(kept, lists=dataclasses.replace(kept.lists, list_capacity=1))
    assert not narrow.serves(kept) and kept.serves(narrow)
    assert not kept.rooms._replace(bundles=1 << 20).is_near(kept.rooms)


def test_the_oldest_plans_are_let_go(monkeypatch):
    monkeypatch.setattr("jaxsph.engine.planning.fit.MAX_KEPT", 2)
    plans, widths = Plans(), (24, 32, 24, 40)
    made = [plans.for_frame(Request.of(*snapshot(100, width=width), SETTINGS), Clock())[0] for width in widths]
    assert [plan.width for plan in made] == [*widths] and plans._kept == [made[2], made[3]]


def test_like_grows_a_plan_and_gives_it_back_where_it_has_room():
    small, large = snapshot(700), snapshot(3000, seed=1)
    plan = js.plan(*small, SETTINGS)
    assert js.plan(*small, SETTINGS, like=plan) is plan
    grown = js.plan(*large, SETTINGS, like=plan)
    assert grown.num_particles == large[0].particles.capacity and grown.cast == plan.cast
    assert grown.lists.list_capacity >= js.plan(*large, SETTINGS).lists.list_capacity
    assert js.plan(*small, SETTINGS, like=grown) is grown


@pytest.mark.parametrize("settings", [{"tolerance": 0.1, "estimator": "pilot"}, {"tolerance": 0.1}, {"samples": 25}])
def test_like_is_of_the_same_image_and_error_control(settings):
    plan = js.plan(*snapshot(100), SETTINGS)
    with pytest.raises(ValueError, match=r"`plan` was made for .*make a new one"):
        js.plan(*snapshot(100), dataclasses.replace(SETTINGS, **settings), like=plan)


@pytest.mark.core
def test_a_plan_checks_its_own_choices_no_less_than_those_of_the_frame():
    """Lattices and coverage are the plan's to choose; merging, super-pixels and allocation are the user's."""
    scene, camera = snapshot(100)
    settings = js.Settings(samples=16, integrator="samples", tolerance=0.1)
    plan = js.plan(scene, camera, settings)
    for change in ({"merge": False}, {"super_pixels": False}, {"allocation": "greedy"}, {"estimator": "pilot"}):
        with pytest.raises(ValueError, match="`plan` was made for"):
            js.render(scene, camera, dataclasses.replace(settings, **change), plan=plan)
    with pytest.raises(ValueError, match=r"full rate"):
        js.render(scene, camera, dataclasses.replace(settings, tolerance=None), plan=plan)


@pytest.mark.parametrize("estimator", ["interval", "pilot"])
def test_a_tolerance_is_refused_by_name_where_no_estimator_can_keep_it(monkeypatch, estimator):
    """By whatever is asked first: a plan, an image with one, or without."""
    scene, camera = snapshot(100)
    plan = js.plan(scene, camera, dataclasses.replace(SETTINGS, tolerance=0.1, estimator=estimator))
    monkeypatch.setitem(INTEGRATORS, "again", INTEGRATORS["samples"])
    with_medium = dataclasses.replace(scene, media=(Fog.of(0.0),))
    with_points = dataclasses.replace(scene, points=js.Points.from_arrays([[0, 0, 0]], 1.0, extinction=1.0))
    with_surface, planned = dataclasses.replace(scene, surface=js.Surface(0.5)), functools.partial(js.render, plan=plan)
    for changed, choices, name in (
        (with_medium, {}, r"`Scene\(media=\.\.\.\)`"),
        (scene, {"integrator": "again"}, "`integrator='again'`"),
        (with_points, {"integrator": "samples"}, r"`Scene\(points=\.\.\.\)`"),
        (with_surface, {"integrator": "samples"}, r"`Scene\(surface=\.\.\.\)`"),
        (with_surface, {"integrator": "segments"}, r"`Scene\(surface=\.\.\.\)`"),
    ):
        asked = dataclasses.replace(SETTINGS, tolerance=0.1, estimator=estimator, **choices)
        for attempt in (js.plan, js.render, planned, jax.jit(planned)):
            with pytest.raises(ValueError, match=f"`tolerance` does not cover {name} yet; give `tolerance=None`"):
                attempt(changed, camera, asked)


def least_of(attempt):
    """The least memory that a refusal names."""
    with pytest.raises(ValueError, match=r"`memory_limit` = 1000 bytes .* needs about (\d+) bytes") as refused:
        attempt(dataclasses.replace(SETTINGS, memory_limit=1000))
    return int(str(refused.value).split("needs about ")[1].split()[0])


def test_the_least_memory_that_is_named_works_and_a_byte_less_does_not():
    scene, camera = snapshot(700)
    least = least_of(functools.partial(js.plan, scene, camera))
    assert js.plan(scene, camera, dataclasses.replace(SETTINGS, memory_limit=least)).bytes == least
    with pytest.raises(ValueError, match=f"needs about {least} bytes"):
        js.plan(scene, camera, dataclasses.replace(SETTINGS, memory_limit=least - 1))


def test_room_for_more_than_a_frame_needs_is_no_reason_to_refuse_it():
    scene, camera = snapshot(700)
    tight = dataclasses.replace(SETTINGS, memory_limit=least_of(functools.partial(js.plan, scene, camera)))
    assert js.plan(scene, camera, tight, headroom=1.5) == js.plan(scene, camera, tight)
    assert Plans().for_frame(Request.of(scene, camera, tight), Clock())[0].bytes <= tight.memory_limit


def test_the_room_of_an_earlier_frame_is_no_reason_to_refuse_the_next():
    plans, frames = Plans(), [snapshot(count) for count in (880, 700)]
    tight = dataclasses.replace(SETTINGS, memory_limit=least_of(functools.partial(js.plan, *frames[1])))
    plans.for_frame(Request.of(*frames[0], SETTINGS), Clock())
    assert plans.for_frame(Request.of(*frames[1], tight), Clock())[0].bytes <= tight.memory_limit


@pytest.mark.parametrize("count", [1, 5, 100, 4097, 10**6])
@pytest.mark.core
def test_the_next_class_is_the_least_larger_one(count):
    assert capacity_class(count) < next_class(count) <= 1.25 * capacity_class(count) + 1
