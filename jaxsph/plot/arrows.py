"""Arrows of a vector field over a picture, such as velocities over a column density.

Flow: figure of a Projection, components on a coarse lattice -> [arrows] -> the same figure.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.plot.bars import raised

LONG, CELLS = 95, 1.3
"""Percentile of lengths that is drawn so many cells of the lattice long."""
DIGITS = 2


def draw_arrows(
    axes: Any, right: Float[np.ndarray, "rows columns"], up: Float[np.ndarray, "rows columns"], name: str, unit: str = ""
) -> None:
    """Draw an arrow in the middle of each cell of a lattice over the picture of `axes`, and one of a round length as a key.

    Args:
        axes: of matplotlib, with one picture.
        right, up: components to the right and upwards; row 0 is the top. Cells that are NaN have no arrow.
        name: of the vector.
        unit: of its components; empty where it is not known.
    """
    rows, columns = right.shape
    left, end, bottom, top = axes.get_images()[0].get_extent()
    x = left + (np.arange(columns) + 0.5) / columns * (end - left)
    y = top - (np.arange(rows) + 0.5) / rows * (top - bottom)
    lengths = np.hypot(right, up)
    there = lengths[np.isfinite(lengths) & (lengths > 0)]
    if not there.size:
        return
    typical = float(np.percentile(there, LONG))
    scale = typical * columns / (CELLS * abs(end - left))
    drawn = axes.quiver(x, y, right, up, angles="xy", scale_units="xy", scale=scale, pivot="mid", color="white", width=0.003)
    drawn.set(edgecolor="black", linewidth=0.4)
    key = float(f"{typical:.{DIGITS}g}")
    label = f"{name}, {key:g} {raised(unit)}".strip()
    axes.quiverkey(drawn, 0.92, 0.95, key, label, labelpos="W", coordinates="axes", color="white", labelcolor="white")
