"""Default appearance: a transfer function from a colour map and a range of the quantity, opaque enough to read.

Flow: Particles or Volume, colour map -> [appearance] -> TransferFunction.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxsph.model import Particles, TransferFunction, Volume

COLORMAPS: dict[str, tuple[str, ...]] = {
    "viridis": ("440154", "482878", "3e4989", "31688e", "26828e", "1f9e89", "35b779", "6ece58", "b5de2b", "fde725"),
    "heat": ("2a0510", "6b0f1a", "b11226", "e0401f", "f57f17", "fbb52c", "fde67a", "fffbe0"),
    "ice": ("0b1d51", "13418f", "1b6fb8", "2f9fd0", "66c6dd", "a9e2e6", "e8f8f5"),
    "coolwarm": ("3b4cc0", "6788ee", "9abbff", "c9d7f0", "edd1c2", "f7a889", "e26952", "b40426"),
    "gray": ("202020", "ffffff"),
}
"""Control colours of the built-in maps, from low to high, evenly spaced; sRGB as displayed."""

POINTS = 16
"""Control points of a default transfer function: enough for a smooth map, few enough to look up by comparisons."""

OPTICAL_DEPTH = 3.0
"""Optical depth through the bulk of the particles: 5 % of the light behind gets through."""

FAINTEST = 0.03
"""Extinction at the low end of the range, over that at the high end: what is lowest is seen, but hides nothing."""

STEEPNESS = 2
"""Power with which extinction rises over the range: the middle, where most of a set tends to lie, stays translucent."""

CELLS = (4, 48)
"""Fewest and most cells along the longest edge when columns of the quantity are summed."""

MAX_COLUMNS = 64
"""Points along each axis of a volume that columns are summed over, about."""

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


def default_transfer(
    particles: Particles,
    colormap_name: str = "viridis",
    values: tuple[float, float] | None = None,
    optical_depth: float = OPTICAL_DEPTH,
) -> TransferFunction:
    r"""A transfer function that shows `particles` with a colour map.

    Extinction rises with the square of the place in the range of values, from 3 % to all of a peak $\sigma$. The peak
    makes the optical depth $\tau$ of typical columns `optical_depth`: $\sum \tau^2 / \sum \tau$ over the columns of a
    coarse grid along the three axes, so that the bulk counts and not the fringe.

    Args:
        particles: the set to show; their quantity fixes the range and the extinction.
        colormap_name: as for `colormap`.
        values: low and high end of the colours, in units of the quantity; `None` chooses (`value_range`).
        optical_depth: larger is more opaque.

    Raises:
        ValueError: an unknown colour map, values that do not ascend, an optical depth that is not positive.
    """
    colors = colormap(colormap_name)
    valid = np.asarray(particles.valid)
    quantity = np.asarray(particles.quantity, np.float64)[valid]
    low, high = _span(quantity, values, optical_depth)
    share = np.linspace(0, 1, len(colors))
    ramp = FAINTEST + (1 - FAINTEST) * share**STEEPNESS
    depth = _typical_column(
        particles.exact_position()[valid],
        np.asarray(particles.support, np.float64)[valid],
        np.interp(quantity, low + (high - low) * share, ramp),
    )
    return TransferFunction.from_points(low + (high - low) * share, colors, optical_depth / depth * ramp)


def default_volume_transfer(
    volume: Volume,
    colormap_name: str = "viridis",
    values: tuple[float, float] | None = None,
    optical_depth: float = OPTICAL_DEPTH,
) -> TransferFunction:
    r"""A transfer function that shows a volume with a colour map.

    Extinction rises with the square of the place in the range of values, from 0: what is lowest, as the air of a scan, is not
    shown. Its peak makes the optical depth $\tau$ of typical columns `optical_depth`, $\sum \tau^2 / \sum \tau$ over all columns
    of a coarser grid along the three axes.

    Args:
        volume: what to show.
        colormap_name, values, optical_depth: as for `default_transfer`.

    Raises:
        ValueError: as `default_transfer`.
    """
    colors, steps = colormap(colormap_name), [max(1, points // MAX_COLUMNS) for points in volume.shape]
    coarse = np.asarray(volume.values)[tuple(slice(None, None, step) for step in steps)].astype(np.float64)
    low, high = _span(coarse, values, optical_depth)
    share = np.linspace(0, 1, len(colors))
    shown = np.interp(coarse, low + (high - low) * share, share**STEEPNESS)
    cell = np.asarray(volume.spacing, np.float64) * steps
    columns = np.concatenate([(shown.sum(axis) * cell[axis]).ravel() for axis in range(3)])
    depth = float((columns**2).sum() / columns.sum()) if columns.any() else 1.0
    return TransferFunction.from_points(low + (high - low) * share, colors, optical_depth / depth * share**STEEPNESS)


def _span(quantity: np.ndarray, values: tuple[float, float] | None, optical_depth: float) -> tuple[float, float]:
    """What colours span: as asked for, or by the quantity."""
    low, high = value_range(quantity) if values is None else (float(values[0]), float(values[1]))
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"`values` must be two finite numbers that ascend, got ({low}, {high})")
    if not (np.isfinite(optical_depth) and optical_depth > 0):
        raise ValueError(f"`optical_depth` must be > 0 and finite, got {optical_depth}")
    return low, high


def _typical_column(position: np.ndarray, support: np.ndarray, extinction: np.ndarray) -> float:
    """Mean optical depth of the columns along the axes, weighted by itself; 1 where there is nothing."""
    if not len(position):
        return 1.0
    lower, upper = (position - support[:, None]).min(0), (position + support[:, None]).max(0)
    longest = float((upper - lower).max())
    across = int(np.clip(longest / np.median(support), *CELLS))
    cell = longest / across
    shape = np.maximum(np.ceil((upper - lower) / cell * (1 - 1e-9)).astype(int), 1)
    index = np.minimum(((position - lower) / cell).astype(int), shape - 1)
    flat = np.ravel_multi_index(tuple(index.T), tuple(shape))
    sphere = 4 / 3 * np.pi * support**3
    covered = np.bincount(flat, sphere, int(shape.prod()))
    mean = np.bincount(flat, sphere * extinction, int(shape.prod())) / np.where(covered > 0, covered, 1)
    cells = (mean * np.minimum(covered / cell**3, 1)).reshape(shape)
    columns = np.concatenate([cells.sum(axis).ravel() for axis in range(3)]) * cell
    return float((columns**2).sum() / columns.sum())
