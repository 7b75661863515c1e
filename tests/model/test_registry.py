"""What is chosen by name is found, and is one object: so that it may be static in what is compiled."""

import re
from pathlib import Path

import pytest

import jaxsph as js
from jaxsph.engine.cast.integrator import Integrator
from jaxsph.model import registry
from jaxsph.model.settings import SCREENS


@pytest.mark.parametrize("name", registry.INTEGRATORS)
def test_integrators_are_found(name):
    found = registry.integrator(name)
    assert isinstance(found, Integrator) and found is registry.integrator(name)
    assert js.Settings(integrator=name).integrator == name


@pytest.mark.parametrize(("choice", "known"), [("integrator", registry.INTEGRATORS), ("screen", SCREENS)])
def test_unknown_names_are_refused_with_those_that_are_known(choice, known):
    with pytest.raises(ValueError, match=f"`{choice}` must be one of {', '.join(known)}, got 'none such'"):
        js.Settings(**{choice: "none such"})


def test_what_is_entered_can_be_chosen(monkeypatch):
    monkeypatch.setitem(registry.INTEGRATORS, "again", registry.INTEGRATORS["samples"])
    assert js.Settings(integrator="again").integrator == "again"
    assert registry.integrator("again") is registry.integrator("samples")


def test_integrators_say_themselves_what_they_ask_for():
    assert [name for name in registry.INTEGRATORS if registry.estimates(name)] == ["segments"]
    assert [name for name in registry.INTEGRATORS if registry.integrator_class(name).asks_points] == ["step_doubling"]
    assert not registry.estimates("none such")


def test_the_model_names_no_room_above_it_but_where_a_method_calls_what_it_finds_there():
    for file in Path(registry.__file__).parent.rglob("*.py"):
        text = re.sub(r' found\("jaxsph\.(io|plot)\.[\w.:]+"\)\(', "", file.read_text(encoding="utf-8"))
        assert '"jaxsph.' not in text.replace('"jaxsph.model.', "").replace('"jaxsph.numerics.', ""), file.name
