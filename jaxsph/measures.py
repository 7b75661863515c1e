"""What a frame's capacities are made from: counts of pairs, exact, and a few medians of sizes (host side).

Flow: viewing -> [measures] -> plan.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxsph.access.lists import BUNDLE, TILE
from jaxsph.access.view import Viewed

MAX_MEDIAN_OF = 1 << 16  # particles that a median is taken of: it only has to tell sizes that differ by a half


@dataclasses.dataclass(frozen=True)
class Measures:
    """Of the particles that a camera sees.

    Attributes:
        tile_pairs: (particle, tile) pairs in each row of tiles of the image.
        bundle_pairs: at most so many (particle, bundle) pairs in each row of tiles.
        rows, columns: of bundles, from the first to the last that any particle is seen in; at least 1.
        depth_extent: median diameter along depth, in samples; NaN where nothing is seen.
        diameter: median diameter across, in pixels; NaN where nothing is seen.
    """

    tile_pairs: np.ndarray
    bundle_pairs: np.ndarray
    rows: int
    columns: int
    depth_extent: float
    diameter: float


def measure(viewed: Viewed, height: int) -> Measures:
    """Measure particles in view of an image that has `height` rows of pixels."""
    sides = (np.asarray(side) for side in (viewed.left, viewed.right, viewed.top, viewed.bottom))
    left, right, top, bottom = sides
    seen = np.flatnonzero((right >= left) & (bottom >= top))
    left, right, top, bottom = (side[seen] for side in (left, right, top, bottom))
    tile_rows = -(-height // TILE)
    pairs = [_pairs_in_rows((left, right, top, bottom), size, -(-height // size)) for size in (TILE, BUNDLE)]
    of_bundles = np.pad(pairs[1], (0, 2 * tile_rows - len(pairs[1]))).reshape(-1, 2).sum(1)
    reach = [
        int(last.max(initial=-1) // BUNDLE - first.min(initial=1 << 30) // BUNDLE + 1)
        for first, last in ((top, bottom), (left, right))
    ]
    some = slice(None, None, max(1, len(seen) // MAX_MEDIAN_OF))
    medians = [
        float(np.median(values)) if len(values) else float("nan")
        for values in (np.asarray(viewed.extent)[seen[some]], (right - left)[some] + 1)
    ]
    return Measures(pairs[0], of_bundles, *(max(number, 1) for number in reach), *medians)


def _pairs_in_rows(sides: tuple[np.ndarray, ...], size: int, rows: int) -> np.ndarray:
    """How many squares of `size` pixels all particles can touch in each row of them."""
    left, right, top, bottom = sides
    columns = right // size - left // size + 1
    begun = np.bincount(top // size, columns, rows + 1) - np.bincount(bottom // size + 1, columns, rows + 1)
    return np.cumsum(begun)[:-1].astype(np.int64)
