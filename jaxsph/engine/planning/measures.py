"""What a frame's capacities are made from: counts of pairs, exact, and a few medians of sizes (host side).

Flow: viewing -> [measures] -> plan.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from jaxsph.engine.access.lists import BUNDLE, TILE, ListPlan, nodes_between
from jaxsph.engine.access.view import Spheres, Viewed
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.control import ControlPlan, PilotPlan
from jaxsph.model.camera.camera import Camera

RAYS = BUNDLE * BUNDLE
ARRAYS_OF_NODES = 12  # as large as the lattice, that live at once
NUMBERS_OF_CANVAS = 24  # a pixel: six channels known, predicted and compared, and what is told of each
MAX_MEDIAN_OF = 1 << 16  # particles that a median is taken of: it only has to tell sizes that differ by a half


def frame_bytes(
    size: tuple[int, int, int, int],
    num_classes: int,
    lists: ListPlan,
    cast: CastPlan,
    control: ControlPlan | PilotPlan | None,
    number: int,
) -> int:
    """Bytes of a frame that is rendered a band at a time.

    Args:
        size: width, height, samples, and entries of the particle arrays.
        num_classes: classes of support.
        lists, cast, control: sizes of a band.
        number: bytes of a number.
    """
    width, height, samples, particles = size
    slabs = -(-samples // cast.slab_samples)
    return int(
        particles * (24 * number + 64)
        + lists.tile_capacity * (12 * number + 48)
        + lists.list_capacity * 8
        + num_classes * slabs * lists.num_bundles * 40
        + lists.num_bundles * RAYS * 5 * number * 2
        + (16 * cast.chunk + 3 * cast.batch_slabs) * cast.slab_samples * RAYS * number
        + slabs * lists.num_bundles * 8
        + width * height * 8 * number
        + _of_control(control, lists, slabs, cast.slab_samples, num_classes, number)
    )


def quadtree_bytes(size: tuple[int, int, int, int], coarse: ListPlan, number: int) -> int:
    """Bytes that choosing rays takes beside: the canvas and levels of what is estimated from it, and the lists of its lattice."""
    width, height = size[:2]
    return width * height * NUMBERS_OF_CANVAS * number + coarse.tile_capacity * (12 * number + 48) + coarse.list_capacity * 8


def _of_control(
    control: ControlPlan | PilotPlan | None, lists: ListPlan, slabs: int, slab_samples: int, num_classes: int, number: int
) -> int:
    """Of the tables of all candidates of all cells, and of the windows of coarser slabs; or of lattices of nodes."""
    if control is None:
        return 0
    if isinstance(control, PilotPlan):
        of_nodes = math.prod(control.room or lists.bundles) * control.nodes.across**2
        return slabs * -(-slab_samples // control.nodes.samples) * of_nodes * ARRAYS_OF_NODES * number
    return slabs * lists.num_bundles * (64 * number // 4 + num_classes * 32)


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
