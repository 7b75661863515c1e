"""Panes of a picture: halves of halves of it in whole tiles, and what the least of them need."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.engine.access.lists import TILE
from jaxsph.model import Camera
from jaxsph.model.camera.frusta import seen_by as planes_of
from jaxsph.scale.panes import Pane, crowds


@pytest.mark.parametrize("whole_rows", [False, True])
@pytest.mark.parametrize("pane", [Pane(0, 90, 32, 100), Pane(16, 49, 0, 16), Pane(0, 1, 0, 1), Pane(0, 16, 0, 90)])
def test_halves_are_whole_tiles_and_together_the_pane(pane, whole_rows):
    axis, halves = pane.halves(whole_rows)
    if not halves:
        assert pane.bottom - pane.top <= TILE and (whole_rows or pane.right - pane.left <= TILE)
        return
    first, last = halves
    begin, end = (("top", "bottom"), ("left", "right"))[axis]
    assert getattr(first, end) == getattr(last, begin) and getattr(first, end) % TILE == 0
    assert first._replace(**{end: getattr(last, end)}) == pane == last._replace(**{begin: getattr(first, begin)})


def least_of(pane, whole_rows):
    """All that a pane is cut into where it is cut as often as it can be."""
    halves = pane.halves(whole_rows)[1]
    return [least for half in halves for least in least_of(half, whole_rows)] or [pane]


@given(st.integers(1, 300), st.integers(1, 300), st.booleans())
def test_the_finest_cut_is_all_tiles_or_all_rows_of_them_once(height, width, whole_rows):
    covered = np.zeros((height, width), int)
    panes = least_of(Pane(0, height, 0, width), whole_rows)
    for pane in panes:
        covered[pane.top : pane.bottom, pane.left : pane.right] += 1
    assert (covered == 1).all() and all(edge % TILE == 0 for pane in panes for edge in (pane.top, pane.left))
    assert len(panes) == -(-height // TILE) * (1 if whole_rows else -(-width // TILE))


def test_halves_are_as_near_to_squares_as_can_be():
    """A square has the shortest border, across which particles are held by both sides."""
    pane = Pane(0, 256, 0, 512)
    while halves := pane.halves(False)[1]:
        pane = halves[0]
        long, short = sorted((pane.bottom - pane.top, pane.right - pane.left), reverse=True)
        assert long <= 2 * short


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize("largest", [0.05, 3.0])
@pytest.mark.parametrize("whole_rows", [False, True])
def test_no_particle_that_is_read_for_the_least_panes_is_missed_by_counting(projection, largest, whole_rows):
    rng = np.random.default_rng(1)
    position, support = rng.normal(size=(500, 3)), largest * rng.random(500)
    camera = Camera.look_at((0, 0.3, 2), (0, 0, 0), width=72, height=40, near=0.1, far=4)
    if projection == "orthographic":
        camera = Camera.orthographic((0, 0.3, 2), (0, 0, 0), width=72, height=40, near=0.1, far=4)
    some = [(position[rows], support[rows]) for rows in (slice(0, 200), slice(200, 500))]
    held, pairs = crowds(camera, (position.min(0), position.max(0)), some, whole_rows)

    def read(pane):
        return int(planes_of(camera, *pane).meet(position, support).sum())

    for pane in least_of(Pane(0, 40, 0, 72), whole_rows):
        assert read(pane) <= held[pane] <= 1.01 * read(pane) + 2
        tiles = sum(map(read, least_of(pane, False)))
        assert tiles <= pairs[pane] <= 1.01 * tiles + 2
