"""Colour maps: by name, the range of a quantity that they span, and control points of transfer functions made of them.

Flow: name, quantity -> [transfer_maps] -> TransferFunction, Points, Projection.
"""

from __future__ import annotations

import copy
import sys
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.model.transfer.function import POINTS, numbers
from jaxsph.numerics.names import did_you_mean

COLORMAPS = ("viridis", "heat", "ice", "coolwarm", "gray")  # names of maps that looks are made of, and that messages list first

OWN: dict[str, tuple[str, ...]] = {
    "heat": ("2a0510", "6b0f1a", "b11226", "e0401f", "f57f17", "fbb52c", "fde67a", "fffbe0"),
    "ice": ("0b1d51", "13418f", "1b6fb8", "2f9fd0", "66c6dd", "a9e2e6", "e8f8f5"),
    "gray": ("202020", "ffffff"),
}
"""Control colours of the maps of this package, from low to high, evenly spaced; sRGB as displayed.

They hide those of the same names elsewhere, which begin at black: what is low would not be seen on black.
"""

TAILS = (0.5, 99.5)  # percentiles of the quantity between which colours vary: a few odd particles must not take all of them


def colormap(name: str, points: int = POINTS) -> Float[np.ndarray, "points 3"]:
    """Colours of a map from low to high, evenly spaced, in [0, 1]; a name that ends in `_r` is reversed.

    Args:
        name: `heat`, `ice`, `gray`; or one of the many hundreds of the package cmap, with or without the collection that it is
            of: `viridis`, `coolwarm`, `cmocean:thermal`, `crameri:batlow`, `cmasher:rainforest`; or one that was registered with
            matplotlib.
        points: how many colours.

    Raises:
        ValueError: an unknown name; the message has those that are most like it.
    """
    base, reverse = (name[:-2], -1) if name.endswith("_r") else (name, 1)
    place = np.linspace(0, 1, points)
    if base in OWN:
        rows = np.array([[int(code[i : i + 2], 16) / 255 for i in (0, 2, 4)] for code in OWN[base]])
        at = np.linspace(0, 1, len(rows))
        return np.stack([np.interp(place, at, channel) for channel in rows.T], 1)[::reverse]
    return np.clip(np.asarray(_catalogued(base)(place), np.float64)[::reverse, :3], 0, 1)


def _catalogued(name: str) -> Any:
    """The map of a name of cmap's, or of matplotlib's where that is in use: takes places in [0, 1], gives RGBA."""
    from cmap import Catalog, Colormap

    catalog = Catalog()
    try:
        return Colormap(catalog.resolve(name))  # by its full name: of two of one short name, cmap logs that there is another
    except KeyError:
        registered = getattr(sys.modules.get("matplotlib"), "colormaps", {})
        if name in registered:
            return registered[name]
    more = did_you_mean(name, (*catalog.short_keys(), *registered, *COLORMAPS))
    raise ValueError(
        f"`colormap` must be one of {', '.join(COLORMAPS)}, or a name of the package cmap, such as cmocean:thermal "
        f"(cmap-docs.readthedocs.io shows them all); got {name!r}{more}"
    )


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


Rows = tuple[np.ndarray, np.ndarray, np.ndarray]  # values, colours and extinction, for `TransferFunction.from_points`


def of_colormap(colors: Any, values: Any, extinction: Any) -> Rows:
    """See `TransferFunction.from_colormap`."""
    values = np.asarray(numbers("values", values), np.float64)
    if values.ndim != 1 or len(values) < 2:
        raise ValueError(f"`values` must be two ends, or control values (K,), got shape {values.shape}")
    if len(values) == 2:
        values = np.linspace(values[0], values[1], POINTS)
    rows = colormap(colors, len(values)) if isinstance(colors, str) else np.atleast_2d(np.asarray(colors, np.float64))
    return values, _spread(rows, len(values)), _spread(extinction, len(values))


def of_matplotlib(cmap: Any, norm: Any, low: float | None, high: float | None, extinction: Any, points: int) -> Rows:
    """See `TransferFunction.from_matplotlib`."""
    chosen = _named(cmap) if isinstance(cmap, str) else cmap
    if not (callable(chosen) and hasattr(chosen, "N")):
        raise ValueError(f"`cmap` must be a Colormap of matplotlib's, or the name of one, got {type(cmap).__name__}")
    if hasattr(norm, "boundaries"):
        edges = np.asarray(norm.boundaries, np.float64)
        rgba = np.asarray(chosen(np.asarray(norm((edges[1:] + edges[:-1]) / 2))), np.float64)
        bands = _spread(extinction, len(rgba)) * rgba[:, 3]
        return np.repeat(edges, 2)[1:-1], np.repeat(rgba[:, :3], 2, 0), np.repeat(bands, 2)
    ends = [_end(norm, *named) for named in (("vmin", "low", low), ("vmax", "high", high))]
    if not (np.isfinite(ends).all() and ends[0] < ends[1]):
        raise ValueError(f"`low` and `high` must be finite and ascend, got {ends[0]:g} and {ends[1]:g}")
    place = np.linspace(0, 1, points)
    values = np.asarray(_inverse(norm, ends, place), np.float64)
    values[[0, -1]] = ends
    rgba = np.asarray(chosen(place), np.float64)
    return values, rgba[:, :3], _spread(extinction, points) * rgba[:, 3]


def _named(name: str) -> Any:
    try:
        from matplotlib import colormaps
    except ImportError as error:
        own = ", ".join(COLORMAPS)
        remedy = f'pip install "jaxsph[color]", or `TransferFunction.from_colormap` with one of {own}'
        raise ImportError(f"colour maps by name of matplotlib's need the library `matplotlib`: {remedy}") from error
    if name not in colormaps:
        told = "`matplotlib.colormaps` lists them"
        raise ValueError(f"`cmap` must be a name of matplotlib's, got {name!r}{did_you_mean(name, colormaps)}; {told}")
    return colormaps[name]


def _end(norm: Any, name: str, argument: str, given: float | None) -> float:
    """An end of the norm's own, or the one given."""
    own = getattr(norm, name, None)
    if own is None and given is None:
        raise ValueError(f"`norm` has no `{name}`; give it one, or give `{argument}`")
    if own is not None and given is not None and float(own) != float(given):
        raise ValueError(f"`{argument}` = {given:g} and `norm.{name}` = {own:g} do not agree; give one of them")
    return float(given if own is None else own)  # type: ignore[arg-type]


def _inverse(norm: Any, ends: list[float], place: np.ndarray) -> Any:
    if norm is None:
        return ends[0] + (ends[1] - ends[0]) * place
    if not hasattr(norm, "inverse"):
        raise ValueError(
            f"`norm` must have an inverse, and {type(norm).__name__} has none; give LogNorm, SymLogNorm or Normalize"
        )
    own = copy.copy(norm)
    own.vmin, own.vmax = ends
    try:
        return np.ma.filled(own.inverse(place), np.nan)
    except ValueError as error:
        kind = type(norm).__name__
        raise ValueError(f"`norm` = {kind} from {ends[0]:g} to {ends[1]:g} cannot be used: {error}; a LogNorm is > 0") from error


def _spread(given: Any, points: int) -> np.ndarray:
    """Rows, or numbers, evenly placed from the first to the last, at so many places."""
    rows = np.asarray(numbers("extinction", given), np.float64)
    rows = rows[None] if rows.ndim == 0 else rows
    if rows.ndim not in (1, 2) or not len(rows):
        raise ValueError(f"`extinction` must be a number, or some from the low end to the high, got shape {rows.shape}")
    place, at = np.linspace(0, len(rows) - 1, points), np.arange(len(rows))
    columns = [np.interp(place, at, column) for column in rows.reshape(len(rows), -1).T]
    return np.stack(columns, 1).reshape(points, *rows.shape[1:])
