"""Blocks of a picture: together all of it, and none with more particles than there is room for."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.access.lists import TILE
from jaxsph.blocks import CROWDED, Sides, cut


def sides(seed, count, size, width):
    rng = np.random.default_rng(seed)
    rows, columns = size
    left, top = rng.integers(0, columns, count), rng.integers(0, rows, count)
    return Sides(left, np.minimum(left + width, columns - 1), top, np.minimum(top + width, rows - 1))


def seen_by(block, of):
    across = (of.right >= block.left) & (of.left < block.right)
    return int((across & (of.bottom >= block.top) & (of.top < block.bottom)).sum())


@given(st.integers(0, 2**32 - 1), st.integers(1, 130), st.integers(1, 130), st.integers(0, 30), st.booleans())
def test_blocks_are_all_of_the_picture_in_whole_tiles_and_see_what_there_is_room_for(seed, height, width, wide, whole_rows):
    of = sides(seed, 200, (height, width), wide)
    blocks = cut((height, width), of, 2000, 900, whole_rows=whole_rows)
    found = list(blocks)
    assert len(found) == len(blocks) and sum((b.bottom - b.top) * (b.right - b.left) for b in found) == height * width
    assert all(edge % TILE == 0 for block in found for edge in (block.top, block.left))
    most = max(seen_by(block, of) for block in found)
    assert blocks.most >= min(CROWDED * most * 10, 2000)
    single = all(size <= TILE for size in (found[0].bottom, *([] if whole_rows else [found[0].right])))
    assert blocks.most <= 900 or single
    assert not whole_rows or all(block.left == 0 and block.right == width for block in found)


def test_what_comes_after_one_another_is_beside_one_another():
    blocks = list(cut((256, 256), sides(0, 4000, (256, 256), 4), 4000, 450))
    assert len(blocks) == 16
    assert all(a.top == b.top or a.left == b.left for a, b in itertools.pairwise(blocks))


@pytest.mark.parametrize(("of", "room"), [(sides(0, 0, (40, 40), 1), 0), (sides(0, 10, (40, 40), 1), 10)])
def test_no_particles_and_room_for_all_are_one_block(of, room):
    blocks = cut((40, 40), of, len(of.left), room + 2)
    assert len(blocks) == 1 and next(iter(blocks)) == (0, 40, 0, 40)
