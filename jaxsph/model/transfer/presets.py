r"""Presets: colours and extinction that suit a kind of data, and how opaque what is shown is by them.

Flow: Particles or Volume, kind of data -> [presets] -> colours, control values, extinction -> TransferFunction.

| preset | colours | domain | extinction over the map | for |
|---|---|---|---|---|
| `fluid` | viridis | linear | rises with the square | liquids, concentrations: a surface or dye to be seen into |
| `density` | heat | log | rises with the cube from 0: what is dense shows through thin gas | gas and dark matter, over decades |
| `temperature` | coolwarm | log | rises with the square | hot gas within cold |
| `velocity` | coolwarm | linear; 0 in the middle where signs change | high at both ends, or rising: flows, no rest | components |
| `speed` | ice, as water | log | rises with the square | speeds |
| `magnetic` | the same | log | rises with the square | field strengths, energies |
| `scan` | gray | percentile | none below a quarter, then rising | CT and MRI: air and noise are not shown |

Extinction is made such that typical columns have a given optical depth (`opaque_factor`), and a map of colours has 16 points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxsph.model.particles.particles import Particles
from jaxsph.model.transfer.maps import POINTS, TAILS, colormap as colormap_rows, colors_at, control_values
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import typed

OPTICAL_DEPTH = 3.0  # optical depth through the bulk of the particles: 5 % of the light behind gets through
FAINTEST = 0.03  # extinction at the low end of a range, over that at the high end: what is lowest is seen, but hides nothing
STEEPNESS = 2  # power with which extinction rises over a range: the middle, where most of a set tends to lie, stays translucent
MIN_DECADES = 1.0  # what a preset shows by `log` is shown by `linear` where it is not all positive, or spans fewer decades
CELLS = (4, 48)  # fewest and most cells along the longest edge when columns of the quantity are summed
MAX_COLUMNS = 64  # points along each axis of a volume that columns are summed over, about
Ramp = Callable[[np.ndarray], np.ndarray]


def rising(power: float, least: float = FAINTEST) -> Ramp:
    """A ramp from `least` to 1 by a power of the place."""
    return lambda place: least + (1 - least) * place**power


RAMPS: dict[str, Ramp] = {"even": np.ones_like, "rising": rising(STEEPNESS), "steep": rising(2 * STEEPNESS, 0)}
"""How extinction depends on the place in a range: not at all; as above; from 0, so that what is low is clear."""
NARROW = rising(STEEPNESS, 0.3)  # of what a preset shows by decades, where there are none: all of it is seen


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
    "fluid": Preset("viridis", "linear", rising(STEEPNESS, 0.35), lift=0.25),
    "density": Preset("heat", "log", rising(3, 0), lift=0.25),
    "temperature": Preset("coolwarm", "log", rising(STEEPNESS)),
    "velocity": Preset("coolwarm", "linear", rising(STEEPNESS, 0), lambda place: np.abs(2 * place - 1) ** 1.5),
    "speed": Preset("ice", "log", rising(STEEPNESS)),
    "magnetic": Preset("ice", "log", rising(STEEPNESS)),
    "scan": Preset("gray", "percentile", lambda place: np.clip((place - 0.25) / 0.75, 0, 1) ** STEEPNESS),
}


@typed
def preset_map(
    name: str,
    shown: Any,
    *,
    range: Any = None,
    norm: str | None = None,
    colormap: str | None = None,
    points: int = POINTS,
) -> tuple[Any, np.ndarray, np.ndarray]:
    """Colours, control values and extinction of a preset; see `TransferFunction.preset`."""
    if name not in PRESETS:
        raise ValueError(f"`name` must be one of {', '.join(PRESETS)}, got {name!r}")
    chosen, quantity = PRESETS[name], None
    if isinstance(shown, Particles | Volume):
        quantity = numbers_shown(shown)
    else:
        if np.shape(shown) != (2,) or np.asarray(shown).dtype.kind not in "iuf":
            raise ValueError(f"`shown` must be particles, a volume, or low and high of a quantity, got {type(shown).__name__}")
        range = tuple(shown)
    given, ramp, above = ends_of(range), chosen.ramp, 0.0
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
    control = control_values(norm, quantity, None, given["low"], given["high"], None, points)
    colors: Any = colormap
    if colormap is None or above:
        rows, lift = colormap_rows(colormap or chosen.colormap), 0.0 if colormap else chosen.lift
        place = np.linspace(lift + (1 - lift) * above, 1, len(rows)) * (len(rows) - 1)
        colors = colors_at(place, np.arange(len(rows)), rows)
    return colors, control, ramp(np.linspace(0, 1, points))


def numbers_shown(shown: Particles | Volume) -> np.ndarray:
    """The numbers that there are; of a volume some of them, where that has any."""
    if not isinstance(shown, Volume):
        return shown.unpadded(shown.quantity)
    few, whole = _there(_coarse(shown)[0]), np.asarray(shown.values)
    return few if few.size else _there(whole.astype(np.float64))


def _there(values: np.ndarray) -> np.ndarray:
    return values[~np.isnan(values)]


def ends_of(range: tuple[float, float] | None) -> dict[str, float | None]:
    """Arguments `low` and `high` of control values."""
    if range is not None and len(range) != 2:
        raise ValueError(f"`range` must be two numbers, low and high, got {len(range)}")
    return {"low": None, "high": None} if range is None else {"low": float(range[0]), "high": float(range[1])}


def opaque_factor(shown: Particles | Volume, values: np.ndarray, extinction: np.ndarray, optical_depth: float) -> float:
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
