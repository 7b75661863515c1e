"""Colour maps by name, and the range of a quantity that they should span.

Flow: name, quantity -> [colormaps] -> TransferFunction, Points.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

COLORMAPS: dict[str, tuple[str, ...]] = {
    "viridis": ("440154", "482878", "3e4989", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725"),
    "heat": ("2a0510", "6b0f1a", "b11226", "e0401f", "f57f17", "fbb52c", "fde67a", "fffbe0"),
    "ice": ("0b1d51", "13418f", "1b6fb8", "2f9fd0", "66c6dd", "a9e2e6", "e8f8f5"),
    "coolwarm": ("3b4cc0", "6788ee", "9abbff", "c9d7f0", "edd1c2", "f7a889", "e26952", "b40426"),
    "gray": ("202020", "ffffff"),
}
"""Control colours of the built-in maps, from low to high, evenly spaced; sRGB as displayed."""

POINTS = 16
"""Control points of a map: enough for a smooth map, few enough to look up by comparisons."""

TAILS = (0.5, 99.5)
"""Percentiles of the quantity between which colours vary: a few odd particles must not take all of them."""


def colormap(name: str) -> Float[np.ndarray, "points 3"]:
    """16 colours of a map from low to high, evenly spaced, in [0, 1]; a name that ends in `_r` is reversed.

    Built in are `viridis`, `heat`, `ice`, `coolwarm` and `gray`; with matplotlib installed, all of its names too.

    Raises:
        ValueError: an unknown name.
    """
    base, reverse = (name[:-2], -1) if name.endswith("_r") else (name, 1)
    if base in COLORMAPS:
        rows = np.array([[int(code[i : i + 2], 16) / 255 for i in (0, 2, 4)] for code in COLORMAPS[base]])
        place = np.linspace(0, len(rows) - 1, POINTS)
        return np.stack([np.interp(place, np.arange(len(rows)), channel) for channel in rows.T], 1)[::reverse]
    try:
        from matplotlib import colormaps
    except ImportError:
        more = "; matplotlib has more: pip install 'jaxsph[color]'"
    else:
        if base in colormaps:
            return np.asarray(colormaps[base](np.linspace(0, 1, POINTS)))[::reverse, :3]
        more = " or a name of matplotlib's"
    raise ValueError(f"`colormap` must be one of {', '.join(COLORMAPS)}{more}; got {name!r}")


def value_range(quantity: Float[np.ndarray, " particles"]) -> tuple[float, float]:
    """Low and high value that the colours should span: the quantity's range without its extreme tails.

    A constant quantity gets a range around it, an empty set (0, 1).
    """
    quantity = np.asarray(quantity, np.float64)
    if not quantity.size:
        return 0.0, 1.0
    low, high = (float(v) for v in np.percentile(quantity, TAILS))
    if not high - low > 1e-6 * max(abs(low), abs(high)):  # a range that float32 would not resolve
        low, high = float(quantity.min()), float(quantity.max())
    if not high - low > 1e-6 * max(abs(low), abs(high)):
        middle, half = (low + high) / 2, max(abs(low), abs(high)) / 2 or 0.5
        return middle - half, middle + half
    return low, high
