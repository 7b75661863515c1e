"""What a frame's capacities are made from: counts of pairs, exact, and a few medians of sizes (host side).

Flow: viewing -> [measures] -> plan.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxsph.engine.access.lists import BUNDLE, TILE, nodes_between
from jaxsph.engine.access.view import Spheres, Viewed
from jaxsph.model.camera.camera import Camera

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
        crowding: particles that share a tile with a particle, over those in a tile that has any: of even sets some 2.
        of_lattice: (particle, tile) and (particle, bundle) pairs of the bundles of a lattice of rays.
    """

    tile_pairs: np.ndarray
    bundle_pairs: np.ndarray
    rows: int
    columns: int
    depth_extent: float
    diameter: float
    crowding: float = 1.0
    of_lattice: tuple[int, int] = (0, 0)


def measure(viewed: Viewed, camera: Camera, samples: int, stride: int = 1) -> Measures:
    """Measure particles in the view of a camera with `samples` along each ray; and for a lattice of rays of some stride."""
    seen, sides, of_tiles, of_bundles = pairs_in_view(viewed, camera)
    left, right, top, bottom = sides
    some = seen[:: max(1, len(seen) // MAX_MEDIAN_OF)]
    diameters = np.asarray(viewed.right)[some] - np.asarray(viewed.left)[some] + 1
    extents = _extents(np.asarray(viewed.z)[some], np.asarray(viewed.reach)[some], camera, samples)
    ends = (top, bottom), (left, right)
    rows, columns = (
        max(int(last.max(initial=-1) // BUNDLE - first.min(initial=1 << 30) // BUNDLE + 1), 1) for first, last in ends
    )
    depth, diameter = (float(np.median(values)) if len(values) else float("nan") for values in (extents, diameters))
    of_lattice = _pairs_of_lattice(sides, camera, stride) if stride > 1 else (0, 0)
    middle = (top + bottom) // (2 * TILE) * -(-camera.width // TILE) + (left + right) // (2 * TILE)
    counts = np.bincount(middle).astype(np.float64)
    crowding = float((counts**2).sum() * np.count_nonzero(counts) / max(counts.sum(), 1) ** 2)
    return Measures(of_tiles, of_bundles, rows, columns, depth, diameter, crowding, of_lattice)


def pairs_in_view(
    viewed: Spheres, camera: Camera
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
    """Which particles are in view, the pixels that they can touch, and how many tiles and bundles in each row of tiles."""
    sides = [np.asarray(side) for side in (viewed.left, viewed.right, viewed.top, viewed.bottom)]
    seen = np.flatnonzero((sides[1] >= sides[0]) & (sides[3] >= sides[2]))
    left, right, top, bottom = found = tuple(side[seen] for side in sides)
    tile_rows = -(-camera.height // TILE)
    of_bundles = _pairs_in_rows(found, BUNDLE, 2 * tile_rows).reshape(-1, 2).sum(1)
    return seen, (left, right, top, bottom), _pairs_in_rows(found, TILE, tile_rows), of_bundles


def _pairs_of_lattice(sides: tuple[np.ndarray, ...], camera: Camera, stride: int) -> tuple[int, int]:
    """How many tiles and bundles of nodes all particles can touch."""
    left, right = nodes_between(sides[0], sides[1], camera.width, stride)
    top, bottom = nodes_between(sides[2], sides[3], camera.height, stride)
    met = (right >= left) & (bottom >= top)
    ranges = [side[met] for side in (left, right, top, bottom)]
    rows = -(-camera.strided(stride).nodes[0] // TILE)
    tiles, bundles = (int(_pairs_in_rows(tuple(ranges), size, rows * TILE // size).sum()) for size in (TILE, BUNDLE))
    return tiles, bundles


def _extents(z: np.ndarray, reach: np.ndarray, camera: Camera, samples: int) -> np.ndarray:
    """Diameters along depth, in samples, as far as they lie between near and far."""
    near, far = camera.near_and_far()
    front, back = (np.clip(np.asarray(z + side, np.float64), near, far) for side in (-reach, reach))
    if camera.is_perspective:
        return samples * np.log(back / front) / np.log(far / near)
    return samples * (back - front) / (far - near)


def _pairs_in_rows(sides: tuple[np.ndarray, ...], size: int, rows: int) -> np.ndarray:
    """How many squares of `size` pixels all particles can touch in each row of them."""
    left, right, top, bottom = sides
    columns = right // size - left // size + 1
    begun = np.bincount(top // size, columns, rows + 1) - np.bincount(bottom // size + 1, columns, rows + 1)
    return np.cumsum(begun)[:-1].astype(np.int64)
