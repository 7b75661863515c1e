"""How much work is enough: bounds, estimates, levels and merging, and the schedule that follows; here, what is chosen of it."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from jaxsph.engine.field.schedule import FINEST, Spacing


@dataclasses.dataclass(frozen=True)
class ControlPlan:
    """Static choices of error control.

    Attributes:
        DECIDES: what decides by them, found where it is used.
        super_pixels: whether a cell may be given one colour for all of its rays (Hochstetter et al. 2016, section 5.2).
        merge: whether coarse cells are merged along depth (6.2).
        allocation: how a bundle's tolerance is shared among its cells, see `adapt.choose`.
        coverage_subdivisions: sub-rectangles on each side of a footprint that are tested for coverage: 1, 2, 4 or 8.
    """

    DECIDES: ClassVar[str] = "jaxsph.engine.control.adapt:decide"
    super_pixels: bool
    merge: bool
    allocation: str
    coverage_subdivisions: int = 2


@dataclasses.dataclass(frozen=True)
class PilotPlan:
    """Static choices of the pilot estimator.

    Attributes:
        DECIDES: as of `ControlPlan`.
        nodes: how far apart they are.
        room: rows and columns of bundles that have nodes; all of a band where there is None.
    """

    DECIDES: ClassVar[str] = "jaxsph.engine.control.pilot:decide"
    nodes: Spacing = FINEST
    room: tuple[int, int] | None = None
