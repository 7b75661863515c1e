"""Promises of settings and scene: what cannot be meant is refused when made."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

import jaxsph as js


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"samples": 0}, "`samples` must be an integer of at least 1, got 0"),
        ({"samples": 2.5}, "`samples` must be an integer"),
        ({"samples": 1 << 21}, "cannot be told apart"),
        ({"memory_limit": -1}, "`memory_limit` must be > 0 bytes, got -1"),
        ({"memory_limit": 0}, "`memory_limit` must be > 0"),
        ({"tolerance": -0.004}, "`tolerance` must be >= 0 and finite, got -0.004"),
        ({"tolerance": float("nan")}, "`tolerance` must be >= 0"),
        ({"relax": 1.5}, r"`relax` must lie in \[0, 1\], got 1.5"),
        ({"estimator": "guess"}, "`estimator` must be one of interval, pilot, got 'guess'"),
        ({"allocation": "fair"}, "`allocation` must be one of budget, greedy"),
        ({"leaf_pixels": 5}, "`leaf_pixels` must be one of"),
        ({"step_tolerance": 0}, "`step_tolerance` must be"),
        ({"integrator": 3}, "`integrator` must be one of samples, segments, step_doubling, got 3"),
        ({"integrator": ["samples"]}, "`integrator` must be one of"),
    ],
)
def test_bad_settings_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        js.Settings(**change)


@pytest.mark.parametrize(
    ("asked", "used"),
    [
        ({}, "samples"),
        ({"tolerance": 0.01}, "segments"),
        ({"tolerance": 0.01, "estimator": "pilot"}, "samples"),
        ({"tolerance": 0.01, "relax": 0.5}, "samples"),
        ({"tolerance": 0.01, "merge": False}, "samples"),
        ({"tolerance": 0.01, "screen": "quadtree"}, "samples"),
        ({"tolerance": 0.01, "estimator": "pilot", "integrator": "segments"}, "segments"),
        ({"integrator": "step_doubling"}, "step_doubling"),
    ],
)
def test_a_tolerance_alone_means_what_costs_least(asked, used):
    assert js.Settings(**asked).integrator_used == used
    given = asked.pop("tolerance", None)
    assert dataclasses.replace(js.Settings(**asked), tolerance=given).integrator_used == used


def test_settings_are_hashable_and_equal_by_value():
    assert hash(js.Settings(samples=8)) == hash(js.Settings(samples=8))
    assert js.Settings(samples=8) != js.Settings(samples=9)


def test_numbers_of_settings_may_be_traced():
    assert jax.jit(lambda relax: js.Settings(tolerance=0.1, relax=relax).relax * 2)(jnp.float32(0.25)) == 0.5


def test_settings_say_what_differs_from_the_defaults():
    assert repr(js.Settings()) == "Settings()"
    told = repr(js.Settings(tolerance=0.004, integrator="segments", screen="quadtree"))
    assert told == "Settings(tolerance=0.004, integrator='segments', screen='quadtree')"
    assert "relax=" in repr(jax.tree.map(lambda _: object(), js.Settings(relax=0.5)))
    assert "tolerance=Array(" in repr(js.Settings(integrator="samples", tolerance=jnp.zeros(2)))
    names = []
    jax.make_jaxpr(lambda one: names.append(repr(one)) or one.relax)(js.Settings(samples=3))
    assert names[0].startswith("Settings(samples=3, relax=")


def test_a_scene_of_the_wrong_parts_is_refused():
    with pytest.raises(ValueError, match=r"`particles` must be a `jaxsph\.Particles`, got str"):
        js.Scene(particles="mixer.npz", transfer=None)


@pytest.mark.parametrize("media", ["fog", ["fog"], 1.5, ("fog",), (2.0,), ({"extinction": 1.0},)])
def test_media_that_are_none_are_refused(media):
    particles = js.Particles.from_arrays([[0, 0, 0]], 1.0, 0.0)
    transfer = js.TransferFunction.from_points([0.0], [[1, 1, 1]], [1.0])
    assert js.Scene(particles, transfer).media == ()
    with pytest.raises(ValueError, match="`media` must be a tuple of media"):
        js.Scene(particles, transfer, media)
