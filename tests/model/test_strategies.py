"""Promises of strategies: objects that say the same as fields of settings, and nothing else."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

import jaxsph as js
from jaxsph.model.strategies import STRATEGIES

SAME = [
    ({"integrator": js.Samples()}, {}),
    ({"integrator": js.Samples(errors=js.Pilot())}, {"estimator": "pilot"}),
    ({"integrator": js.Samples(errors=js.Pilot()), "relax": 0.5}, {"estimator": "pilot", "relax": 0.5}),
    (
        {"integrator": js.Samples(errors=js.Bounds(relax=0.5, super_pixels=False, merge=False))},
        {"relax": 0.5, "super_pixels": False, "merge": False},
    ),
    ({"integrator": js.Segments(), "tolerance": 0.01}, {"integrator": "segments", "tolerance": 0.01}),
    ({"integrator": js.StepDoubling(tolerance=1e-4)}, {"integrator": "step_doubling", "step_tolerance": 1e-4}),
    ({"screen": js.Quadtree(leaf_pixels=16)}, {"screen": "quadtree", "leaf_pixels": 16}),
    ({"screen": js.Quadtree(), "leaf_pixels": 8}, {"screen": "quadtree"}),
    ({"integrator": js.Segments(), "screen": js.Quadtree()}, {"integrator": "segments", "screen": "quadtree"}),
]


@pytest.mark.parametrize(("strategies", "fields"), SAME)
def test_strategies_are_the_fields_that_they_stand_for(strategies, fields):
    assert js.Settings(**strategies) == js.Settings(**fields)
    assert hash(js.Settings(**strategies)) == hash(js.Settings(**fields))
    assert dataclasses.replace(js.Settings(samples=8), **strategies) == js.Settings(samples=8, **fields)


@pytest.mark.parametrize("kind", [js.Bounds, js.Pilot, *STRATEGIES["integrator"], *STRATEGIES["screen"]])
def test_strategies_are_hashable_and_short(kind):
    assert hash(kind()) == hash(kind()) and kind() == kind()
    assert repr(kind()).startswith(kind.__name__ + "(") and len(repr(kind())) < 80


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"integrator": js.Samples(), "estimator": "pilot"}, "`estimator` = 'pilot' is given beside `integrator=Samples"),
        ({"integrator": js.StepDoubling(), "step_tolerance": 0.1}, "`step_tolerance` = 0.1 is given beside"),
        ({"screen": js.Quadtree(leaf_pixels=16), "leaf_pixels": 4}, "`leaf_pixels` = 4 is given beside"),
        ({"screen": js.Segments()}, r"`screen` must be a name or `jaxsph.Quadtree\(...\)`, got Segments"),
        ({"integrator": js.Quadtree()}, "`integrator` must be a name or `jaxsph.Samples"),
        ({"integrator": js.Pilot()}, "`integrator` must be a name or `jaxsph.Samples"),
        ({"integrator": js.Segments}, "`integrator` must be a name or `jaxsph.Samples"),
        ({"screen": js.Quadtree(leaf_pixels=5)}, "`leaf_pixels` must be one of"),
        ({"integrator": js.StepDoubling(tolerance=0)}, "`step_tolerance` must be"),
        ({"integrator": js.Samples(errors=js.Bounds(relax=2))}, "`relax` must lie in"),
        ({"integrator": 3}, "`integrator` must be one of samples, segments, step_doubling, got 3"),
        ({"integrator": ["samples"]}, "`integrator` must be one of"),
    ],
)
def test_what_cannot_be_meant_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        js.Settings(**change)
    with pytest.raises(ValueError, match="`errors` must be"):
        js.Samples(errors="pilot")


def test_numbers_of_strategies_may_be_traced():
    def settings(relax):
        return js.Settings(tolerance=0.1, integrator=js.Samples(errors=js.Bounds(relax=relax)))

    assert jax.jit(lambda relax: settings(relax).relax * 2)(jnp.float32(0.25)) == 0.5


def test_settings_say_what_differs_from_the_defaults():
    assert repr(js.Settings()) == "Settings()"
    told = repr(js.Settings(tolerance=0.004, integrator=js.Segments(), screen="quadtree"))
    assert told == "Settings(tolerance=0.004, integrator='segments', screen='quadtree')"
    assert "relax=" in repr(jax.tree.map(lambda _: object(), js.Settings(relax=0.5)))
    names = []
    jax.make_jaxpr(lambda one: names.append(repr(one)) or one.relax)(js.Settings(samples=3))
    assert names[0].startswith("Settings(samples=3, relax=")
