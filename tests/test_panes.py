"""Panes of a picture: together all of it, and none with more particles than there is room for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.access.lists import TILE
from jaxsph.panes import CROWDED, Sides, cut


def sides(seed, count, size, width):
    rng = np.random.default_rng(seed)
    rows, columns = size
    left, top = rng.integers(0, columns, count), rng.integers(0, rows, count)
    return Sides(left, np.minimum(left + width, columns - 1), top, np.minimum(top + width, rows - 1))


def seen_by(pane, of):
    across = (of.right >= pane.left) & (of.left < pane.right)
    return int((across & (of.bottom >= pane.top) & (of.top < pane.bottom)).sum())


@given(st.integers(0, 2**32 - 1), st.integers(1, 130), st.integers(1, 130), st.integers(0, 30), st.booleans())
def test_panes_are_all_of_the_picture_in_whole_tiles_and_see_what_there_is_room_for(seed, height, width, wide, whole_rows):
    of = sides(seed, 200, (height, width), wide)
    panes = cut((height, width), of, 2000, 900, whole_rows=whole_rows)
    covered = np.zeros((height, width), int)
    for pane in panes:
        covered[pane.top : pane.bottom, pane.left : pane.right] += 1
    assert (covered == 1).all() and all(edge % TILE == 0 for pane in panes for edge in (pane.top, pane.left))
    assert len({pane.bottom - pane.top for pane in panes if pane.bottom < height}) <= 1
    assert all(told >= min(CROWDED * 10 * seen_by(pane, of), 2000) for pane, told in panes.items())
    assert list(panes.values()) == sorted(panes.values(), reverse=True)
    assert max(panes.values()) <= 900 or max(pane.bottom - pane.top for pane in panes) <= TILE
    assert not whole_rows or all(pane.left == 0 and pane.right == width for pane in panes)


def test_panes_are_wide_where_little_is():
    crowded = sides(0, 3000, (256, 64), 4)
    panes = cut((256, 256), crowded, 3000, 450)
    assert max(pane.right - pane.left for pane in panes if pane.left >= 48) > 150
    assert len(panes) < 25


@pytest.mark.parametrize(("of", "room"), [(sides(0, 0, (40, 40), 1), 0), (sides(0, 10, (40, 40), 1), 10)])
def test_no_particles_and_room_for_all_are_one_pane(of, room):
    panes = cut((40, 40), of, len(of.left), room + 2)
    assert list(panes) == [(0, 40, 0, 40)]
