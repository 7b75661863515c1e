r"""Domains: where on the axis of a quantity the colours of a map sit; and scales, on which an axis of control values is drawn.

Flow: quantity, name of a domain -> [domains] -> control values -> TransferFunction; control values -> [Scale] -> bins, axes.

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

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsph.model.transfer.function import POINTS
from jaxsph.model.transfer.maps import TAILS, value_range
from jaxsph.numerics.given import own

LINEAR_SHARE = 1e-3  # width around zero in which `symlog` is about linear, over the largest value, unless it is given
EVEN = 1e-5  # of what they span, that evenly spaced control values may be off: float32 rounds them
FEW = 8  # control points fewer than this were laid by hand, and not by a domain: their axis is linear
WIDE = 2.0  # largest over least of control values from which an even spacing of logarithms is meant as such
UNRESOLVED = 1e-6  # of the largest value: ends that are nearer to each other float32 would not tell apart


def control_values(
    norm: str,
    quantity: Any = None,
    *,
    low: float | None = None,
    high: float | None = None,
    weights: Any = None,
    width: float | None = None,
    points: int = POINTS,
) -> Float[np.ndarray, " points"]:
    """See `TransferFunction.control_values`."""
    if norm not in DOMAINS:
        raise ValueError(f"`norm` must be one of {', '.join(DOMAINS)}, got {norm!r}")
    if isinstance(points, bool) or not isinstance(points, int | np.integer) or points < 2:
        raise ValueError(f"`points` must be an integer of at least 2, got {points!r}; a domain has two ends")
    if width is not None and norm != "symlog":
        raise ValueError(f"`width` is of the domain 'symlog', and `norm` is {norm!r}; leave it out")
    values, weight = _known(quantity, weights)
    place = np.linspace(0, 1, points)
    return DOMAINS[norm](_Asked(place, values, weight, low, high, width))


class _Asked(NamedTuple):
    """What a domain is made of: places, finite values and their weights, ends and width as they were given."""

    place: np.ndarray
    values: np.ndarray | None
    weight: np.ndarray | None
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

    def known(self, domain: str) -> np.ndarray:
        """The values, where a domain cannot do without."""
        if self.values is None or not self.values.size:
            raise ValueError(f"the domain {domain!r} needs the values of a `quantity`; give them, or use 'linear' or 'log'")
        return self.values


def _known(quantity: Any, weights: Any) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Finite values and weights, flat; `None` where there are none."""
    if quantity is None:
        if weights is not None:
            raise ValueError("`weights` go with `quantity`, and there is none; give both")
        return None, None
    values = np.asarray(own("quantity", quantity), np.float64).ravel()
    if weights is None:
        return values[np.isfinite(values)], None
    weight = np.asarray(own("weights", weights), np.float64).ravel()
    if weight.shape != values.shape or not np.isfinite(weight).all() or (weight < 0).any():
        raise ValueError(f"`weights` must be {values.size} finite numbers >= 0, one for each value of the quantity")
    there = np.isfinite(values) & (weight > 0)
    return values[there], weight[there]


def _linear(asked: _Asked) -> np.ndarray:
    low, high = asked.ends()
    return low + (high - low) * asked.place


def _log(asked: _Asked) -> np.ndarray:
    positive = np.zeros(0) if asked.values is None else asked.values[asked.values > 0]
    for name in ("low", "high"):
        end = getattr(asked, name)
        if end is not None and not end > 0:
            least = f"; the smallest positive value is {positive.min():.4g}" if positive.size else ""
            remedy = "raise it, or use the domain 'symlog' or 'linear'"
            raise ValueError(f"`{name}` = {end:g} must be > 0 for the domain 'log'{least}; {remedy}")
    if asked.values is not None and not positive.size and None in (asked.low, asked.high):
        raise ValueError("the domain 'log' needs positive values, and the quantity has none; use 'symlog' or 'linear'")
    others = 0 if asked.values is None else asked.values.size - positive.size
    if others and None in (asked.low, asked.high) and positive.min() == positive.max():
        count = f"{others:,} of {others + positive.size:,} are not positive"
        what = f"{positive.min():g} is the only positive value of the quantity, {count}"
        raise ValueError(f"the domain 'log' finds no range: {what}; use 'symlog' or 'linear'")
    low, high = (None if end is None else float(np.log(end)) for end in (asked.low, asked.high))
    values = None if asked.values is None else np.log(positive)
    first, last = asked._replace(values=values, low=low, high=high).ends()
    made = np.exp(first + (last - first) * asked.place)
    return _with_ends(made, asked.low, asked.high)


def _symlog(asked: _Asked) -> np.ndarray:
    ends = np.array(asked.ends())
    width = LINEAR_SHARE * np.abs(ends).max() if asked.width is None else float(asked.width)
    if not (np.isfinite(width) and width > 0):
        raise ValueError(f"`width` must be > 0 and finite, got {width:g}; values smaller than it are shown about linearly")
    first, last = np.sign(ends) * np.log1p(np.abs(ends) / width)
    bent = first + (last - first) * asked.place
    return _with_ends(np.sign(bent) * np.expm1(np.abs(bent)) * width, *ends)


def _percentile(asked: _Asked) -> np.ndarray:
    low, high = TAILS[0] if asked.low is None else asked.low, TAILS[1] if asked.high is None else asked.high
    if not 0 <= low < high <= 100:
        raise ValueError(f"`low` and `high` of the domain 'percentile' are percentages that ascend, got {low:g} and {high:g}")
    first, last = _quantiles(asked.known("percentile"), asked.weight, np.array([low, high]) / 100)
    if not last - first > UNRESOLVED * max(abs(first), abs(last)):
        return _linear(asked._replace(low=None, high=None))
    return first + (last - first) * asked.place


def _equalised(asked: _Asked) -> np.ndarray:
    values = asked.known("equalised")
    inside = np.ones(values.shape, bool)
    if asked.low is not None or asked.high is not None:
        low, high = asked.ends()
        inside = (values >= low) & (values <= high)
        if not inside.any():
            raise ValueError(f"no value lies from {low:g} to {high:g}, so nothing can be equalised; widen the range")
    distinct, of = np.unique(values[inside], return_inverse=True)
    weight = None if asked.weight is None else np.bincount(of, asked.weight[inside])
    made = _quantiles(distinct, weight, asked.place)
    resolved = made[-1] - made[0] > UNRESOLVED * np.abs(made).max()
    return made if resolved else _linear(asked._replace(low=None, high=None))


def _with_ends(made: np.ndarray, low: float | None, high: float | None) -> np.ndarray:
    """With the ends as they were given, which rounding may have moved."""
    made[0], made[-1] = made[0] if low is None else low, made[-1] if high is None else high
    return made


def _quantiles(values: np.ndarray, weight: np.ndarray | None, share: np.ndarray) -> np.ndarray:
    """Values below which a share of the weight lies; half of a value's own weight counts as below it."""
    if weight is None:
        return np.asarray(np.quantile(values, share))
    order = np.argsort(values, kind="stable")
    values, weight = values[order], weight[order]
    below = np.cumsum(weight) - weight / 2
    return np.interp(below[0] + (below[-1] - below[0]) * share, below, values)


DOMAINS: dict[str, Callable[[_Asked], np.ndarray]] = {
    "linear": _linear,
    "log": _log,
    "symlog": _symlog,
    "percentile": _percentile,
    "equalised": _equalised,
}
"""The domains by name."""


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
