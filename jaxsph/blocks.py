"""How a picture is cut into blocks, each of which sees no more particles than there is room for.

Flow: sides of some particles, how many all are, room -> [blocks: cut] -> Blocks -> from_disk.

Blocks are rectangles of tiles. Rows from one side to the other would be simpler, but see more: what reaches across a border is
held by both sides, and a square has the shortest border.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxsph.access.lists import TILE

CROWDED = 1.25
"""Times as many particles as the sample has it there is room for in a block."""


class Block(NamedTuple):
    """Pixels of an image: rows from `top` to `bottom`, and columns from `left` to `right`, both exclusive."""

    top: int
    bottom: int
    left: int
    right: int


@dataclasses.dataclass(frozen=True)
class Blocks:
    """How an image is cut; they come row by row, from the left to the right and back: most is near what was there before.

    Attributes:
        rows, columns: where blocks begin, and the end of the last.
        most: about how many particles the fullest sees.
    """

    rows: list[int]
    columns: list[int]
    most: int

    def __len__(self) -> int:
        return (len(self.rows) - 1) * (len(self.columns) - 1)

    def __iter__(self) -> Iterator[Block]:
        columns = list(itertools.pairwise(self.columns))
        for number, (top, bottom) in enumerate(itertools.pairwise(self.rows)):
            for left, right in columns[:: 1 - 2 * (number % 2)]:
                yield Block(top, bottom, left, right)


class Sides(NamedTuple):
    """Pixels that particles can touch: first and last columns and rows; none where these do not ascend."""

    left: np.ndarray
    right: np.ndarray
    top: np.ndarray
    bottom: np.ndarray


def cut(size: tuple[int, int], sides: Sides, particles: int, room: int, *, whole_rows: bool = False) -> Blocks:
    """As few blocks as there is room for; none has more than `room` particles unless it is a single tile, or a row of them.

    Args:
        size: rows and columns of pixels.
        sides: of some of the particles, evenly taken, of which all are taken to be like.
        particles: how many all are.
        room: for particles of a block.
        whole_rows: whether blocks must reach from one side of the image to the other.
    """
    tiles = [-(-pixels // TILE) for pixels in size]
    most_rows, most_columns = (range((count - 1).bit_length() + 1) for count in tiles)
    found = None
    for halvings in range(len(most_rows) + len(most_columns) - 1):
        splits = [(down, halvings - down) for down in most_rows if halvings - down in most_columns[: 1 if whole_rows else None]]
        parts = (tuple(-(-count >> half) for count, half in zip(tiles, split, strict=True)) for split in splits)
        tried = [_blocks(size, part, sides, particles) for part in parts]
        found = min(tried, key=lambda blocks: blocks.most, default=found)
        if found is not None and found.most <= room:
            break
    assert found is not None
    return found


def _blocks(size: tuple[int, int], tiles: tuple[int, ...], sides: Sides, particles: int) -> Blocks:
    """The blocks of so many tiles down and across."""
    down, across = (count * TILE for count in tiles)
    rows, columns = ([*range(0, pixels, step), pixels] for pixels, step in zip(size, (down, across), strict=True))
    seen = (sides.right >= sides.left) & (sides.bottom >= sides.top)
    left, right = (side[seen] // across for side in (sides.left, sides.right))
    top, bottom = (side[seen] // down for side in (sides.top, sides.bottom))
    met = np.zeros((len(rows), len(columns)), np.int64)  # as differences, of which there is one more than blocks
    for row, column, change in ((top, left, 1), (bottom + 1, left, -1), (top, right + 1, -1), (bottom + 1, right + 1, 1)):
        np.add.at(met, (row, column), change)
    fullest = int(met.cumsum(0).cumsum(1).max())
    share = CROWDED * (fullest + 2 * np.sqrt(fullest) + 1) / max(len(sides.left), 1)
    return Blocks(rows, columns, int(min(share, 1.0) * particles) + 2)
