"""From colour maps to transfer functions: control points at the values of a domain, or where a norm of matplotlib has them.

Flow: colour map, values or norm, extinction -> [transfer_maps] -> TransferFunction.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxsph.model.transfer.colormaps import COLORMAPS, POINTS, colormap
from jaxsph.model.transfer.function import TransferFunction, numbers


def from_colormap(colors: Any, values: Any, extinction: Any = 1.0) -> TransferFunction:
    """A transfer function whose colours are those of a map, evenly placed over its control values.

    Args:
        colors: name of a colour map, or (M, 3) colours from low to high.
        values: (K,) control values, as `jaxsph.control_values` lays them; or the two ends, between which 16 are evenly spaced.
        extinction: per length unit: a number, or any number of them from the low end to the high, evenly placed.

    Raises:
        ValueError: an unknown colour map, or what `TransferFunction.from_points` refuses.
    """
    rows = colormap(colors) if isinstance(colors, str) else np.atleast_2d(np.asarray(colors, np.float64))
    values = np.asarray(numbers("values", values), np.float64)
    if values.ndim != 1 or len(values) < 2:
        raise ValueError(f"`values` must be two ends, or control values (K,), got shape {values.shape}")
    if len(values) == 2:
        values = np.linspace(values[0], values[1], POINTS)
    return TransferFunction.from_points(values, _spread(rows, len(values)), _spread(extinction, len(values)))


def from_matplotlib(
    cmap: Any,
    norm: Any = None,
    *,
    low: float | None = None,
    high: float | None = None,
    extinction: Any = 1.0,
    points: int = POINTS,
) -> TransferFunction:
    """A transfer function of a colour map of matplotlib's, as a figure made with the same map and norm shows a quantity.

    Args:
        cmap: a `Colormap`, or its name. Extinction is multiplied by its alpha.
        norm: such as `Normalize`, `LogNorm`, `SymLogNorm`, with its `vmin` and `vmax`; `None` is linear from `low` to `high`. Of
            a `BoundaryNorm` the colours jump at its boundaries.
        low, high: ends, where the norm does not have them.
        extinction: per length unit: a number, or any number of them from the low end to the high, evenly placed.
        points: control points; at these the colours are the map's.

    Raises:
        ImportError: `cmap` is a name, and matplotlib is not installed.
        ValueError: an unknown name, a norm without its ends or without an inverse.
    """
    chosen = _named(cmap) if isinstance(cmap, str) else cmap
    if not (callable(chosen) and hasattr(chosen, "N")):
        raise ValueError(f"`cmap` must be a Colormap of matplotlib's, or the name of one, got {type(cmap).__name__}")
    if hasattr(norm, "boundaries"):
        return _of_boundaries(chosen, norm, extinction)
    ends = [_end(norm, name, end) for name, end in (("vmin", low), ("vmax", high))]
    if not (np.isfinite(ends).all() and ends[0] < ends[1]):
        raise ValueError(f"`low` and `high` must be finite and ascend, got {ends[0]:g} and {ends[1]:g}")
    place = np.linspace(0, 1, points)
    values = np.asarray(_inverse(norm, ends, place), np.float64)
    values[[0, -1]] = ends
    return _of_rgba(values, np.asarray(chosen(place), np.float64), extinction)


def _named(name: str) -> Any:
    try:
        from matplotlib import colormaps
    except ImportError as error:
        own = ", ".join(COLORMAPS)
        remedy = f'pip install "jaxsph[color]", or `TransferFunction.from_colormap` with one of {own}'
        raise ImportError(f"colour maps by name of matplotlib's need the library `matplotlib`: {remedy}") from error
    if name not in colormaps:
        like = sorted(known for known in colormaps if name.lower()[:3] in known.lower())[:8]
        more = f"; there are {', '.join(like)}" if like else "; `matplotlib.colormaps` lists them"
        raise ValueError(f"`cmap` must be a name of matplotlib's, got {name!r}{more}")
    return colormaps[name]


def _end(norm: Any, name: str, given: float | None) -> float:
    """An end of the norm's own, or the one given."""
    own = getattr(norm, name, None)
    if own is None and given is None:
        argument = "low" if name == "vmin" else "high"
        raise ValueError(f"`norm` has no `{name}`; give it one, or give `{argument}`")
    if own is not None and given is not None and float(own) != float(given):
        argument = "low" if name == "vmin" else "high"
        raise ValueError(f"`{argument}` = {given:g} and `norm.{name}` = {own:g} do not agree; give one of them")
    return float(given if own is None else own)  # type: ignore[arg-type]


def _inverse(norm: Any, ends: list[float], place: np.ndarray) -> Any:
    if norm is None:
        return ends[0] + (ends[1] - ends[0]) * place
    if not hasattr(norm, "inverse"):
        raise ValueError(
            f"`norm` must have an inverse, and {type(norm).__name__} has none; give LogNorm, SymLogNorm or Normalize"
        )
    import copy

    own = copy.copy(norm)
    own.vmin, own.vmax = ends
    try:
        return np.ma.filled(own.inverse(place), np.nan)
    except ValueError as error:
        kind = type(norm).__name__
        raise ValueError(f"`norm` = {kind} from {ends[0]:g} to {ends[1]:g} cannot be used: {error}; a LogNorm is > 0") from error


def _of_boundaries(chosen: Any, norm: Any, extinction: Any) -> TransferFunction:
    edges = np.asarray(norm.boundaries, np.float64)
    middles = (edges[1:] + edges[:-1]) / 2
    rgba = np.asarray(chosen(np.asarray(norm(middles))), np.float64)
    bands = _spread(extinction, len(middles)) * rgba[:, 3]
    return TransferFunction.from_points(np.repeat(edges, 2)[1:-1], np.repeat(rgba[:, :3], 2, 0), np.repeat(bands, 2))


def _of_rgba(values: np.ndarray, rgba: np.ndarray, extinction: Any) -> TransferFunction:
    return TransferFunction.from_points(values, rgba[:, :3], _spread(extinction, len(values)) * rgba[:, 3])


def _spread(given: Any, points: int) -> np.ndarray:
    """Rows, or numbers, evenly placed from the first to the last, at so many places."""
    rows = np.asarray(numbers("extinction", given), np.float64)
    rows = rows[None] if rows.ndim == 0 else rows
    if rows.ndim not in (1, 2) or not len(rows):
        raise ValueError(f"`extinction` must be a number, or some from the low end to the high, got shape {rows.shape}")
    place, at = np.linspace(0, len(rows) - 1, points), np.arange(len(rows))
    columns = [np.interp(place, at, column) for column in rows.reshape(len(rows), -1).T]
    return np.stack(columns, 1).reshape(points, *rows.shape[1:])
