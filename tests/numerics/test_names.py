"""Names that are found when they are used, or were probably meant."""

import sys
import types

import pytest

from jaxsph.numerics.names import did_you_mean, import_by_name, lazy


@pytest.fixture
def package(monkeypatch):
    made = types.ModuleType("made_up")
    monkeypatch.setitem(sys.modules, "made_up", made)
    names = {"turned": "math:pi", "rooms": "os.path"}
    made.__getattr__, made.__dir__ = lazy("made_up", names)
    return made


def test_entries_are_modules_or_what_is_in_them():
    import os.path

    assert import_by_name("os.path") is os.path
    assert import_by_name("os.path:join") is os.path.join
    assert import_by_name("collections:OrderedDict.fromkeys")("a") == {"a": None}


def test_names_are_found_once_and_kept(package):
    import math

    assert package.turned is math.pi and "turned" in vars(package)
    assert dir(package) == ["rooms", "turned"]
    with pytest.raises(AttributeError, match="module 'made_up' has no attribute 'turnd'"):
        package.turnd


NAMES = ("Density", "InternalEnergy", "viridis")


@pytest.mark.parametrize(
    ("given", "meant"), [("densty", "Density"), ("VIRIDSI", "viridis"), ("internal energy", "InternalEnergy"), ("soup", None)]
)
def test_the_name_that_is_most_alike_is_meant_but_for_case(given, meant):
    assert did_you_mean(given, NAMES) == ("" if meant is None else f"; did you mean {meant}?")


def test_nothing_is_meant_of_none():
    assert did_you_mean("x", ()) == ""
