"""Inputs of a view as they come from a page: checked, and done to the pose or to the look.

Flow: message (a JSON object) -> [inputs] -> Pose, Steps of control points.

A message is `{"do": NAME, ...numbers}`. Lengths on the screen are shares of the picture's height, places are shares of it from
its middle, right and down.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from jaxsph.viewer.control_points import ControlPoints, Point, Steps
from jaxsph.viewer.pose import Pose

MAX_SHARE, MAX_FACTOR, MAX_DEGREES = 100.0, 100.0, 3600.0
MIN_SIDE, MAX_SIDE, MAX_PIXELS = 16, 16384, 3840 * 2160
"""Of a picture that is as large as a page has room for."""
AXES = ("x", "-x", "y", "-y", "z", "-z", "iso")
ROW = 5  # numbers of a control point: place, extinction, red, green, blue


class InputError(ValueError):
    """A message that cannot be understood; it says what could be."""


def number(message: dict[str, Any], name: str, low: float, high: float, default: float | None = None) -> float:
    """A number of a message, within limits."""
    value = message.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or not low <= value <= high:
        raise InputError(f"`{name}` of {message.get('do')!r} must be a number from {low:g} to {high:g}, got {_short(value)}")
    return float(value)


def word(message: dict[str, Any], name: str, known: tuple[str, ...]) -> str:
    """One of the words that are known."""
    value = message.get(name)
    if value not in known:
        raise InputError(f"`{name}` of {message.get('do')!r} must be one of {', '.join(known)}, got {_short(value)}")
    return str(value)


def size_of(message: dict[str, Any]) -> tuple[int, int]:
    """Width and height of a picture that a page has room for, pixels; smaller where these are more than `MAX_PIXELS`."""
    sides = [number(message, name, 1, MAX_SIDE) for name in ("width", "height")]
    share = min(1.0, math.sqrt(MAX_PIXELS / math.prod(sides)))
    width, height = (max(MIN_SIDE, int(share * side)) for side in sides)
    return width, height


def points_of(message: dict[str, Any]) -> list[Point]:
    """Control points of a message: rows of place, extinction, red, green and blue."""
    rows = message.get("points")
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) >= ROW for row in rows):
        raise InputError("`points` must be rows of place, extinction, red, green and blue")
    limits = {"place": (-1, 2), "extinction": (0, 1e30), "red": (0, 1), "green": (0, 1), "blue": (0, 1)}
    made = []
    for row in rows:
        named = {"do": "points", **dict(zip(limits, row, strict=False))}
        place, opaque, red, green, blue = (number(named, name, *ends) for name, ends in limits.items())
        made.append(Point(place, opaque, (red, green, blue)))
    return made


def _share(message: dict[str, Any], name: str, default: float | None = None) -> float:
    return number(message, name, -MAX_SHARE, MAX_SHARE, default)


MOTIONS: dict[str, Callable[[Pose, dict[str, Any]], Pose]] = {
    "orbit": lambda pose, said: pose.orbited(_share(said, "right"), _share(said, "down")),
    "pan": lambda pose, said: pose.panned(_share(said, "right"), _share(said, "down")),
    "zoom": lambda pose, said: pose.zoomed(
        number(said, "factor", 1 / MAX_FACTOR, MAX_FACTOR), _share(said, "right", 0), _share(said, "down", 0)
    ),
    "roll": lambda pose, said: pose.rolled(number(said, "degrees", -MAX_DEGREES, MAX_DEGREES)),
    "axis": lambda pose, said: pose.along(word(said, "name", AXES)),
    "projection": lambda pose, said: pose.projected(word(said, "name", ("perspective", "parallel")) == "perspective"),
}
"""What moves the camera, and needs nothing but the pose."""


def _colormap(look: ControlPoints, said: dict[str, Any]) -> ControlPoints:
    name = said.get("name")
    if not isinstance(name, str) or len(name) > 100:
        raise InputError("`name` of 'colormap' must be the name of a colour map, such as viridis")
    return look.recoloured(name)


EDITS: dict[str, Callable[[ControlPoints, dict[str, Any]], ControlPoints]] = {
    "points": lambda look, said: look.edited(points_of(said)),
    "colormap": _colormap,
    "exposure": lambda look, said: look.exposed(number(said, "stops", -10, 10)),
    "reset_look": lambda look, said: look.as_given(),
}
"""What changes the look."""


def edit(steps: Steps, said: dict[str, Any]) -> None:
    """Do an edit, or a step back or forward."""
    name = said["do"]
    if name == "undo":
        steps.undo()
    elif name == "redo":
        steps.redo()
    else:
        steps.show(EDITS[name](steps.look, said), done=said.get("done", True) is not False)


KNOWN_EDITS = (*EDITS, "undo", "redo")


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
