"""How a picture is cut into panes, each of which needs no more memory than there is.

Flow: sides of some particles, how many all are, memory -> [panes: cut_to_fit] -> panes -> from_disk.

Rows from one side of the image to the other would be simpler, but see more: what reaches across a border is held by both sides,
and a square has the shortest border. All panes have the same height, so that one program serves all, and are as wide as there
is room.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxsph.engine.access.lists import BUNDLE, TILE
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.frusta import SLACK

CROWDED = 1.25
"""Times as many particles as the sample has it there is room for in a pane."""
MIN_SHRINKING, MAX_SHRINKING = 0.5, 0.8
"""What is left, at least and at most, of the room for particles where panes need more than there is memory for."""


class Pane(NamedTuple):
    """Pixels of an image: rows from `top` to `bottom`, and columns from `left` to `right`, both exclusive."""

    top: int
    bottom: int
    left: int
    right: int

    def halves(self, whole_rows: bool) -> tuple[int, list[Pane]]:
        """The axis that it is cut across, and two panes of whole tiles; no panes where it is the least there is.

        Columns first: panes of one height share a program. With `whole_rows` panes are cut into rows alone.
        """
        tiles_across, tiles_down = -(-(self.right - self.left) // TILE), -(-(self.bottom - self.top) // TILE)
        if tiles_across > 1 and not whole_rows:
            middle = self.left + tiles_across // 2 * TILE
            return 1, [self._replace(right=middle), self._replace(left=middle)]
        if tiles_down > 1:
            middle = self.top + tiles_down // 2 * TILE
            return 0, [self._replace(bottom=middle), self._replace(top=middle)]
        return 0, []


class Need(NamedTuple):
    """What the memory of a pane depends on: its particles, and of its fullest row of tiles the pairs; its rows of pixels."""

    particles: int
    tile_pairs: int
    bundle_pairs: int
    height: int


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


def cut_to_fit(
    size: tuple[int, int],
    sides: Sides,
    particles: int,
    room: int,
    fits: Callable[[Need], float],
    *,
    whole_rows: bool = False,
) -> tuple[dict[Pane, int], bool]:
    """Panes that need no more memory than there is, as far as a sample tells, and about how many particles each sees.

    Args:
        size, sides, particles, whole_rows: as for `cut`.
        room: particles of a pane, to begin with; less is tried until panes fit.
        fits: how many times what is needed there is; from 1 on it fits.

    Returns:
        The panes, the fullest first; and whether all fit: of what cannot be cut, a tile or a row of them, some may not.
    """
    pairs = _PairsOfTiles(size, sides, particles)
    while True:
        panes = cut(size, sides, particles, room, whole_rows=whole_rows)
        least, rest = ([pane for pane in panes if bool(pane.halves(whole_rows)[1]) is more] for more in (False, True))
        enough = fits(pairs.most_of(rest, panes)) if rest else 1.0
        if enough >= 1:
            return panes, not least or fits(pairs.most_of(least, panes)) >= 1
        room = int(room * min(max(enough, MIN_SHRINKING), MAX_SHRINKING))  # at 0 all panes are the least


class _PairsOfTiles:
    """About how many pairs of particles and tiles, and of particles and bundles, there are in panes: by a sample."""

    def __init__(self, size: tuple[int, int], sides: Sides, particles: int) -> None:
        seen = (sides.right >= sides.left) & (sides.bottom >= sides.top)
        self._scale = CROWDED * particles / max(len(sides.left), 1)
        shown = Sides(*(side[seen] for side in sides))
        of_tiles = _touching(shown, TILE, size)
        of_bundles = _touching(shown, BUNDLE, size)
        across, down = of_tiles.shape[1], of_tiles.shape[0]
        of_bundles = of_bundles.reshape(down, 2, across, 2).sum((1, 3))
        # before each column of tiles
        self._tiles, self._bundles = (np.pad(pairs.cumsum(1), ((0, 0), (1, 0))) for pairs in (of_tiles, of_bundles))

    def most_of(self, some: list[Pane], particles: dict[Pane, int]) -> Need:
        """What suffices for each of some panes."""
        tiles, bundles = (max(self._of(counts, pane) for pane in some) for counts in (self._tiles, self._bundles))
        return Need(max(particles[pane] for pane in some), tiles, bundles, max(pane.bottom - pane.top for pane in some))

    def _of(self, before: np.ndarray, pane: Pane) -> int:
        """Pairs in the fullest of the rows of tiles of a pane."""
        rows = before[pane.top // TILE : -(-pane.bottom // TILE)]
        pairs = int((rows[:, -(-pane.right // TILE)] - rows[:, pane.left // TILE]).max())
        return int(self._scale * (pairs + 2 * np.sqrt(pairs) + 1)) + 2


def _touching(sides: Sides, side: int, size: tuple[int, int]) -> np.ndarray:
    """How many particles touch each square of so many pixels on a side, of all the tiles of an image: rows and columns."""
    rows, columns = (-(-pixels // TILE) * TILE // side for pixels in size)
    return _boxes(Sides(*(pixels // side for pixels in sides)), (rows, columns))


def _boxes(sides: Sides, size: tuple[int, int]) -> np.ndarray:
    """How many boxes of squares cover each square."""
    left, right, top, bottom = sides
    found = np.zeros((size[0] + 1, size[1] + 1), np.int64)
    for row, column, sign in ((top, left, 1), (top, right + 1, -1), (bottom + 1, left, -1), (bottom + 1, right + 1, 1)):
        np.add.at(found, (row, column), sign)
    return found.cumsum(0).cumsum(1)[:-1, :-1]


def _edges(place: Callable[[Any], Any], pixels: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest coordinates of each row or column of tiles, and a pixel around, as `frusta.seen_by` has them."""
    begins = np.arange(0, pixels, TILE)
    ends = np.minimum(begins + TILE, pixels)
    both = [np.array([float(place(jnp.asarray(pixel))) for pixel in side]) for side in (begins - 1, ends + 1)]
    return np.minimum(*both), np.maximum(*both)


class Crowd:
    """How many of all particles are read for each least pane, a tile or a row of tiles: counted some at a time.

    Counted are all that `frusta.Planes` takes for seen by these pixels, and a few more: none that are read is missed.

    Args:
        camera: whose tiles they are.
        bounds: corners of a box around all particles.
    """

    def __init__(self, camera: Camera, bounds: tuple[np.ndarray, np.ndarray]) -> None:
        self._camera, self._size = camera, (camera.height, camera.width)
        farthest = max(float(np.abs(corner - origin).max()) for corner in bounds for origin in (0.0, camera.exact_eye()))
        self._slack = 2 * SLACK * farthest
        self._edges = _edges(camera.row, camera.height), _edges(camera.column, camera.width)
        self.of_tiles = np.zeros([len(low) for low, _ in self._edges], np.int64)
        self.of_rows = np.zeros(len(self.of_tiles), np.int64)

    def count(self, position: np.ndarray, support: np.ndarray) -> None:
        """Add some particles."""
        reach = support.astype(np.float64) * (1 + SLACK) + self._slack
        across, up, depth = ((position - self._camera.exact_eye()) @ np.asarray(self._camera.axes, np.float64).T).T
        kept = (depth + reach >= float(self._camera.near)) & (depth - reach <= float(self._camera.far))
        tiles = []
        for place, (low, high) in zip((up, across), self._edges, strict=True):
            least, most = self._between(place, depth, reach)
            first, last = np.searchsorted(np.sort(high), least, "left"), np.searchsorted(np.sort(low), most, "right") - 1
            descending = high[0] > high[-1]
            tiles.append((len(high) - 1 - last, len(high) - 1 - first) if descending else (first, last))
            kept &= first <= last
        (top, bottom), (left, right) = ([side[kept] for side in ends] for ends in tiles)
        rows, columns = self.of_tiles.shape
        self.of_tiles += _boxes(Sides(left, right, top, bottom), (rows, columns))
        nothing = np.zeros_like(top)
        self.of_rows += _boxes(Sides(nothing, nothing, top, bottom), (len(self.of_rows), 1))[:, 0]

    def _between(self, place: np.ndarray, depth: np.ndarray, reach: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Between which coordinates on the image plane spheres are seen: tangents from the eye, all where these are behind it."""
        if not self._camera.is_perspective:
            return place - reach, place + reach
        beyond = depth**2 - reach**2
        with np.errstate(divide="ignore", invalid="ignore"):
            wide = reach * np.sqrt(place**2 + beyond)
            least, most = (place * depth - wide) / beyond, (place * depth + wide) / beyond
        outside = (beyond > 0) & (depth > 0)
        return np.where(outside, least, -np.inf), np.where(outside, most, np.inf)

    def fullest(self, whole_rows: bool) -> Need:
        """What suffices for each of the least panes; a particle has up to four bundles in a tile."""
        pairs = self.of_tiles.sum(1) if whole_rows else self.of_tiles
        particles, most = int((self.of_rows if whole_rows else self.of_tiles).max()), int(pairs.max())
        return Need(particles, most, 4 * most, TILE)


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
