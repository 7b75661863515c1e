"""Promises of settings and scene: what cannot be meant is refused when made; what is chosen by name is found as one object."""

import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import jaxsph as js
from jaxsph.engine.cast.integrator import Integrator
from jaxsph.model import settings
from jaxsph.model.settings import INTEGRATORS, integrator_of


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
        ({"leaf_pixels": 12}, "`leaf_pixels` must be one of 4, 8, 16, 32, got 12"),
        ({"screen": "octree"}, "`screen` must be one of .*quadtree.*, got 'octree'"),
        *(({"min_transmittance": value}, r"must lie in \[0, 1/2\)") for value in (0.5, -0.1, float("nan"))),
        ({"min_transmittance": 0.01, "tolerance": 0.01}, "must be less than `tolerance`"),
        ({"integrator": "step_doubling"}, "`integrator` must be one of samples, segments, got 'step_doubling'"),
        ({"integrator": 3}, "`integrator` must be one of samples, segments, got 3"),
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


@pytest.mark.parametrize("media", ["fog", ["fog"], 1.5, ("fog",), (2.0,), ({"extinction": 1.0},)])
def test_media_that_are_none_are_refused(media):
    particles = js.Particles.from_arrays([[0, 0, 0]], 1.0, 0.0)
    transfer = js.TransferFunction.from_points([0.0], [[1, 1, 1]], [1.0])
    assert js.Scene(particles, transfer).media == ()
    with pytest.raises(ValueError, match="`media` must be a tuple of media"):
        js.Scene(particles, transfer, media)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_integrators_are_found(name):
    found = integrator_of(name)
    assert isinstance(found, Integrator) and found is integrator_of(name)
    assert js.Settings(integrator=name).integrator == name


def test_what_is_entered_can_be_chosen(monkeypatch):
    monkeypatch.setitem(INTEGRATORS, "again", INTEGRATORS["samples"])
    assert js.Settings(integrator="again").integrator == "again"
    assert integrator_of("again") is integrator_of("samples")


def test_integrators_say_themselves_what_they_ask_for():
    assert [name for name in INTEGRATORS if settings.estimates(name)] == ["segments"]
    assert not settings.estimates("none such")


def test_the_model_names_no_room_above_it_but_where_a_method_calls_what_it_finds_there():
    for file in Path(settings.__file__).parent.rglob("*.py"):
        text = re.sub(r' import_by_name\("jaxsph\.(io|plot)\.[\w.:]+"\)[(\[]', "", file.read_text(encoding="utf-8"))
        assert '"jaxsph.' not in text.replace('"jaxsph.model.', "").replace('"jaxsph.numerics.', ""), file.name
