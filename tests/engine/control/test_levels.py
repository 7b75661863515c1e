"""A tolerance shared out: no way of doing that spends more than there is."""

from __future__ import annotations

import itertools

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from jaxsph.engine.control.adapt import bound, choose
from jaxsph.engine.control.errors import CANDIDATES, CellErrors

CELLS, BUNDLES = 4, 6
UNIT = st.floats(0, 1, width=16)
TOLERANCE = st.sampled_from([0.5, 1, 2, 4]).flatmap(lambda most: st.floats(0, most, width=16))
choosing = jax.jit(choose, static_argnames="allocation")
bounding = jax.jit(bound)


@st.composite
def frames(draw):
    """Errors that grow with the level, savings that do too, what is on offer, and the rounding of bundles."""
    shape = (CANDIDATES, CELLS, BUNDLES)
    grown = draw(hnp.arrays(np.float64, shape, elements=UNIT, fill=st.nothing()))
    error = np.cumsum(grown, 0) / CANDIDATES - grown[:1] / CANDIDATES
    saving = np.round(np.cumsum(draw(hnp.arrays(np.float64, shape, elements=UNIT, fill=st.nothing())), 0) * 100)
    saving -= saving[:1]
    on_offer = draw(hnp.arrays(bool, shape))
    rounding = draw(hnp.arrays(np.float64, BUNDLES, elements=st.sampled_from([0.0, 1e-7, 0.01])))
    return error, saving, on_offer, rounding


def chosen_by(allocation, drawn, tolerance):
    """Candidates, and what is taken of the tolerance and saved by them, (cells, bundles); the best that each cell could do."""
    error, saving, on_offer, rounding = drawn
    with jax.enable_x64(True):
        nothing = np.zeros((4, CELLS, BUNDLES))
        errors = CellErrors(error, error, nothing, nothing[0])
        chosen = choosing(errors, saving, on_offer, rounding, np.asarray(tolerance), allocation=allocation)
        largest = np.asarray(bounding(offer_errors(error), chosen, rounding))
    chosen = np.asarray(chosen)
    taken, gain = (np.take_along_axis(value, chosen[None], 0)[0] for value in (offer_errors(error), saving))
    np.testing.assert_allclose(largest, np.where((chosen > 0).any(0), taken.sum(0) + rounding, 0))
    return chosen, largest, gain


def offer_errors(error):
    """Level 0 changes nothing."""
    return np.concatenate([np.zeros_like(error[:1]), error[1:]])


def possible(drawn, tolerance, cell, bundle):
    """Candidates that a cell may have: those on offer whose own error the tolerance allows; level 0 is one."""
    error, _, on_offer, rounding = drawn
    allowed = on_offer[:, cell, bundle] & (error[:, cell, bundle] + rounding[bundle] <= tolerance)
    return [0, *(c for c in range(1, CANDIDATES) if allowed[c])]


def best_within(drawn, tolerance, left, cell, bundle):
    """The first candidate that saves most among those whose error is left."""
    error, saving, _, _ = drawn
    error = offer_errors(error)
    some = [c for c in possible(drawn, tolerance, cell, bundle) if c == 0 or error[c, cell, bundle] <= left]
    return max(some, key=lambda c: (saving[c, cell, bundle], -c))


@given(drawn=frames(), tolerance=TOLERANCE)
def test_a_budget_is_kept_and_saves_all_but_one_cell_of_the_most_that_can_be_saved(drawn, tolerance):
    error, saving, _, rounding = drawn
    _, largest, gain = chosen_by("budget", drawn, tolerance)
    assert (largest <= tolerance).all()
    error = offer_errors(error)
    for bundle in range(BUNDLES):
        options = [possible(drawn, tolerance, cell, bundle) for cell in range(CELLS)]
        most, widest = 0.0, max(saving[c, cell, bundle] for cell in range(CELLS) for c in options[cell])
        for choice in itertools.product(*options):
            taken = sum(error[c, cell, bundle] for cell, c in enumerate(choice))
            if taken + rounding[bundle] <= tolerance:
                most = max(most, sum(saving[c, cell, bundle] for cell, c in enumerate(choice)))
        assert most - widest <= gain[:, bundle].sum() <= most


@given(drawn=frames(), tolerance=TOLERANCE)
def test_back_to_front_each_cell_takes_the_most_that_is_left(drawn, tolerance):
    error, _, _, rounding = drawn
    chosen, largest, _ = chosen_by("greedy", drawn, tolerance)
    assert (largest <= tolerance).all()
    for bundle in range(BUNDLES):
        left = tolerance - rounding[bundle]
        for cell in reversed(range(CELLS)):
            wanted = best_within(drawn, tolerance, left, cell, bundle)
            assert chosen[cell, bundle] == wanted
            left -= offer_errors(error)[wanted, cell, bundle]
