"""Arrows: where they stand, which way they point, and that nothing has none."""

import numpy as np
import pytest

from jaxsph.plot.arrows import draw_arrows

pytest.importorskip("matplotlib")
from matplotlib.figure import Figure


def axes(extent=(-3, 3, -2, 2)):
    made = Figure().subplots()
    made.imshow(np.zeros((4, 6)), extent=extent)
    return made


def test_arrows_stand_in_the_middle_of_cells_and_the_first_row_is_the_top():
    shown, right, up = axes(), np.full((2, 3), 1.0), np.zeros((2, 3))
    up[0] = 2.0
    draw_arrows(shown, right, up, "velocity", "km/s")
    quiver = next(one for one in shown.collections if hasattr(one, "U"))
    np.testing.assert_allclose(quiver.XY[:3], [[-2, 1], [0, 1], [2, 1]])
    np.testing.assert_allclose((quiver.U[:3], quiver.V[:3]), (np.ones(3), np.full(3, 2.0)))
    np.testing.assert_allclose(quiver.V[3:], 0)
    assert 0.9 < np.hypot(1, 2) / quiver.scale / (6 / 3) < 1.4


def test_the_key_has_the_name_a_round_length_and_the_unit():
    shown = axes()
    draw_arrows(shown, np.full((2, 2), 1234.0), np.zeros((2, 2)), "velocity", "km/s")
    key = next(one for one in shown.artists if hasattr(one, "label"))
    assert key.label == "velocity, 1200 km/s" and key.U == 1200


@pytest.mark.parametrize("nothing", [0.0, np.nan])
def test_where_nothing_moves_there_are_none(nothing):
    shown = axes()
    draw_arrows(shown, np.full((2, 2), nothing), np.full((2, 2), nothing), "velocity")
    assert not shown.collections
