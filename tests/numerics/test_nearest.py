"""What was probably meant by a name."""

import pytest

from jaxsph.numerics.names import did_you_mean, nearest

NAMES = ("Density", "InternalEnergy", "viridis")


@pytest.mark.parametrize(
    ("given", "meant"), [("densty", "Density"), ("VIRIDSI", "viridis"), ("internal energy", "InternalEnergy"), ("soup", None)]
)
def test_the_name_that_is_most_alike_is_meant_but_for_case(given, meant):
    assert nearest(given, NAMES) == meant
    assert did_you_mean(given, NAMES) == ("" if meant is None else f"; did you mean {meant}?")


def test_nothing_is_meant_of_none():
    assert did_you_mean("x", ()) == ""
