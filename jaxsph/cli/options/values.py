"""Values of options as people write them: places, ranges, sizes, clips, files with options of their own.

Flow: text -> [values] -> numbers, names, clips -> groups of options.

A value that cannot be read raises `ValueError` with what must be there and what was given; the option is named by who asks.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from jaxsph.model.clips.clips import Clip
from jaxsph.model.clips.shapes import Box, Plane, Sphere
from jaxsph.numerics.names import did_you_mean

NONE = "none"
GIB = 2**30
BEHIND = re.compile(r"(?P<file>.+?)(?::(?P<options>\w+=.*))?", re.DOTALL)


def number(text: str) -> float:
    """A number."""
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"must be a number, got {text!r}") from None


def number_or_name(text: str) -> float | str:
    """A number, or the text of what is one by name."""
    try:
        return float(text)
    except ValueError:
        return text


def level(text: str) -> float | bool:
    """A number, or False for `none`."""
    return False if text == "none" else number(text)


def whole(text: str) -> int:
    """A whole number."""
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"must be a whole number, got {text!r}") from None


def count(least: int) -> Callable[[str], int]:
    """A whole number of at least so much."""

    def read(text: str) -> int:
        if not text.isdecimal() or int(text) < least:
            raise ValueError(f"must be a whole number of at least {least}, got {text!r}")
        return int(text)

    return read


def numbers(names: str) -> Callable[[str], tuple[float, ...]]:
    """Numbers between commas, so many as there are names between commas."""
    length = len(names.split(","))

    def read(text: str) -> tuple[float, ...]:
        try:
            found = tuple(float(part) for part in text.split(","))
        except ValueError:
            found = ()
        if len(found) != length:
            raise ValueError(f"must be {names}, got {text!r}")
        return found

    return read


place = numbers("X,Y,Z")


def pixel(text: str) -> tuple[int, ...]:
    """Row and column of a pixel."""
    found = numbers("R,C")(text)
    if any(number != int(number) for number in found):
        raise ValueError(f"must be whole numbers R,C, got {text!r}")
    return tuple(int(number) for number in found)


def center(text: str) -> tuple[float, ...] | str:
    """What is in the middle."""
    if text in ("densest", "mass"):
        return text
    try:
        found = place(text)
    except ValueError:
        found = ()
    if not found or not all(map(math.isfinite, found)):
        raise ValueError(f"must be X,Y,Z, densest or mass, got {text!r}{did_you_mean(text, ('densest', 'mass'))}")
    return found


def one_of(names: Sequence[str]) -> Callable[[str], str]:
    """A name of those that there are."""

    def read(text: str) -> str:
        if text not in names:
            raise ValueError(f"must be one of {', '.join(names)}, got {text!r}{did_you_mean(text, names)}")
        return text

    return read


def colormap(text: str) -> str:
    """The name of a colour map that there is."""
    from jaxsph.model.transfer.maps import colormap as colors_of

    try:
        colors_of(text)
    except ValueError as error:
        raise ValueError(str(error).removeprefix("`colormap` ")) from None
    return text


def size(text: str) -> tuple[int, int]:
    """Width and height of `640x480`; of one number, a square."""
    parts = text.lower().split("x")
    try:
        width, height = (int(part) for part in (parts if len(parts) == 2 else parts * 2))
    except ValueError:
        raise ValueError(f"{text!r} is not a size; write it as 640x480") from None
    if len(parts) > 2 or width < 1 or height < 1:
        raise ValueError(f"{text!r} is not a size; both edges must be at least 1 pixel, as in 640x480")
    return width, height


def box(text: str) -> tuple[float, ...] | None:
    """Sides of a periodic box; None of `none`."""
    if text == NONE:
        return None
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != 3 or not all(math.isfinite(side) and side > 0 for side in found):
        raise ValueError(f"must be three lengths > 0 as LX,LY,LZ, or none; got {text!r}")
    return found


@dataclasses.dataclass(frozen=True)
class Named:
    """A clip, and how it was written.

    Attributes:
        text: as it was written.
        clip: what is shown; None where everything is.
    """

    text: str
    clip: Clip | None


Numbers = tuple[float, ...]
SHAPES: dict[str, tuple[str, Callable[[Numbers], Clip]]] = {
    "box": ("X0,Y0,Z0,X1,Y1,Z1", lambda given: Box(given[:3], given[3:])),
    "sphere": ("X,Y,Z,R", lambda given: Sphere(given[:3], given[3])),
    "plane": ("X,Y,Z,NX,NY,NZ", lambda given: Plane(given[:3], given[3:])),
}
"""Of each: its numbers, and the clip that they make."""


def clip(text: str) -> Named:
    """`box:X0,Y0,Z0,X1,Y1,Z1`, `sphere:X,Y,Z,R` or `plane:X,Y,Z,NX,NY,NZ`; what is outside of it after `~`; or `none`."""
    if text == NONE:
        return Named(text, None)
    kind, _, given = text.removeprefix("~").partition(":")
    if kind not in SHAPES:
        kinds = ", ".join(f"{name}:{names}" for name, (names, _) in SHAPES.items())
        raise ValueError(
            f"must be {kinds}, with ~ before it for what is outside, or none; got {text!r}{did_you_mean(kind, SHAPES)}"
        )
    names, make = SHAPES[kind]
    try:
        made = make(numbers(names)(given))
    except ValueError as error:
        raise ValueError(f"{text}: {str(error).replace('`', '')}") from None
    return Named(text, ~made if text.startswith("~") else made)


def plane(text: str) -> Plane:
    """A place on it, and where it points to."""
    given = numbers("X,Y,Z,NX,NY,NZ")(text)
    try:
        return Plane(given[:3], given[3:])
    except ValueError as error:
        raise ValueError(f"{text}: {str(error).replace('`', '')}") from None


def memory(text: str) -> float:
    """GiB, with or without the unit."""
    found = re.fullmatch(r"(.*?)\s*(?:GiB)?", text, re.IGNORECASE)
    value = number(found[1] if found else text)
    if not 0 < value < GIB:
        raise ValueError(f"must be a positive number of GiB, got {text}")
    return value


def devices(text: str) -> str | int:
    """`all`, or how many."""
    if text != "all" and not text.removeprefix("-").isdecimal():
        raise ValueError(f"{text!r} is neither `all` nor a number of devices")
    return text if text == "all" else int(text)


class Part(tuple[int, int]):
    """Which part, from 0 on, and of how many; written as it was asked for."""

    text = ""

    def __str__(self) -> str:
        return self.text


def tile(text: str) -> Part:
    """Which part of how many; arrays of jobs count from 0 or from 1, and either way all parts are there."""
    try:
        index, of = (int(part) for part in text.split("/"))
    except ValueError:
        raise ValueError(f"{text!r} is not a part; write the second of four as 1/4") from None
    if of < 1 or not 0 <= index <= of:
        raise ValueError(f"{text!r} is not a part; I must lie in [0, N], and N be at least 1")
    part = Part((index % of, of))
    part.text = f"{index}/{of}"
    return part


def background(text: str) -> str:
    """`transparent`, or a colour."""
    from jaxsph.model.image import rgb

    if text != "transparent":
        try:
            rgb(text)
        except ValueError as error:
            raise ValueError(str(error).removeprefix("`color` ")) from None
    return text


@dataclasses.dataclass(frozen=True)
class Beside:
    """A file that shares a picture, and options of its own."""

    file: str
    options: dict[str, str]


def with_options(names: Sequence[str]) -> Callable[[str], Beside]:
    """`FILE:name=value,...`, of these names; commas in values are fine."""

    def read(text: str) -> Beside:
        file, options = file_and_options(text)
        for name in options:
            if name not in names:
                raise ValueError(f"{text}: there is no option {name!r}; there are {', '.join(names)}{did_you_mean(name, names)}")
        return Beside(file, options)

    return read


def file_and_options(text: str) -> tuple[str, dict[str, str]]:
    """The file of `FILE:name=value,...`, and the values by their names."""
    found = BEHIND.fullmatch(text)
    if found is None or found["options"] is None or Path(text).exists():
        return text, {}
    parts = re.split(r",(?=\w+=)", found["options"])
    return found["file"], dict(part.split("=", 1) for part in parts)  # type: ignore[misc]
