"""Names that are found when they are used, and former ones: one warning each, which tells the new word."""

import sys
import types
import warnings

import pytest

from jaxsph.numerics.names import found, lazy, renamed


@pytest.fixture
def package(monkeypatch):
    made = types.ModuleType("made_up")
    monkeypatch.setitem(sys.modules, "made_up", made)
    names = {"turned": "math:pi", "rooms": "os.path"}
    made.__getattr__, made.__dir__ = lazy("made_up", names, {"half_turn": ("math:pi", "made_up.turned")})
    return made


def test_entries_are_modules_or_what_is_in_them():
    import os.path

    assert found("os.path") is os.path
    assert found("os.path:join") is os.path.join
    assert found("collections:OrderedDict.fromkeys")("a") == {"a": None}


def test_names_are_found_once_and_kept(package):
    import math

    assert package.turned is math.pi and "turned" in vars(package)
    assert dir(package) == ["rooms", "turned"]
    with pytest.raises(AttributeError, match="module 'made_up' has no attribute 'turnd'"):
        package.turnd


def test_former_names_warn_once_and_tell_the_new_word(package):
    with pytest.warns(FutureWarning, match=r"`made_up.half_turn` is now `made_up.turned`") as told:
        assert package.half_turn == package.half_turn == package.turned
    assert len(told) == 1 and told[0].filename == __file__


@renamed(slab="depth_range")
def cut(shown, *, depth_range=None):
    """Give back what was given."""
    return shown, depth_range


def test_former_keywords_warn_and_are_passed_on():
    with pytest.warns(FutureWarning, match="`slab` of `cut` is now `depth_range`") as told:
        assert cut(1, slab=(2, 3)) == (1, (2, 3))
    assert len(told) == 1 and told[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cut(1, depth_range=2) == (1, 2)
    assert cut.__doc__ == "Give back what was given."


def test_a_former_keyword_beside_the_new_one_is_refused():
    with pytest.raises(TypeError, match="give `depth_range` alone"):
        cut(1, slab=2, depth_range=3)
