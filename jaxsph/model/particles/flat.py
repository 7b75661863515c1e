r"""Particles that lie in a plane or on a line, as those of runs in two dimensions and in one do.

Flow: positions -> [flat: dimensions_of] -> views, supports, kernel sums.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

SAMPLED = 4096  # particles that tell whether all may lie in a plane
FEWEST = 10  # particles that tell: three always do
THIN = 1e-5  # of their width, that particles of a plane lie off it, far below any spacing, and sine of a tilt that is none
ROUNDED = 8  # eps of float32 coordinates, by which a tilted plane may be rough


def dimensions_of(position: Float[np.ndarray, "particles 3"], box: Any) -> tuple[int, Float[np.ndarray, "3 3"]]:
    """In how many dimensions particles lie, 1 to 3, and directions in which they do, the one across a plane first (host side).

    Args:
        position: (N, 3), length units.
        box: sides of a period, across whose faces a plane may be rough; None for none.
    """
    for some in (position[:: max(1, len(position) // SAMPLED)], position):
        if len(some) < FEWEST:
            return 3, np.eye(3)
        offset = some.astype(np.float64) - some[0].astype(np.float64)
        if box is not None:
            offset -= box * np.round(offset / box)
        axes = np.linalg.eigh(np.cov(offset.T))[1].T
        nearest = np.eye(3)[np.abs(axes).argmax(1)]
        tilted = (np.abs(axes) * (1 - nearest)).max(1) > THIN
        axes = np.where(tilted[:, None], axes, nearest)
        thickness = np.ptp(offset @ axes.T, axis=0)
        largest = float(np.abs(some).max()) if some.dtype == np.float32 and tilted[0] else 0.0
        flat = thickness <= max(THIN * float(thickness.max()), ROUNDED * float(np.finfo(np.float32).eps) * largest)
        if flat.all() or not flat.any():
            return 3, np.eye(3)
    return 3 - int(flat.sum()), axes
