r"""Colour maps by name; domains: where on the axis of a quantity their colours sit; and scales, on which that axis is drawn.

Flow: names, quantity -> [maps] -> TransferFunction, Points, Projection; control values -> [Scale] -> bins, axes.

A transfer function is linear in Q between its control points, whatever the domain: a domain lays the points. The points of a map
are at even places $t_k = k / (K - 1)$, and a domain says which value is at which place:

| domain | value at place t |
|---|---|
| `linear` | $l + t (h - l)$ |
| `log` | $l (h / l)^t$ |
| `symlog` | $s(t) = S(l) + t (S(h) - S(l))$ with $S(Q) = \mathrm{sign}(Q) \log(1 + \|Q\| / w)$ (Webber 2012) |
| `percentile` | as `linear`, between two percentiles of the quantity |
| `equalised` | the quantile t of the quantity: every colour is that of as many particles |

The other way to a logarithmic picture is another field: the quantity `log10:NAME` is the mean of logarithms, as where a code
interpolates the logarithm of a grid; the domain `log` colours the logarithm of the mean. Between a dense and a thin particle
the mean is nearly the dense one's, the mean of logarithms halfway. The mean is rounded by an eps of the largest quantity
nearby, and means over segments by a few eps of the largest control value: in float32 a domain tells apart what is above about
1e-6 of its upper end, and a quantity over more decades is to be shown by its logarithm, or in float64.

References: Webber 2012, *A bi-symmetric log transformation for wide-range data*.
"""

from __future__ import annotations

import copy
import dataclasses
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsph.numerics.checks import own, plain, require_real
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
POINTS = 16  # control points of a map: enough for a smooth map, few enough to look up by comparisons
DOMAINS = "linear", "log", "symlog", "percentile", "equalised"
LINEAR_SHARE = 1e-3  # width around zero in which `symlog` is about linear, over the largest value, unless it is given
EVEN = 1e-5  # of what they span, that evenly spaced control values may be off: float32 rounds them
FEW = 8  # control points fewer than this were laid by hand, and not by a domain: their axis is linear
WIDE = 2.0  # largest over least of control values from which an even spacing of logarithms is meant as such
UNRESOLVED = 1e-6  # of the largest value: ends that are nearer to each other float32 would not tell apart


def numbers(name: str, value: Any) -> Any:
    """Numbers of an argument of a transfer function; `ValueError` where they carry a unit."""
    unit = "the reciprocal of the unit of positions" if name == "extinction" else "in the unit of the quantity"
    return require_real(name, plain(name, value, "a transfer function does not know the unit of a scene", f"or as it is {unit}"))


def colors_at(values: Any, places: Any, rows: np.ndarray) -> np.ndarray:
    """Colours at values, (..., channels), between rows of them at places that ascend."""
    return np.stack([np.interp(values, places, channel) for channel in rows.T], -1)


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
        return colors_at(place, at, rows)[::reverse]
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
    wrong = f"`colormap` must be one of {', '.join(COLORMAPS)}, or a name of the package cmap, such as cmocean:thermal"
    raise ValueError(f"{wrong} (cmap-docs.readthedocs.io shows them all); got {name!r}{more}")


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


MAX_POINTS = 1 << 20  # control points of a map
Rows = tuple[np.ndarray, np.ndarray, np.ndarray]  # values, colours and extinction, for `TransferFunction.from_points`


def of_colormap(colors: Any, values: Any, extinction: Any) -> Rows:
    """See `TransferFunction.from_colormap`."""
    values = np.asarray(numbers("values", values), np.float64)
    if values.ndim != 1 or len(values) < 2:
        raise ValueError(f"`values` must be two ends, or control values (K,), got shape {values.shape}")
    if len(values) == 2:
        values = np.linspace(values[0], values[1], POINTS)
    rows = (
        colormap(colors, len(values))
        if isinstance(colors, str)
        else np.atleast_2d(np.asarray(numbers("colors", colors), np.float64))
    )
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
    if not 2 <= points <= MAX_POINTS:
        raise ValueError(f"`points` must be from 2 to {MAX_POINTS}, got {points}; a map has two ends")
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
        remedy = "give LogNorm, SymLogNorm or Normalize"
        raise ValueError(f"`norm` must have an inverse, and {type(norm).__name__} has none; {remedy}")
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
    if rows.ndim not in (1, 2) or not rows.size:
        raise ValueError(f"`extinction` must be a number, or some from the low end to the high, got shape {rows.shape}")
    place, at = np.linspace(0, len(rows) - 1, points), np.arange(len(rows))
    return colors_at(place, at, rows.reshape(len(rows), -1)).reshape(points, *rows.shape[1:])


def control_values(
    norm: str, quantity: Any, weights: Any, low: float | None, high: float | None, width: float | None, points: int
) -> Float[np.ndarray, " points"]:
    """See `TransferFunction.control_values`."""
    if norm not in DOMAINS:
        raise ValueError(f"`norm` must be one of {', '.join(DOMAINS)}, got {norm!r}")
    if not 2 <= points <= MAX_POINTS:
        raise ValueError(f"`points` must be an integer from 2 to {MAX_POINTS}, got {points!r}; a domain has two ends")
    if width is not None and norm != "symlog":
        raise ValueError(f"`width` is of the domain 'symlog', and `norm` is {norm!r}; leave it out")
    if quantity is None and weights is not None:
        raise ValueError("`weights` go with `quantity`, and there is none; give both")
    values = None if quantity is None else np.asarray(require_real("quantity", own("quantity", quantity)), np.float64).ravel()
    weight = None if weights is None else np.asarray(require_real("weights", own("weights", weights)), np.float64).ravel()
    if values is not None and weight is not None:
        if weight.shape != values.shape or not np.isfinite(weight).all() or (weight < 0).any():
            raise ValueError(f"`weights` must be {values.size} finite numbers >= 0, one for each value of the quantity")
        values, weight = values[weight > 0], weight[weight > 0]
    if values is not None:
        there = np.isfinite(values)
        values, weight = values[there], None if weight is None else weight[there]
    if norm in ("percentile", "equalised") and (values is None or not values.size):
        raise ValueError(f"the domain {norm!r} needs the values of a `quantity`; give them, or use 'linear' or 'log'")
    laid: np.ndarray = getattr(_Domain(np.linspace(0, 1, points), values, weight, low, high, width), norm)()
    return laid


class _Domain(NamedTuple):
    """What a domain is made of: places, finite values and their weights if there are any, ends and width as they were given."""

    place: np.ndarray
    values: Any
    weight: Any
    low: float | None
    high: float | None
    width: float | None

    def ends(self) -> tuple[float, float]:
        """Those given, else the range of the values."""
        if (self.low is None or self.high is None) and self.values is None:
            raise ValueError("`low` and `high` are needed where no `quantity` is given; give these or that")
        own = (0.0, 1.0) if self.values is None else value_range(self.values)
        ends = own[0] if self.low is None else float(self.low), own[1] if self.high is None else float(self.high)
        if not (np.isfinite(ends).all() and ends[0] < ends[1]):
            raise ValueError(f"`low` and `high` must be finite and ascend, got {ends[0]:g} and {ends[1]:g}")
        return ends

    def evenly(self, first: float, last: float, bend_back: Callable[[Any], Any]) -> np.ndarray:
        """Even where values are bent, from first to last; ends are as they were given, which rounding may have moved."""
        made: np.ndarray = bend_back(first + (last - first) * self.place)
        ends = made[[0, -1]]
        made[[0, -1]] = [end if given is None else given for end, given in zip(ends, (self.low, self.high), strict=True)]
        return made

    def linear(self) -> np.ndarray:
        low, high = self.ends()
        return low + (high - low) * self.place

    def log(self) -> np.ndarray:
        values = np.zeros(0) if self.values is None else self.values
        positive = values[values > 0]
        for name in ("low", "high"):
            end = getattr(self, name)
            if end is not None and not end > 0:
                least = f"; the smallest positive value is {positive.min():.4g}" if positive.size else ""
                remedy = "raise it, or use the domain 'symlog' or 'linear'"
                raise ValueError(f"`{name}` = {end:g} must be > 0 for the domain 'log'{least}; {remedy}")
        if self.values is not None and None in (self.low, self.high):
            if not positive.size:
                raise ValueError("the domain 'log' needs positive values, and the quantity has none; use 'symlog' or 'linear'")
            if values.size > positive.size and positive.min() == positive.max():
                count = f"{values.size - positive.size:,} of {values.size:,} are not positive"
                what = f"{positive.min():g} is the only positive value of the quantity, {count}"
                raise ValueError(f"the domain 'log' finds no range: {what}; use 'symlog' or 'linear'")
        low, high = (None if end is None else float(np.log(end)) for end in (self.low, self.high))
        bent = self._replace(values=None if self.values is None else np.log(positive), low=low, high=high)
        return self.evenly(*bent.ends(), np.exp)

    def symlog(self) -> np.ndarray:
        low, high = self.ends()
        width = LINEAR_SHARE * max(abs(low), abs(high)) if self.width is None else float(self.width)
        if not (np.isfinite(width) and width > 0):
            raise ValueError(f"`width` must be > 0 and finite, got {width:g}; values smaller than it are shown about linearly")
        first, last = (np.sign(end) * np.log1p(abs(end) / width) for end in (low, high))
        given = self._replace(low=low, high=high)
        return given.evenly(first, last, lambda bent: np.sign(bent) * np.expm1(np.abs(bent)) * width)

    def percentile(self) -> np.ndarray:
        low, high = TAILS[0] if self.low is None else self.low, TAILS[1] if self.high is None else self.high
        if not 0 <= low < high <= 100:
            told = f"percentages that ascend, got {low:g} and {high:g}"
            raise ValueError(f"`low` and `high` of the domain 'percentile' are {told}")
        first, last = _quantiles(self.values, self.weight, np.array([low, high]) / 100)
        if not last - first > UNRESOLVED * max(abs(first), abs(last)):
            return self._replace(low=None, high=None).linear()
        return np.asarray(first + (last - first) * self.place)

    def equalised(self) -> np.ndarray:
        inside = np.ones(self.values.shape, bool)
        if self.low is not None or self.high is not None:
            low, high = self.ends()
            inside = (self.values >= low) & (self.values <= high)
            if not inside.any():
                raise ValueError(f"no value lies from {low:g} to {high:g}, so nothing can be equalised; widen the range")
        distinct, of = np.unique(self.values[inside], return_inverse=True)
        weight = None if self.weight is None else np.bincount(of, self.weight[inside])
        made = _quantiles(distinct, weight, self.place)
        resolved = made[-1] - made[0] > UNRESOLVED * np.abs(made).max()
        return made if resolved else self._replace(low=None, high=None).linear()


def _quantiles(values: np.ndarray, weight: np.ndarray | None, share: np.ndarray) -> np.ndarray:
    """Values below which a share of the weight lies; half of a value's own weight counts as below it."""
    if weight is None:
        return np.asarray(np.quantile(values, share))
    order = np.argsort(values, kind="stable")
    values, weight = values[order], weight[order]
    below = np.cumsum(weight) - weight / 2
    return np.interp(below[0] + (below[-1] - below[0]) * share, below, values)


@dataclasses.dataclass(frozen=True, eq=False)
class Scale:
    """A monotone map from values to places, 0 at the first control value and 1 at the last.

    Attributes:
        name: "linear", "log", or "even": control values are at even places, and it is linear in between.
        values: ascending control values, at least two of them different.
    """

    name: str
    values: Float[np.ndarray, " points"]

    @classmethod
    def of(cls, values: Float[np.ndarray, " points"]) -> Scale:
        """The scale on which control values are evenly spaced; linear where there are few, or two are equal.

        All equal, or a single one, they are given an axis of width 1 around them (of values over 1, of their size).
        """
        values = np.asarray(values, np.float64)
        first, last = values[0], values[-1]
        if not last > first:
            half = max(abs(first), 1.0) / 2
            return cls("linear", np.array([first - half, first + half]))
        if len(values) < 3 or _is_even(values):
            return cls("linear", values)
        if first > 0 and last > WIDE * first and _is_even(np.log(values)):
            return cls("log", values)
        return cls("even" if len(values) >= FEW and (np.diff(values) > 0).all() else "linear", values)

    def place(self, value: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Places of values; outside of the control values below 0 and above 1, of "even" 0 and 1."""
        value, (first, last) = np.asarray(value, np.float64), self.values[[0, -1]]
        if self.name == "even":
            return np.interp(value, self.values, np.linspace(0, 1, len(self.values)))
        if self.name == "linear":
            return (value - first) / (last - first)
        positive = np.where(value > 0, value, 1)
        return np.where(value > 0, np.log(positive / first) / np.log(last / first), -np.inf)

    def value(self, place: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Values at places."""
        place, (first, last) = np.asarray(place, np.float64), self.values[[0, -1]]
        if self.name == "even":
            return np.interp(place, np.linspace(0, 1, len(self.values)), self.values)
        return first + (last - first) * place if self.name == "linear" else first * (last / first) ** place


def _is_even(values: np.ndarray) -> bool:
    off = np.abs(values - np.linspace(values[0], values[-1], len(values))).max()
    return bool(off <= EVEN * (values[-1] - values[0]))
