"""Panes of a picture: together all of it, and none with more particles than there is room for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.engine.access.lists import TILE
from jaxsph.model import Camera
from jaxsph.model.camera.frusta import seen_by as planes_of
from jaxsph.scale.panes import CROWDED, Crowd, Pane, Sides, cut, cut_to_fit


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


IN_ONE_PIXEL = Sides(*(np.full(300, pixel) for pixel in (70, 70, 41, 41)))
OVER_ALL = Sides(*(np.array([pixel]) for pixel in (0, 99, 0, 89)))


@pytest.mark.parametrize("whole_rows", [False, True])
@pytest.mark.parametrize("of", [sides(0, 200, (90, 100), 9), IN_ONE_PIXEL, OVER_ALL], ids=["spread", "one pixel", "over all"])
def test_cutting_ends_with_what_cannot_be_cut_and_says_that_it_does_not_fit(of, whole_rows):
    panes, fit = cut_to_fit((90, 100), of, 10**6, 10**6, lambda need: 0.0, whole_rows=whole_rows)
    assert not fit and len(panes) == (6 if whole_rows else 42)
    assert not any(pane.halves(whole_rows)[1] for pane in panes)


@given(st.integers(0, 2**32 - 1), st.integers(1, 90), st.integers(1, 90), st.integers(1, 2000))
def test_panes_that_can_be_cut_fit_by_what_their_rows_of_tiles_need(seed, height, width, memory):
    def fits(need):
        return memory / (need.particles + need.tile_pairs + need.bundle_pairs)

    panes, fit = cut_to_fit((height, width), sides(seed, 100, (height, width), 20), 1000, 1000, fits)
    assert sum((pane.bottom - pane.top) * (pane.right - pane.left) for pane in panes) == height * width
    assert not fit or memory >= max(panes.values())
    assert fit or any(not pane.halves(False)[1] for pane in panes)


@pytest.mark.parametrize("whole_rows", [False, True])
@pytest.mark.parametrize("pane", [Pane(0, 90, 32, 100), Pane(16, 49, 0, 16), Pane(0, 1, 0, 1)])
def test_halves_are_whole_tiles_and_together_the_pane(pane, whole_rows):
    axis, halves = pane.halves(whole_rows)
    if not halves:
        assert pane.bottom - pane.top <= TILE and (whole_rows or pane.right - pane.left <= TILE)
        return
    first, last = halves
    begin, end = (("top", "bottom"), ("left", "right"))[axis]
    assert getattr(first, end) == getattr(last, begin) and getattr(first, end) % TILE == 0
    assert first._replace(**{end: getattr(last, end)}) == pane == last._replace(**{begin: getattr(first, begin)})


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize(("largest", "most"), [(0.05, 1.01), (3.0, 1.1)])  # all that the eye lies in are counted everywhere
def test_no_particle_that_is_read_for_a_tile_is_missed_by_counting(projection, largest, most):
    rng = np.random.default_rng(1)
    position, support = rng.normal(size=(500, 3)), largest * rng.random(500)
    camera = Camera.look_at((0, 0.3, 2), (0, 0, 0), width=72, height=40, near=0.1, far=4)
    if projection == "orthographic":
        camera = Camera.orthographic((0, 0.3, 2), (0, 0, 0), width=72, height=40, near=0.1, far=4)
    crowd = Crowd(camera, (position.min(0), position.max(0)))
    for some in (slice(0, 200), slice(200, 500)):
        crowd.count(position[some], support[some])
    read = np.array(
        [
            [
                planes_of(camera, top, min(top + TILE, 40), left, min(left + TILE, 72)).meet(position, support).sum()
                for left in edges
            ]
            for edges in [range(0, 72, TILE)]
            for top in range(0, 40, TILE)
        ]
    )
    assert (crowd.of_tiles >= read).all() and (crowd.of_tiles <= most * read + 2).all()
    assert (crowd.of_rows >= read.max(1)).all() and crowd.fullest(False).particles == crowd.of_tiles.max()
