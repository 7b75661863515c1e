"""Scales: how an axis of a quantity is to be drawn, so that the control points of a transfer function are spread over it.

Flow: control values -> [scales] -> bins of `met`, axes of figures, colour bars.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

EVEN = 1e-5
"""Of what they span, that evenly spaced control values may be off: float32 rounds them."""

FEW = 8
"""Control points fewer than this were laid by hand, and not by a domain: their axis is linear."""

WIDE = 2.0
"""Largest over least of control values from which an even spacing of logarithms is meant as such."""


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
