r"""Looks: transfer functions that show particles or a volume, by default or by kind of data, opaque enough to read.

Flow: Particles or Volume, colour map or kind of data -> [looks] -> TransferFunction.

| preset | colours | domain | extinction over the map | for |
|---|---|---|---|---|
| `fluid` | viridis | linear | rises with the square | liquids, concentrations: a surface or dye to be seen into |
| `density` | heat | log | rises with the cube from 0: what is dense shows through thin gas | gas and dark matter, over decades |
| `temperature` | coolwarm | log | rises with the square | hot gas within cold |
| `velocity` | coolwarm | linear; 0 in the middle where signs change | high at both ends, or rising: flows, no rest | components |
| `speed` | ice, as water | log | rises with the square | speeds |
| `magnetic` | the same | log | rises with the square | field strengths, energies |
| `scan` | gray | percentile | none below a quarter, then rising | CT and MRI: air and noise are not shown |

Extinction is made such that typical columns have a given optical depth (`fitted`), and a map of colours has 16 control points.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxsph.model.particles.particles import Particles
from jaxsph.model.transfer.function import POINTS, TransferFunction
from jaxsph.model.transfer.maps import COLORMAPS, TAILS, colors_at, value_range
from jaxsph.model.transfer.maps import colormap as colors_of
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import product
from jaxsph.numerics.trees import on_host

__all__ = ["COLORMAPS", "default_transfer", "opacity_by_second", "value_range"]

OPTICAL_DEPTH = 3.0  # optical depth through the bulk of the particles: 5 % of the light behind gets through
FAINTEST = 0.03  # extinction at the low end of a range, over that at the high end: what is lowest is seen, but hides nothing
STEEPNESS = 2  # power with which extinction rises over a range: the middle, where most of a set tends to lie, stays translucent
MIN_DECADES = 1.0  # what a preset shows by `log` is shown by `linear` where it is not all positive, or spans fewer decades
OWN_POINTS = 33  # control points of extinction, where it has its own
CELLS = (4, 48)  # fewest and most cells along the longest edge when columns of the quantity are summed
MAX_COLUMNS = 64  # points along each axis of a volume that columns are summed over, about
Ramp = Callable[[np.ndarray], np.ndarray]


def _rising(power: float, least: float = FAINTEST) -> Ramp:
    return lambda place: least + (1 - least) * place**power


RAMPS: dict[str, Ramp] = {"even": np.ones_like, "rising": _rising(STEEPNESS), "steep": _rising(2 * STEEPNESS, 0)}
"""How extinction depends on the place in a range: not at all; as above; from 0, so that what is low is clear."""
NARROW = _rising(STEEPNESS, 0.3)  # of what a preset shows by decades, where there are none: all of it is seen


class Preset(NamedTuple):
    """Colours, domain, and extinction over the map, at most 1, of what changes its sign `both_ways`.

    Of a map that begins in black only what lies above the share `lift` is taken: nothing is lost on a dark background.
    """

    colormap: str
    domain: str
    ramp: Ramp
    both_ways: Ramp | None = None
    lift: float = 0.0


PRESETS: dict[str, Preset] = {
    "fluid": Preset("viridis", "linear", _rising(STEEPNESS, 0.35), lift=0.25),
    "density": Preset("heat", "log", _rising(3, 0), lift=0.25),
    "temperature": Preset("coolwarm", "log", _rising(STEEPNESS)),
    "velocity": Preset("coolwarm", "linear", _rising(STEEPNESS, 0), lambda place: np.abs(2 * place - 1) ** 1.5),
    "speed": Preset("ice", "log", _rising(STEEPNESS)),
    "magnetic": Preset("ice", "log", _rising(STEEPNESS)),
    "scan": Preset("gray", "percentile", lambda place: np.clip((place - 0.25) / 0.75, 0, 1) ** STEEPNESS),
}


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
    rising = RAMPS[ramp] if ramp else _rising(STEEPNESS, 0.0 if isinstance(shown, Volume) else FAINTEST)
    if norm is not None:
        control = TransferFunction.control_values(norm, _quantity(shown), **_ends(range), points=POINTS)
        made = TransferFunction.from_colormap(colormap, control, rising(np.linspace(0, 1, len(control))))
        return fitted(made, shown, optical_depth)
    colors = colors_of(colormap)
    low, high = value_range(_quantity(shown)) if range is None else (float(range[0]), float(range[1]))
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"`range` must be two finite numbers that ascend, got ({low}, {high})")
    control = low + (high - low) * np.linspace(0, 1, len(colors))
    if isinstance(shown, Particles) and shown.extinction_quantity is not None:
        colored = TransferFunction.from_points(control, colors, np.ones(len(control)))
        return opacity_by_second(colored, shown, optical_depth, ramp=ramp or "steep")
    own = None if ramp in (None, "rising") else np.linspace(low, high, OWN_POINTS)
    extinction = _extinction(shown, control if own is None else own, rising, optical_depth)
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
    rising = RAMPS[ramp] if isinstance(ramp, str) else _rising(ramp, 0)
    extinction = _extinction(particles, at, rising, optical_depth)
    return TransferFunction.from_points(transfer.values, transfer.colors, extinction, at)


@on_host
def preset(
    name: str,
    shown: Any,
    *,
    range: tuple[float, float] | None = None,
    norm: str | None = None,
    colormap: str | None = None,
    optical_depth: float = OPTICAL_DEPTH,
    points: int = POINTS,
) -> TransferFunction:
    """A transfer function that suits a kind of data.

    Args:
        name: one of `PRESETS`.
        shown: Particles or a Volume; or (low, high) of a quantity, for a peak of extinction of 1 a length unit.
        range: ends of the colours, see `jaxsph.TransferFunction.control_values`; `None` chooses them by the quantity.
        norm: other than the preset's own.
        colormap: other than the preset's own.
        optical_depth: of typical columns; larger is more opaque.
        points: control points.

    Raises:
        ValueError: an unknown preset, domain or colour map; ends that do not suit the domain.
    """
    if name not in PRESETS:
        raise ValueError(f"`name` must be one of {', '.join(PRESETS)}, got {name!r}")
    chosen, quantity = PRESETS[name], None
    if isinstance(shown, Particles | Volume):
        quantity = _quantity(shown)
    else:
        if np.shape(shown) != (2,) or np.asarray(shown).dtype.kind not in "iuf":
            raise ValueError(f"`shown` must be particles, a volume, or low and high of a quantity, got {type(shown).__name__}")
        range, shown = tuple(shown), None
    given, ramp, above = _ends(range), chosen.ramp, 0.0
    if chosen.domain == "log" and quantity is not None and not quantity.any():  # nothing of these kinds is below 0, whose colour
        low, high = range or (-1.0, 1.0)  # is that in the middle
        if low < 0 < high:
            given, above = {"low": 0.0, "high": float(high)}, -low / (high - low)
    if norm is None:
        norm = chosen.domain
        low, high = range or (np.percentile(quantity, TAILS) if quantity is not None and quantity.size else (0.0, 0.0))
        over_decades = low > 0 and np.log10(high / low) >= MIN_DECADES
        if chosen.both_ways is not None and low < 0 < high:
            ramp, largest = chosen.both_ways, float(max(abs(low), abs(high)))
            given = given if range else {"low": -largest, "high": largest}
        elif norm == "percentile" and range:
            norm = "linear"
        elif norm == "log" and not over_decades:
            norm, ramp = "linear", NARROW
    control = TransferFunction.control_values(norm, quantity, **given, points=points)
    colors: Any = colormap
    if colormap is None or above:
        rows, lift = colors_of(colormap or chosen.colormap), 0.0 if colormap else chosen.lift
        place = np.linspace(lift + (1 - lift) * above, 1, len(rows)) * (len(rows) - 1)
        colors = colors_at(place, np.arange(len(rows)), rows)
    made = TransferFunction.from_colormap(colors, control, ramp(np.linspace(0, 1, points)))
    return made if shown is None else fitted(made, shown, optical_depth)


def fitted(transfer: TransferFunction, shown: Particles | Volume, optical_depth: float = OPTICAL_DEPTH) -> TransferFunction:
    """The same colours with extinction scaled such that typical columns of particles or of a volume have an optical depth.

    Args:
        transfer: of which only the ratios of extinction count.
        shown: columns of which are looked at, along three axes; see `default_transfer`.
        optical_depth: 3 lets 5 % of the light behind through; larger is more opaque.

    Raises:
        ValueError: an optical depth that is not positive.
    """
    own = transfer.values if transfer.extinction_values is None else transfer.extinction_values
    values, extinction = np.asarray(own, np.float64), np.asarray(transfer.extinction, np.float64)
    return scaled(transfer, _made_opaque(shown, values, extinction, optical_depth))


def scaled(transfer: TransferFunction, factor: float) -> TransferFunction:
    """With so many times the extinction."""
    return dataclasses.replace(transfer, extinction=product(transfer.extinction, np.asarray(factor, transfer.extinction.dtype)))


def _extinction(shown: Particles | Volume, at: np.ndarray, ramp: Ramp, optical_depth: float) -> np.ndarray:
    """A ramp over control values, such that typical columns have an optical depth."""
    shape = ramp(np.linspace(0, 1, len(at)))
    return _made_opaque(shown, at, shape, optical_depth) * shape


def _quantity(shown: Particles | Volume) -> np.ndarray:
    """The numbers that there are; of a volume some of them, where that has any."""
    if not isinstance(shown, Volume):
        return shown.unpadded(shown.quantity)
    few, whole = _there(_coarse(shown)[0]), np.asarray(shown.values)
    return few if few.size else _there(whole.astype(np.float64))


def _there(values: np.ndarray) -> np.ndarray:
    return values[~np.isnan(values)]


def _ends(range: tuple[float, float] | None) -> dict[str, float | None]:
    if range is not None and len(range) != 2:
        raise ValueError(f"`range` must be two numbers, low and high, got {len(range)}")
    return {"low": None, "high": None} if range is None else {"low": float(range[0]), "high": float(range[1])}


def _made_opaque(shown: Particles | Volume, values: np.ndarray, extinction: np.ndarray, optical_depth: float) -> float:
    """What extinctions at control values are multiplied by, such that columns along the axes have an optical depth in the mean
    that is weighted by itself; that depth where there is nothing.
    """
    if not (np.isfinite(optical_depth) and optical_depth > 0):
        raise ValueError(f"`optical_depth` must be > 0 and finite, got {optical_depth}")
    if isinstance(shown, Volume):
        quantity, size = _coarse(shown)
        cells = np.where(np.isnan(quantity), 0, np.interp(quantity, values, extinction))
    else:
        if not len(shown):
            return optical_depth
        opacity = np.interp(shown.unpadded(shown.quantities[-1]), values, extinction)
        cells, size = _cells(shown.places(), shown.unpadded(shown.support), opacity)
    columns = np.concatenate([(cells.sum(axis) * size[axis]).ravel() for axis in range(3)])
    return optical_depth / (float((columns**2).sum() / columns.sum()) if columns.any() else 1.0)


def _coarse(volume: Volume) -> tuple[np.ndarray, np.ndarray]:
    """Some of the values of a volume, float64, and the distances between them along the axes."""
    steps = [max(1, points // MAX_COLUMNS) for points in volume.shape]
    values = np.asarray(volume.values)[tuple(slice(None, None, step) for step in steps)].astype(np.float64)
    return values, np.asarray(volume.spacing, np.float64) * steps


def _cells(position: np.ndarray, support: np.ndarray, extinction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean extinction in the cells of a coarse grid around particles, and their sizes along the axes."""
    lower, upper = (position - support[:, None]).min(0), (position + support[:, None]).max(0)
    longest = float((upper - lower).max())
    cell = longest / int(np.clip(longest / np.median(support), *CELLS))
    shape = np.maximum(np.ceil((upper - lower) / cell * (1 - 1e-9)).astype(int), 1)
    index = np.minimum(((position - lower) / cell).astype(int), shape - 1)
    flat = np.ravel_multi_index(tuple(index.T), tuple(shape))
    sphere = 4 / 3 * np.pi * support**3
    covered = np.bincount(flat, sphere, int(shape.prod()))
    mean = np.bincount(flat, sphere * extinction, int(shape.prod())) / np.where(covered > 0, covered, 1)
    return (mean * np.minimum(covered / cell**3, 1)).reshape(shape), np.full(3, cell)
