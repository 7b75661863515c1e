r"""Presets: what kinds of data are well shown by.

Flow: kind of data, Particles or Volume -> [presets] -> TransferFunction.

| preset | colours | domain | extinction over the map | for |
|---|---|---|---|---|
| `fluid` | viridis | linear | rises with the square | liquids, concentrations: a surface or dye to be seen into |
| `density` | heat | log | rises with the cube from 0: what is dense shows through thin gas | gas and dark matter, over decades |
| `temperature` | coolwarm | log | rises with the square | hot gas within cold |
| `velocity` | coolwarm | linear; 0 in the middle where signs change | high at both ends, or rising: flows, no rest | components |
| `magnetic` | ice | log | rises with the square | field strengths, energies |
| `scan` | gray | percentile | none below a quarter, then rising | CT and MRI: air and noise are not shown |

Extinction is made such that typical columns have a given optical depth (`fitted`), and a map of colours has 16 control points:
in a `log` domain colours lie as far from those of the logarithm as `jaxsph.model.transfer.domains.log_departure` says.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxsph.model import Particles, TransferFunction, Volume
from jaxsph.model.transfer.colormaps import POINTS, TAILS
from jaxsph.model.transfer.domains import control_values
from jaxsph.model.transfer.looks import FAINTEST, OPTICAL_DEPTH, STEEPNESS, coarse, typical_depth
from jaxsph.model.transfer.maps import from_colormap

MIN_DECADES = 1.0
"""What a preset shows by `log` is shown by `linear` where it is not all positive, or spans fewer decades."""

Ramp = Callable[[np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Preset:
    """Colours, domain, and extinction over the map, at most 1, of what changes its sign `both_ways`."""

    colormap: str
    domain: str
    ramp: Ramp
    both_ways: Ramp | None = None


def _rising(power: float, least: float = FAINTEST) -> Ramp:
    return lambda place: least + (1 - least) * place**power


PRESETS: dict[str, Preset] = {
    "fluid": Preset("viridis", "linear", _rising(STEEPNESS)),
    "density": Preset("heat", "log", _rising(3, 0)),
    "temperature": Preset("coolwarm", "log", _rising(STEEPNESS)),
    "velocity": Preset("coolwarm", "linear", _rising(STEEPNESS, 0), lambda place: np.abs(2 * place - 1) ** 1.5),
    "magnetic": Preset("ice", "log", _rising(STEEPNESS)),
    "scan": Preset("gray", "percentile", lambda place: np.clip((place - 0.25) / 0.75, 0, 1) ** STEEPNESS),
}
"""By name."""


def preset(
    name: str,
    shown: Any,
    *,
    values: tuple[float, float] | None = None,
    domain: str | None = None,
    colormap_name: str | None = None,
    optical_depth: float = OPTICAL_DEPTH,
    points: int = POINTS,
) -> TransferFunction:
    """A transfer function that suits a kind of data.

    Args:
        name: one of `PRESETS`.
        shown: Particles or a Volume; or (low, high) of a quantity, for a peak of extinction of 1 a length unit.
        values: ends of the colours, see `jaxsph.control_values`; `None` chooses them by the quantity.
        domain: other than the preset's own.
        colormap_name: other than the preset's own.
        optical_depth: of typical columns; larger is more opaque.
        points: control points.

    Raises:
        ValueError: an unknown preset, domain or colour map; ends that do not suit the domain.
    """
    if name not in PRESETS:
        raise ValueError(f"`name` must be one of {', '.join(PRESETS)}, got {name!r}")
    chosen = PRESETS[name]
    if not isinstance(shown, Particles | Volume):
        values, shown = tuple(shown), None
    quantity = np.zeros(0) if shown is None else _quantity(shown)
    ramp, mirrored = chosen.ramp, chosen.both_ways is not None and domain is None and _changes_sign(quantity, values)
    if mirrored and chosen.both_ways is not None:
        ramp, values = chosen.both_ways, _symmetric(quantity, values)
    domain = domain or _usable(chosen.domain, quantity, values)
    control = control_values(domain, quantity if shown is not None else None, **_ends(values), points=points)
    made = from_colormap(colormap_name or chosen.colormap, control, ramp(np.linspace(0, 1, points)))
    return made if shown is None else fitted(made, shown, optical_depth)


def domain_transfer(
    shown: Particles | Volume,
    domain: str,
    colormap_name: str = "viridis",
    values: tuple[float, float] | None = None,
    optical_depth: float = OPTICAL_DEPTH,
    points: int = POINTS,
) -> TransferFunction:
    """As `default_transfer`, with colours and extinction over a domain other than the linear one; see `jaxsph.control_values`.

    Raises:
        ValueError: an unknown domain or colour map, ends that do not suit the domain, an optical depth that is not positive.
    """
    control = control_values(domain, _quantity(shown), **_ends(values), points=points)
    least = 0.0 if isinstance(shown, Volume) else FAINTEST
    return fitted(
        from_colormap(colormap_name, control, _rising(STEEPNESS, least)(np.linspace(0, 1, points))), shown, optical_depth
    )


def fitted(transfer: TransferFunction, shown: Particles | Volume, optical_depth: float = OPTICAL_DEPTH) -> TransferFunction:
    """The same colours with extinction scaled such that typical columns of particles or of a volume have an optical depth.

    Args:
        transfer: of which only the ratios of extinction count.
        shown: columns of which are looked at, along three axes; see `default_transfer`.
        optical_depth: 3 lets 5 % of the light behind through; larger is more opaque.

    Raises:
        ValueError: an optical depth that is not positive.
    """
    if not (np.isfinite(optical_depth) and optical_depth > 0):
        raise ValueError(f"`optical_depth` must be > 0 and finite, got {optical_depth}")
    extinction = np.asarray(transfer.extinction, np.float64)
    depth = typical_depth(shown, np.asarray(transfer.values, np.float64), extinction)
    return dataclasses.replace(
        transfer, extinction=transfer.extinction * np.asarray(optical_depth / depth, transfer.extinction.dtype)
    )


def _quantity(shown: Particles | Volume) -> np.ndarray:
    return coarse(shown)[0] if isinstance(shown, Volume) else np.asarray(shown.quantity, np.float64)[np.asarray(shown.valid)]


def _ends(values: tuple[float, float] | None) -> dict[str, float | None]:
    if values is not None and len(values) != 2:
        raise ValueError(f"`values` must be two numbers, low and high, got {len(values)}")
    return {"low": None, "high": None} if values is None else {"low": float(values[0]), "high": float(values[1])}


def _changes_sign(quantity: np.ndarray, values: tuple[float, float] | None) -> bool:
    low, high = values or (np.percentile(quantity, TAILS) if quantity.size else (0, 1))
    return bool(low < 0 < high)


def _symmetric(quantity: np.ndarray, values: tuple[float, float] | None) -> tuple[float, float]:
    """The ends given; else such that zero is in the middle."""
    if values is not None:
        return values
    largest = float(np.abs(np.percentile(quantity, TAILS)).max())
    return -largest, largest


def _usable(domain: str, quantity: np.ndarray, values: tuple[float, float] | None) -> str:
    """The domain of a preset, where values are such as it is meant for."""
    if domain == "percentile":
        return domain if values is None else "linear"
    if domain != "log":
        return domain
    low, high = values or (np.percentile(quantity, TAILS) if quantity.size else (0.0, 0.0))
    return "log" if low > 0 and np.log10(high / low) >= MIN_DECADES else "linear"
