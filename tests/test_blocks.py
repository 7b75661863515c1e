"""Blocks of a picture: together all of it, and none with more particles than there is room for."""

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
    blocks, fullest = cut((height, width), of, 2000, 900, whole_rows=whole_rows)
    covered = np.zeros((height, width), int)
    for block in blocks:
        covered[block.top : block.bottom, block.left : block.right] += 1
    assert (covered == 1).all() and all(edge % TILE == 0 for block in blocks for edge in (block.top, block.left))
    assert len({block.bottom - block.top for block in blocks if block.bottom < height}) <= 1
    assert fullest >= min(CROWDED * 10 * max(seen_by(block, of) for block in blocks), 2000)
    least = max(block.bottom - block.top for block in blocks) <= TILE
    assert fullest <= 900 or least
    assert not whole_rows or all(block.left == 0 and block.right == width for block in blocks)


def test_blocks_are_wide_where_little_is():
    crowded = sides(0, 3000, (256, 64), 4)
    blocks, _ = cut((256, 256), crowded, 3000, 450)
    assert max(block.right - block.left for block in blocks if block.left >= 48) > 150
    assert len(blocks) < 25


@pytest.mark.parametrize(("of", "room"), [(sides(0, 0, (40, 40), 1), 0), (sides(0, 10, (40, 40), 1), 10)])
def test_no_particles_and_room_for_all_are_one_block(of, room):
    blocks, _ = cut((40, 40), of, len(of.left), room + 2)
    assert blocks == [(0, 40, 0, 40)]
