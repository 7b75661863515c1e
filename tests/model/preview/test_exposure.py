"""Exposure: the brightest pixels are nearly opaque and enough of the rest is seen, whatever the unit of length."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.model.preview.glimpse import ALPHA, LEAST_LIT, Glimpse, exposure

SIDE, STEPS = 20, 4


def seen(depth, color=1.0):
    """A picture of these optical depths."""
    depth = np.broadcast_to(depth, (SIDE, SIDE)).astype(np.float64)
    extinction = np.repeat(depth[..., None] / STEPS, STEPS, 2)
    places = np.linspace(-1, 1, SIDE)
    ones = np.ones((SIDE, SIDE, STEPS))
    return Glimpse(places, places, ones, np.ones((SIDE, SIDE)), extinction, color * np.ones((*ones.shape, 3)))


@given(st.floats(-12, 12))
def test_a_plain_sheet_of_any_extinction_is_nearly_opaque(decades):
    picture = seen(10.0**decades)
    assert np.allclose(picture.weights(exposure(picture)).sum(2), ALPHA)


def test_a_bright_core_does_not_leave_the_rest_dark():
    depth = np.full((SIDE, SIDE), 0.01)
    depth[:2, :4] = 3.0
    picture = seen(depth)
    lit = picture.picture(exposure(picture)).max(-1) > 24 / 255
    assert lit.mean() >= LEAST_LIT


def test_where_nothing_is_met_nothing_changes():
    assert exposure(seen(0.0)) == 1.0


def test_a_black_colour_map_ends_the_search():
    assert np.isfinite(exposure(seen(1.0, 0.0)))
