"""About how many bytes the working arrays of a frame take.

Flow: sizes -> [memory_estimate] -> plan.

Coefficients count the arrays of each stage that live at once, by reading the stages; a number is as wide as the dtype.
"""

from __future__ import annotations

import math

from jaxsph.engine.access.lists import BUNDLE, ListPlan
from jaxsph.engine.cast.batches import CastPlan
from jaxsph.engine.control.adapt import ControlPlan
from jaxsph.engine.control.pilot import PilotPlan

RAYS = BUNDLE * BUNDLE
ARRAYS_OF_NODES = 12  # as large as the lattice, that live at once
NUMBERS_OF_CANVAS = 24  # a pixel: six channels known, predicted and compared, and what is told of each


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
