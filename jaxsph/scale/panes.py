"""Panes of a picture: it is halved, and its halves, until each needs no more memory than there is.

Flow: picture -> [panes: Pane.halves] -> panes -> from_disk; all particles -> [crowds] -> what the least panes need.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from jaxsph.engine.access.lists import TILE
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.frusta import SLACK, seen_by


class Pane(NamedTuple):
    """Pixels of an image: rows from `top` to `bottom`, and columns from `left` to `right`, both exclusive."""

    top: int
    bottom: int
    left: int
    right: int

    def halves(self, whole_rows: bool) -> tuple[int, list[Pane]]:
        """The axis that it is cut across, the longer, and two panes of whole tiles; no panes where it is the least there is.

        What reaches across a border is held by both sides, and a square has the shortest border. With `whole_rows` panes are
        cut into rows alone.
        """
        tiles_across, tiles_down = -(-(self.right - self.left) // TILE), -(-(self.bottom - self.top) // TILE)
        if tiles_across > 1 and tiles_across >= tiles_down and not whole_rows:
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


def crowds(
    camera: Camera, bounds: tuple[np.ndarray, np.ndarray], particles: Iterable[tuple[np.ndarray, ...]], whole_rows: bool
) -> tuple[Counter[Pane], Counter[Pane]]:
    """How many of all particles are read for each least pane, a tile or a row of tiles; and pairs of its tiles and particles.

    Counted are all that `frusta.Planes` takes for seen by these pixels, and a few more: none that is read is missed.

    Args:
        camera: whose picture it is.
        bounds: corners of a box around all particles.
        particles: positions, supports and whatever else, some at a time.
        whole_rows: whether the least panes are rows of tiles.
    """
    eye, forward = camera.exact_eye(), np.asarray(camera.axes, np.float64)[2]
    farthest = max(float(np.abs(corner - origin).max()) for corner in bounds for origin in (0.0, eye))
    planes = functools.cache(lambda pane: seen_by(camera, *pane))
    held, pairs = Counter[Pane](), Counter[Pane]()

    def add(pane: Pane, position: np.ndarray, reach: np.ndarray, row: Pane | None = None) -> None:
        seen, halves = planes(pane).meet(position, reach), pane.halves(whole_rows)[1]
        if row is None and not halves:
            held[pane] += int(seen.sum())
            row = pane
        halves = halves or pane.halves(False)[1]
        if not halves:
            pairs[row or pane] += int(seen.sum())
        kept = seen | ((position - eye) @ forward <= reach)  # around the eye half of a pane may take what the pane does not
        for half in halves if kept.any() else ():
            add(half, position[kept], reach[kept], row)

    for position, support, *_ in particles:
        reach = support.astype(np.float64) * (1 + SLACK) + 2 * SLACK * farthest  # of some particles alone `Planes` has less
        add(Pane(0, camera.height, 0, camera.width), position.astype(np.float64), reach)
    return held, pairs
