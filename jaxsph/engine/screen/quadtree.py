"""A quadtree of leaves, whose corners have rays and whose pixels are interpolated.

Flow: settings -> [quadtree] -> plan -> refinement.
"""

from __future__ import annotations

import dataclasses

from jaxsph.engine.access.lists import ListPlan


@dataclasses.dataclass(frozen=True)
class QuadtreePlan:
    """Static sizes of the refinement.

    Attributes:
        leaf: pixels on each side of the leaves that it begins with; nodes of the first lattice are half as far apart.
        lists: sizes of the lists of that lattice's bundles, which is cast in one band.
        packets: bundles that are cast together.
    """

    leaf: int
    lists: ListPlan
    packets: int

    def with_room(self, tile_capacity: int, list_capacity: int) -> QuadtreePlan:
        """With other capacities of the first lattice."""
        lists = dataclasses.replace(self.lists, tile_capacity=tile_capacity, list_capacity=list_capacity, runs=1)
        return dataclasses.replace(self, lists=lists)

    @property
    def stride(self) -> int:
        """Pixels between the nodes of the first lattice."""
        return self.leaf // 2

    @property
    def sides(self) -> tuple[int, ...]:
        """Of the leaves that may be split, the largest first."""
        return tuple(2**k for k in range(self.stride.bit_length() - 1, 0, -1))
