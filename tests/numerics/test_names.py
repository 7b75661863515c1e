"""Names that are found when they are used, or were probably meant."""

import pytest

from jaxsph.numerics.names import did_you_mean, import_by_name


def test_entries_are_modules_or_what_is_in_them():
    import os.path

    assert import_by_name("os.path") is os.path
    assert import_by_name("os.path:join") is os.path.join


NAMES = ("Density", "InternalEnergy", "viridis")


@pytest.mark.parametrize(
    ("given", "meant"), [("densty", "Density"), ("VIRIDSI", "viridis"), ("internal energy", "InternalEnergy"), ("soup", None)]
)
def test_the_name_that_is_most_alike_is_meant_but_for_case(given, meant):
    assert did_you_mean(given, NAMES) == ("" if meant is None else f"; did you mean {meant}?")


def test_nothing_is_meant_of_none():
    assert did_you_mean("x", ()) == ""
