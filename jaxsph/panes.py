"""How a picture is cut into panes, each of which sees no more particles than there is room for.

Flow: sides of some particles, how many all are, room -> [panes: cut] -> panes -> from_disk.

Rows from one side of the image to the other would be simpler, but see more: what reaches across a border is held by both sides,
and a square has the shortest border. All panes have the same height, so that one program serves all, and are as wide as there
is room.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from jaxsph.access.lists import TILE

CROWDED = 1.25
"""Times as many particles as the sample has it there is room for in a pane."""


class Pane(NamedTuple):
    """Pixels of an image: rows from `top` to `bottom`, and columns from `left` to `right`, both exclusive."""

    top: int
    bottom: int
    left: int
    right: int


class Sides(NamedTuple):
    """Pixels that particles can touch: first and last columns and rows; none where these do not ascend."""

    left: np.ndarray
    right: np.ndarray
    top: np.ndarray
    bottom: np.ndarray


def cut(size: tuple[int, int], sides: Sides, particles: int, room: int, *, whole_rows: bool = False) -> dict[Pane, int]:
    """As few panes as there is room for, and about how many particles each sees: the fullest first.

    None sees more than `room`, unless the least pane does: a tile, or a row of them.

    Args:
        size: rows and columns of pixels.
        sides: of some of the particles, evenly taken, of which all are taken to be like.
        particles: how many all are.
        room: for particles of a pane.
        whole_rows: whether panes must reach from one side of the image to the other.
    """
    cutter = _Cutter(size, sides, particles, room, whole_rows)
    tried = [cutter.panes(height) for height in cutter.heights()]
    fitting = [panes for panes in tried if max(panes.values()) <= room]
    found = min(fitting, key=len, default=tried[-1])
    return dict(sorted(found.items(), key=lambda one: -one[1]))


class _Cutter:
    """Ways to cut an image into panes of some height; places are numbers of tiles."""

    def __init__(self, size: tuple[int, int], sides: Sides, particles: int, room: int, whole_rows: bool) -> None:
        seen = (sides.right >= sides.left) & (sides.bottom >= sides.top)
        self._tiles = Sides(*(side[seen] // TILE for side in sides))
        self._size, self._some, self._particles = size, len(sides.left), particles
        self._room, self._whole_rows = room, whole_rows

    def heights(self) -> list[int]:
        """Of panes: the image's, its half, and so on to a tile."""
        down = -(-self._size[0] // TILE)
        return list(dict.fromkeys(-(-down >> halvings) for halvings in range((down - 1).bit_length() + 1)))

    def panes(self, height: int) -> dict[Pane, int]:
        """Those of some height, and how many particles each sees."""
        found = {}
        rows, columns = self._size
        for top in range(0, -(-rows // TILE), height):
            for left, right, particles in self._across(top, top + height):
                edges = (min(edge * TILE, end) for edge, end in ((top + height, rows), (left, columns), (right, columns)))
                found[Pane(top * TILE, *edges)] = particles
        return found

    def _across(self, top: int, bottom: int) -> Iterator[tuple[int, int, int]]:
        """First and last column of panes between two rows, as wide as there is room, and how many particles they see."""
        rows = (self._tiles.bottom >= top) & (self._tiles.top < bottom)
        across = -(-self._size[1] // TILE)
        begun, ended = (np.bincount(side[rows], minlength=across).cumsum() for side in (self._tiles.left, self._tiles.right))
        before = np.append(0, ended)  # that end in front of a column
        left = 0
        while left < across:
            seen = self._in_all(begun[left:] - before[left])  # if the pane ends behind each of the columns
            fitting = across - left if self._whole_rows else max(int((seen <= self._room).sum()), 1)
            yield left, left + fitting, int(seen[fitting - 1])
            left += fitting

    def _in_all(self, some: np.ndarray) -> np.ndarray:
        """How many particles there may be where the sample has so many."""
        share = CROWDED * (some + 2 * np.sqrt(some) + 1) / max(self._some, 1)
        return (np.minimum(share, 1.0) * self._particles).astype(np.int64) + 2
