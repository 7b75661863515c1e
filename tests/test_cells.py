"""Figures of cells and leaves show what there is: cells around their places, faces that are seen, leaves that tile a picture."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tools import tool

import jaxsph as js

cells = tool("benchmarks", "cells")
SHAPES = {16: (3, 3, 4), 4: (11, 3, 4)}  # of cells, and of slabs, by their samples: the last is not whole
SHAPE, SAMPLES = SHAPES[16], 42  # of bundles of 8 x 8 pixels
SIZE = {"width": 31, "height": 22, "near": 1.0, "far": 4.0}
CAMERAS = {
    "perspective": js.Camera.look_at((0.3, 0.2, 3.0), (0.0, 0.1, 0.0), (0.1, 1.0, 0.0), 40.0, **SIZE),
    "orthographic": js.Camera.orthographic((0.3, 0.2, 3.0), (0.0, 0.1, 0.0), (0.1, 1.0, 0.0), 2.5, **SIZE),
}


@pytest.mark.parametrize("each", SHAPES, ids=["slabs" if each == 4 else "cells" for each in SHAPES])
@pytest.mark.parametrize("camera", CAMERAS.values(), ids=CAMERAS)
def test_drawn_cells_hold_their_places(camera, each):
    corners = cells.corners_of(camera, SHAPES[each], SAMPLES, each)
    rng = np.random.default_rng(0)
    for cell in itertools.product(*map(range, SHAPES[each])):
        some = np.stack([corners[tuple(np.add(cell, step))] for step in np.ndindex(2, 2, 2)])
        inside = rng.dirichlet(np.ones(8), 20) @ some
        assert (cells.cell_of(camera, inside, SAMPLES, each) == cell).all()


def test_faces_between_occupied_cells_are_not_drawn():
    camera, eye = CAMERAS["perspective"], js.Camera.look_at((4.0, 3.0, 6.0), (0.0, 0.0, 0.0), near=0.1, far=20.0)
    corners, occupied = cells.corners_of(camera, SHAPE, SAMPLES, 16), np.zeros(SHAPE, bool)
    occupied[1, 1, 1:3] = True
    found = cells.faces_of(occupied, corners, eye)
    assert len(found.cell) == 5  # of two cells side by side: a front, a top and the right end
    assert {tuple(cell) for cell in found.cell} == {(1, 1, 1), (1, 1, 2)}
    assert len(cells.faces_of(np.ones(SHAPE, bool), corners, eye).cell) == 3 * 4 + 3 * 4 + 3 * 3


def test_a_cell_is_occupied_if_any_slab_is():
    levels = np.full(SHAPES[4], -1)
    levels[7, 1, 2] = levels[10, 2, 0] = 5
    levels[8, 0, 0] = 0
    assert {tuple(cell) for cell in np.argwhere(cells.filled_cells(levels, 4))} == {(1, 1, 2), (2, 2, 0), (2, 0, 0)}
    assert cells.filled_cells(levels, 4).shape == SHAPE


@given(st.lists(st.tuples(st.integers(0, 39), st.integers(0, 22)), max_size=20))
def test_leaves_tile_the_picture(wanted):
    """Whatever was split, around some pixels down to rays of their own."""
    shape, coarsest = (23, 40), 16
    known = np.zeros(shape, bool)
    known[np.ix_(*(np.minimum(np.arange(0, size + coarsest, coarsest), size - 1) for size in shape))] = True
    for column, row in wanted:
        for side in (16, 8, 4, 2):
            first = np.array([row, column]) // side * side
            nodes = np.minimum(first[:, None] + side // 2 * np.arange(3), np.array(shape)[:, None] - 1)
            known[np.ix_(*nodes)] = True
    times = np.zeros((48, 48), int)
    for outline in cells.leaves_of(known, coarsest, np.ones(shape, bool)):
        (left, top), (right, bottom) = outline.min(0), outline.max(0)
        assert right - left == bottom - top
        times[top:bottom, left:right] += 1
    assert (times[: shape[0], : shape[1]] == 1).all()
    assert not cells.leaves_of(known, coarsest, np.zeros(shape, bool))
