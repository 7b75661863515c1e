r"""Looks: transfer functions that show particles or a volume by default, opaque enough to read.

Flow: Particles or Volume, colour map -> [looks] -> TransferFunction.
"""

from __future__ import annotations

import numpy as np

from jaxsph.model.particles.particles import Particles
from jaxsph.model.transfer.function import TransferFunction, fitted
from jaxsph.model.transfer.maps import COLORMAPS, POINTS, colormap as colors_of, value_range
from jaxsph.model.transfer.presets import (
    FAINTEST,
    OPTICAL_DEPTH,
    RAMPS,
    STEEPNESS,
    Ramp,
    ends_of,
    numbers_shown,
    opaque_factor,
    rising,
)
from jaxsph.model.volume import Volume

__all__ = ["COLORMAPS", "default_transfer", "opacity_by_second", "value_range"]

OWN_POINTS = 33  # control points of extinction, where it has its own


def default_transfer(
    shown: Particles | Volume,
    colormap: str = "viridis",
    range: tuple[float, float] | None = None,
    optical_depth: float = OPTICAL_DEPTH,
    *,
    ramp: str | None = None,
    norm: str | None = None,
) -> TransferFunction:
    r"""A transfer function that shows particles or a volume with a colour map.

    Extinction rises to a peak $\sigma$ by one of `RAMPS`, over the range of values, or of the second of two quantities. The peak
    makes the optical depth $\tau$ of typical columns `optical_depth`: $\sum \tau^2 / \sum \tau$ over the columns of a
    coarse grid along the three axes, so that the bulk counts and not the fringe.

    Args:
        shown: whose quantity fixes the range and the extinction.
        colormap: its name, as for `jaxsph.scenes.colormap`.
        range: low and high end of the colours, in units of the quantity; `None` chooses (`value_range`).
        optical_depth: larger is more opaque.
        ramp: `"even"`; `"rising"` with the square of the place in the range, from 3 % of the peak; or `"steep"`, by the fourth
            power from 0, as suits the logarithm of a density over decades. By default steep of particles that have a quantity for
            extinction alone, else rising; of a volume from 0: what is lowest, as the air of a scan, is not shown.
        norm: domain of colours and extinction of one quantity, see `TransferFunction.control_values`; `None` is linear.

    Raises:
        ValueError: an unknown colour map, ramp or domain, a range that does not ascend or suit the domain, an optical depth that
            is not positive.
    """
    if ramp is not None and ramp not in RAMPS:
        raise ValueError(f"`ramp` must be one of {', '.join(RAMPS)}, got {ramp!r}")
    rises = RAMPS[ramp] if ramp else rising(STEEPNESS, 0.0 if isinstance(shown, Volume) else FAINTEST)
    if norm is not None:
        control = TransferFunction.control_values(norm, numbers_shown(shown), **ends_of(range), points=POINTS)
        made = TransferFunction.from_colormap(colormap, control, rises(np.linspace(0, 1, len(control))))
        return fitted(made, shown, optical_depth)
    colors = colors_of(colormap)
    low, high = value_range(numbers_shown(shown)) if range is None else (float(range[0]), float(range[1]))
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"`range` must be two finite numbers that ascend, got ({low}, {high})")
    control = low + (high - low) * np.linspace(0, 1, len(colors))
    if isinstance(shown, Particles) and shown.extinction_quantity is not None:
        colored = TransferFunction.from_points(control, colors, np.ones(len(control)))
        return opacity_by_second(colored, shown, optical_depth, ramp=ramp or "steep")
    own = None if ramp in (None, "rising") else np.linspace(low, high, OWN_POINTS)
    extinction = _extinction(shown, control if own is None else own, rises, optical_depth)
    return TransferFunction.from_points(control, colors, extinction, own)


def opacity_by_second(
    transfer: TransferFunction, particles: Particles, optical_depth: float = OPTICAL_DEPTH, *, ramp: str | float = "steep"
) -> TransferFunction:
    """The colours of a transfer function, with an extinction over the second of two quantities.

    Args:
        transfer: whose colours are taken.
        particles: with two quantities.
        optical_depth: as for `default_transfer`.
        ramp: as for `default_transfer`; or the power with which extinction rises from 0 over the range.

    Raises:
        ValueError: particles of one quantity.
    """
    second = particles.extinction_quantity
    if second is None:
        raise ValueError("`particles` must have two quantities: give `quantity=(of_colour, of_extinction)`")
    at = np.linspace(*value_range(particles.unpadded(second)), OWN_POINTS)
    rises = RAMPS[ramp] if isinstance(ramp, str) else rising(ramp, 0)
    extinction = _extinction(particles, at, rises, optical_depth)
    return TransferFunction.from_points(transfer.values, transfer.colors, extinction, at)


def _extinction(shown: Particles | Volume, at: np.ndarray, ramp: Ramp, optical_depth: float) -> np.ndarray:
    """A ramp over control values, such that typical columns have an optical depth."""
    shape = ramp(np.linspace(0, 1, len(at)))
    return opaque_factor(shown, at, shape, optical_depth) * shape
