"""Numbers and words of a view's inputs as they come from a page, checked.

Flow: message (a JSON object) -> [inputs] -> cut, state, session.

A message is `{"do": NAME, ...numbers}`. Lengths on the screen are shares of the picture's height, places are shares of it from
its middle, right and down.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

MAX_SHARE, FARTHEST = 100.0, 1e30
MIN_SIDE, MAX_SIDE, MAX_PIXELS = 16, 16384, 3840 * 2160
"""Of a picture that is as large as a page has room for."""
LIMITS = {"place": (-1, 2), "extinction": (0, 1e30), "red": (0, 1), "green": (0, 1), "blue": (0, 1)}
"""Numbers of a control point, and their ends."""


class InputError(ValueError):
    """A message that cannot be understood; it says what could be."""


def number(message: dict[str, Any], name: str, low: float, high: float, default: float | None = None) -> float:
    """A number of a message, within limits."""
    value = message.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or not low <= value <= high:
        raise InputError(f"`{name}` of {message.get('do')!r} must be a number from {low:g} to {high:g}, got {_short(value)}")
    return float(value)


def vector(message: dict[str, Any], name: str) -> np.ndarray:
    """Three numbers of a message."""
    given = message.get(name)
    if not isinstance(given, list) or len(given) != 3:
        raise InputError(f"`{name}` of {message.get('do')!r} must be three numbers, got {_short(given)}")
    return np.array([number(message | {name: one}, name, -FARTHEST, FARTHEST) for one in given])


def word(message: dict[str, Any], name: str, known: tuple[str, ...]) -> str:
    """One of the words that are known."""
    value = message.get(name)
    if value not in known:
        raise InputError(f"`{name}` of {message.get('do')!r} must be one of {', '.join(known)}, got {_short(value)}")
    return str(value)


def shares_of(message: dict[str, Any], default: float | None = None) -> tuple[float, float]:
    """How far to the right, and down."""
    right, down = (number(message, name, -MAX_SHARE, MAX_SHARE, default) for name in ("right", "down"))
    return right, down


def size_of(message: dict[str, Any]) -> tuple[int, int]:
    """Width and height of a picture that a page has room for, pixels; smaller where these are more than `MAX_PIXELS`."""
    sides = [number(message, name, 1, MAX_SIDE) for name in ("width", "height")]
    share = min(1.0, math.sqrt(MAX_PIXELS / math.prod(sides)))
    width, height = (max(MIN_SIDE, int(share * side)) for side in sides)
    return width, height


def points_of(message: dict[str, Any]) -> np.ndarray:
    """(N, 5) control points of a message."""
    rows = message.get("points")
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) >= len(LIMITS) for row in rows):
        raise InputError("`points` must be rows of place, extinction, red, green and blue")
    named = [{"do": "points", **dict(zip(LIMITS, row, strict=False))} for row in rows]
    return np.array([[number(row, name, *ends) for name, ends in LIMITS.items()] for row in named]).reshape(-1, len(LIMITS))


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
