"""What particles hold: numbers in their own unit, and what that of their integral is called."""

import numpy as np
import pytest

import jaxsph as js
from jaxsph.model.particles.columns import held_by, unit_held

unyt = pytest.importorskip("unyt")
POSITION = np.zeros((3, 3)) + np.arange(3)[:, None]


def particles(unit=None):
    return js.Particles.from_arrays(POSITION if unit is None else unyt.unyt_array(POSITION, unit), 1.0, 1.0)


def test_amounts_are_numbers_in_their_own_unit():
    held = held_by(particles(), unyt.unyt_array([1.0, 2, 4], "Msun"), None)
    np.testing.assert_array_equal(np.ldexp(held.amounts[:3, 0], held.exponents[0]), [1, 2, 4])


@pytest.mark.parametrize(
    ("unit", "weight", "called"),
    [(None, None, "Msun a unit of area"), ("kpc", None, "Msun / (kpc)**2"), ("kpc", "volume", "Msun"), (None, "volume", "Msun")],
)
def test_integrals_are_called_by_the_unit_of_what_is_summed_up(unit, weight, called):
    assert unit_held(particles(unit), unyt.unyt_array([1.0, 2, 4], "Msun"), weight) == called
    assert unit_held(particles(unit), np.ones(3), weight) == "" == unit_held(particles(unit), "volume", weight)


def test_masked_amounts_and_weights_are_refused():
    hidden = np.ma.masked_array(np.ones(3), [0, 1, 0])
    for name, of, weight in (("of", hidden, None), ("weight", "quantity", hidden)):
        with pytest.raises(ValueError, match=f"`{name}` is masked in 1 of 3"):
            held_by(particles(), of, weight)
