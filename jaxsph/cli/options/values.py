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
from typing import Any

from jaxsph.io.opening.options import AROUND
from jaxsph.model.clips import Box, Clip, Plane, Sphere
from jaxsph.model.image import COLORS, rgb
from jaxsph.model.transfer.maps import colormap as colors_of
from jaxsph.numerics.names import did_you_mean

NONE = "none"
GIB = 2**30
BEHIND = re.compile(r"(?P<file>.+?)(?::(?P<options>\w+=.*))?", re.DOTALL)
Reader = Callable[[str], Any]


def read_as(must_be: str, names: Sequence[str] = ()) -> Callable[[Reader], Reader]:
    """Has a reader say, where it raises `ValueError`, what must be there; and which of `names` was meant."""

    def made(read: Reader) -> Reader:
        def told(text: str) -> Any:
            try:
                return read(text)
            except ValueError:
                raise ValueError(f"must be {must_be}, got {text!r}{did_you_mean(text, names)}") from None

        return told

    return made


def require(holds: bool) -> None:
    """Raise `ValueError` of what does not hold; `read_as` says what must."""
    if not holds:
        raise ValueError


def numbers(names: str, read: Reader = float) -> Reader:
    """Numbers between commas, so many as there are names between commas."""
    return read_as(names)(lambda text: tuple(read(part) for part, _ in zip(text.split(","), names.split(","), strict=True)))


def listed(read: Reader) -> Reader:
    """Values between commas."""
    return lambda text: tuple(read(one) for one in text.split(",") if one)


def one_of(names: Sequence[str]) -> Reader:
    """A name of those that there are."""
    return read_as(f"one of {', '.join(names)}", names)(lambda text: names[names.index(text)])


def count(least: int) -> Reader:
    """A whole number of at least so much."""

    @read_as(f"a whole number of at least {least}")
    def read(text: str) -> int:
        require(text.isdecimal() and int(text) >= least)
        return int(text)

    return read


number = read_as("a number")(float)
whole = read_as("a whole number")(int)
place = numbers("X,Y,Z")
pixel = numbers("whole numbers R,C", int)


def number_or_name(text: str) -> float | str:
    """A number, or the text of what is one by name."""
    try:
        return float(text)
    except ValueError:
        return text


def level(text: str) -> float | bool:
    """A number, or False for `none`."""
    return False if text == NONE else number(text)


@read_as("X,Y,Z, densest or mass", AROUND)
def center(text: str) -> Any:
    """What is in the middle."""
    found = text if text in AROUND else place(text)
    require(found == text or all(map(math.isfinite, found)))
    return found


@read_as("pixels, at least 1 pixel each way, as 640x480")
def size(text: str) -> tuple[int, ...]:
    """Width and height; of one number, a square."""
    parts = text.lower().split("x")
    found = tuple(int(part) for part in (parts * 2)[:2])
    require(len(parts) < 3 and min(found) > 0)
    return found


@read_as("three lengths > 0 as LX,LY,LZ, or none")
def box(text: str) -> tuple[float, ...] | None:
    """Sides of a periodic box; None of `none`."""
    found = None if text == NONE else numbers("LX,LY,LZ")(text)
    require(found is None or all(math.isfinite(side) and side > 0 for side in found))
    return found


@read_as("a positive number of GiB")
def memory(text: str) -> float:
    """GiB, with or without the unit."""
    value = float(re.sub(r"\s*GiB$", "", text, flags=re.IGNORECASE))
    require(0 < value < GIB)
    return value


@read_as("a number of at most 1e6")
def optical_depth(text: str) -> float:
    """What numbers can hold."""
    require(float(text) <= 1e6)
    return float(text)


@read_as("all or a number of devices")
def devices(text: str) -> str | int:
    """All, or how many."""
    return text if text == "all" else int(text)


def _known(text: str, check: Reader, argument: str) -> str:
    """A name that `check` knows, which says of others what its argument must be."""
    try:
        check(text)
    except ValueError as error:
        raise ValueError(str(error).removeprefix(f"`{argument}` ")) from None
    return text


def colormap(text: str) -> str:
    """The name of a colour map that there is."""
    return _known(text, colors_of, "colormap")


def background(text: str) -> str:
    """`transparent`, or a colour."""
    return text if text == "transparent" else _known(text, rgb, "color")


SHAPES: dict[str, tuple[str, Callable[[tuple[float, ...]], Clip]]] = {
    "box": ("X0,Y0,Z0,X1,Y1,Z1", lambda given: Box(given[:3], given[3:])),
    "sphere": ("X,Y,Z,R", lambda given: Sphere(given[:3], given[3])),
    "plane": ("X,Y,Z,NX,NY,NZ", lambda given: Plane(given[:3], given[3:])),
}
"""Of each: its numbers, and the clip that they make."""


def _shape(kind: str, given: str, text: str) -> Clip:
    names, make = SHAPES[kind]
    try:
        return make(numbers(names)(given))
    except ValueError as error:
        raise ValueError(f"{text}: {str(error).replace('`', '')}") from None


def clip(text: str) -> Clip | None:
    """`box:X0,Y0,Z0,X1,Y1,Z1`, `sphere:X,Y,Z,R` or `plane:X,Y,Z,NX,NY,NZ`; what is outside of it after `~`; or `none`."""
    if text == NONE:
        return None
    kind, _, given = text.removeprefix("~").partition(":")
    if kind not in SHAPES:
        kinds = ", ".join(f"{name}:{names}" for name, (names, _) in SHAPES.items())
        raise ValueError(
            f"must be {kinds}, with ~ before it for what is outside, or none; got {text!r}{did_you_mean(kind, SHAPES)}"
        )
    made = _shape(kind, given, text)
    return ~made if text.startswith("~") else made


def clips(given: Sequence[Clip | None]) -> tuple[Clip, ...]:
    """All that are given; `none`, which stands alone, shows everything."""
    found = tuple(one for one in given if one is not None)
    if len(found) < len(given) > 1:
        raise ValueError("none stands alone: it shows everything")
    return found


def plane(text: str) -> Clip:
    """A place on it, and where it points to."""
    return _shape("plane", text, text)


class Part(tuple[int, int]):
    """Which part, from 0 on, and of how many; written as it was asked for."""

    text = ""

    def __str__(self) -> str:
        return self.text


@read_as("I/N, as 1/4 for the second of four: I must lie in [0, N], and N be at least 1")
def tile(text: str) -> Part:
    """Which part of how many; arrays of jobs count from 0 or from 1, and either way all parts are there."""
    index, of = (int(part) for part in text.split("/"))
    require(of > 0 and 0 <= index <= of)
    part = Part((index % of, of))
    part.text = f"{index}/{of}"
    return part


def number_or_column(must_be: str, holds: Callable[[float], bool]) -> Reader:
    """A number of which something holds, or the name of a column."""

    @read_as(must_be)
    def read(text: str) -> float | str:
        found = number_or_name(text)
        require(isinstance(found, str) or holds(found))
        return found

    return read


@read_as("a column, the name of a colour, #rrggbb, or R,G,B from 0 to 1, as in 1,0.5,0")
def color(text: str) -> tuple[float, ...] | str:
    """Three numbers where there are commas, a colour where it has a name, else the name of a column."""
    return rgb(text) if "," in text or text.startswith("#") or text in COLORS else text


@dataclasses.dataclass(frozen=True)
class Beside:
    """A file that shares a picture, and options of its own."""

    file: str
    options: dict[str, Any]


def with_options(readers: dict[str, Reader]) -> Callable[[str], Beside]:
    """`FILE:name=value,...`, of these names; commas in values are fine."""

    def read(text: str) -> Beside:
        file, options = file_and_options(text)
        for name in options:
            if name not in readers:
                known = f"there are {', '.join(readers)}{did_you_mean(name, tuple(readers))}"
                raise ValueError(f"{text}: there is no option {name!r}; {known}")
        try:
            return Beside(file, {name: readers[name](value) for name, value in options.items()})
        except ValueError as error:
            raise ValueError(f"{text}: {error}") from None

    return read


def file_and_options(text: str) -> tuple[str, dict[str, str]]:
    """The file of `FILE:name=value,...`, and the values by their names."""
    found = BEHIND.fullmatch(text)
    if found is None or found["options"] is None or Path(text).exists():
        return text, {}
    parts = re.split(r",(?=\w+=)", found["options"])
    return found["file"], dict(part.split("=", 1) for part in parts)  # type: ignore[misc]
