"""Default appearance: a transfer function from a colour map and a range of the quantity, opaque enough to read.

Flow: Particles or Volume, colour map -> [appearance] -> TransferFunction.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jaxsph.model import Particles, TransferFunction, Volume
from jaxsph.model.transfer.colormaps import COLORMAPS, colormap, value_range

__all__ = ["COLORMAPS", "colormap", "default_transfer", "default_volume_transfer", "opacity_by_second", "value_range"]

OPTICAL_DEPTH = 3.0
"""Optical depth through the bulk of the particles: 5 % of the light behind gets through."""

FAINTEST = 0.03
"""Extinction at the low end of a range, over that at the high end: what is lowest is seen, but hides nothing."""

STEEPNESS = 2
"""Power with which extinction rises over a range: the middle, where most of a set tends to lie, stays translucent."""

RAMPS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "even": np.ones_like,
    "rising": lambda share: FAINTEST + (1 - FAINTEST) * share**STEEPNESS,
    "steep": lambda share: share ** (2 * STEEPNESS),
}
"""How extinction depends on the place in a range: not at all; as above; from 0, so that what is low is clear."""

POINTS = 33
"""Control points of extinction, where it has its own."""

CELLS = (4, 48)
"""Fewest and most cells along the longest edge when columns of the quantity are summed."""

MAX_COLUMNS = 64
"""Points along each axis of a volume that columns are summed over, about."""


def default_transfer(
    particles: Particles,
    colormap_name: str = "viridis",
    values: tuple[float, float] | None = None,
    optical_depth: float = OPTICAL_DEPTH,
    *,
    ramp: str | None = None,
) -> TransferFunction:
    r"""A transfer function that shows `particles` with a colour map.

    Extinction rises to a peak $\sigma$ by one of `RAMPS`, over the range of values, or of the second of two quantities. The peak
    makes the optical depth $\tau$ of typical columns `optical_depth`: $\sum \tau^2 / \sum \tau$ over the columns of a
    coarse grid along the three axes, so that the bulk counts and not the fringe.

    Args:
        particles: the set to show; their quantity fixes the range and the extinction.
        colormap_name: as for `colormap`.
        values: low and high end of the colours, in units of the quantity; `None` chooses (`value_range`).
        optical_depth: larger is more opaque.
        ramp: `"even"`; `"rising"` with the square of the place in the range, from 3 % of the peak; or `"steep"`, by the fourth
            power from 0, as suits the logarithm of a density over decades. By default steep of particles that have a quantity for
            extinction alone, else rising.

    Raises:
        ValueError: an unknown colour map or ramp, values that do not ascend, an optical depth that is not positive.
    """
    if ramp is not None and ramp not in RAMPS:
        raise ValueError(f"`ramp` must be one of {', '.join(RAMPS)}, got {ramp!r}")
    colors = colormap(colormap_name)
    valid = np.asarray(particles.valid)
    quantity = np.asarray(particles.quantity, np.float64)[valid]
    low, high = _span(quantity, values, optical_depth)
    control = low + (high - low) * np.linspace(0, 1, len(colors))
    if particles.extinction_quantity is not None:
        colored = TransferFunction.from_points(control, colors, np.ones(len(control)))
        return opacity_by_second(colored, particles, optical_depth, ramp=ramp or "steep")
    own = ramp not in (None, "rising")
    at = np.linspace(low, high, POINTS) if own else control
    shape = RAMPS[ramp or "rising"](np.linspace(0, 1, len(at)))
    extinction = optical_depth / typical_depth(particles, at, shape) * shape
    return TransferFunction.from_points(control, colors, extinction, at if own else None)


def opacity_by_second(
    transfer: TransferFunction, particles: Particles, optical_depth: float = OPTICAL_DEPTH, *, ramp: str = "steep"
) -> TransferFunction:
    """The colours of a transfer function, with an extinction over the second of two quantities.

    Args:
        transfer: whose colours are taken.
        particles: with two quantities.
        optical_depth, ramp: as for `default_transfer`.

    Raises:
        ValueError: particles of one quantity.
    """
    second = particles.extinction_quantity
    if second is None:
        raise ValueError("`particles` must have two quantities: give `quantity=(of_colour, of_extinction)`")
    at = np.linspace(*value_range(np.asarray(second, np.float64)[np.asarray(particles.valid)]), POINTS)
    shape = RAMPS[ramp](np.linspace(0, 1, POINTS))
    extinction = optical_depth / typical_depth(particles, at, shape) * shape
    return TransferFunction.from_points(transfer.values, transfer.colors, extinction, at)


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
    colors = colormap(colormap_name)
    low, high = _span(coarse(volume)[0], values, optical_depth)
    share = np.linspace(0, 1, len(colors))
    depth = _columns_of_volume(volume, low + (high - low) * share, share**STEEPNESS)
    return TransferFunction.from_points(low + (high - low) * share, colors, optical_depth / depth * share**STEEPNESS)


def typical_depth(shown: Particles | Volume, values: np.ndarray, extinction: np.ndarray) -> float:
    """Optical depth of typical columns of what has these extinctions at control values; 1 where there is nothing."""
    if isinstance(shown, Volume):
        return _columns_of_volume(shown, values, extinction)
    valid = np.asarray(shown.valid)
    quantity, support = (np.asarray(column, np.float64)[valid] for column in (shown.quantities[-1], shown.support))
    return _typical_column(shown.exact_position()[valid], support, np.interp(quantity, values, extinction))


def coarse(volume: Volume) -> tuple[np.ndarray, np.ndarray]:
    """Some of the values of a volume, float64, and the distances between them along the axes."""
    steps = [max(1, points // MAX_COLUMNS) for points in volume.shape]
    values = np.asarray(volume.values)[tuple(slice(None, None, step) for step in steps)].astype(np.float64)
    return values, np.asarray(volume.spacing, np.float64) * steps


def _columns_of_volume(volume: Volume, values: np.ndarray, extinction: np.ndarray) -> float:
    """See `typical_depth`."""
    quantity, cell = coarse(volume)
    shown = np.interp(quantity, values, extinction)
    columns = np.concatenate([(shown.sum(axis) * cell[axis]).ravel() for axis in range(3)])
    return float((columns**2).sum() / columns.sum()) if columns.any() else 1.0


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
    return float((columns**2).sum() / columns.sum()) if columns.any() else 1.0
