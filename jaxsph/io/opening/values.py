"""Values of options as people write them: places, ranges, sizes, clips, files with options of their own.

Flow: text -> [values] -> numbers, names, clips -> options.

A value that cannot be read raises `ValueError` with what must be there and what was given; the option is named by who asks.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from jaxsph.io.table import CodeUnit
from jaxsph.io.units import MEASURED, bare, checked_unit, respelled, stated_length
from jaxsph.model.clips import Box, Clip, Plane, Sphere
from jaxsph.model.image import COLORS, rgb
from jaxsph.model.transfer.maps import colormap as colors_of
from jaxsph.numerics.names import did_you_mean

VIEWS = ("iso", "x", "y", "z", "face-on", "edge-on")
AROUND = ("densest", "mass")
NONE, HEAD = "none", "head"
GIB = 2**30
BEHIND = re.compile(r"(?P<file>.+?)(?::(?P<options>\w+=.*))?", re.DOTALL)
Reader = Callable[[str], Any]


@dataclasses.dataclass(frozen=True, eq=False)
class Measured:
    """A value that holds lengths with units, until that of the file is known; `read` makes it of numbers."""

    text: str
    read: Reader


def measured(read: Reader) -> Reader:
    """A reader of what may hold lengths with units, as `1kpc,0,0`."""

    def made(text: str) -> Any:
        for length in MEASURED.finditer(text):
            length_unit(length[2])
        value = read(MEASURED.sub(r"\1", text))
        return Measured(text, read) if MEASURED.search(text) else value

    return made


def in_lengths_of(options: Any, unit: Callable[[], CodeUnit | None]) -> Any:
    """Convert lengths with units in options to numbers in the unit of a file, which is looked up only where there are any."""

    def number(name: str, value: Any) -> Any:
        return value.read(bare(value.text, name, unit())) if isinstance(value, Measured) else value

    changed: dict[str, Any] = {}
    for name, value in ((field.name, getattr(options, field.name)) for field in dataclasses.fields(options)):
        if isinstance(value, Measured):
            changed[name] = number(name, value)
        elif isinstance(value, tuple) and any(isinstance(one, Measured) for one in value):
            changed[name] = tuple(number(name, one) for one in value)
    return dataclasses.replace(options, **changed) if changed else options


def read_as(must_be: str, read: Reader, holds: Callable[[Any], bool] = lambda _: True, names: Sequence[str] = ()) -> Reader:
    """A reader that says what must be there where `read` cannot read it or does not hold; and which of `names` was meant."""

    def made(text: str) -> Any:
        with contextlib.suppress(ValueError):
            if holds(value := read(text)):
                return value
        raise ValueError(f"must be {must_be}, got {text!r}{did_you_mean(text, names)}")

    return made


def numbers(names: str, read: Reader = float) -> Reader:
    """Numbers between commas, so many as there are names between commas."""
    return read_as(names, lambda text: tuple(read(part) for part, _ in zip(text.split(","), names.split(","), strict=True)))


def listed(read: Reader) -> Reader:
    """Values between commas."""
    return lambda text: tuple(read(one) for one in text.split(",") if one)


def one_of(names: Sequence[str]) -> Reader:
    """A name of those that there are."""
    return read_as(f"one of {', '.join(names)}", str, lambda text: text in names, names)


def count(least: int) -> Reader:
    """A whole number of at least so much."""
    must_be = f"a whole number of at least {least}"
    return read_as(must_be, lambda text: int(text) if text.isdecimal() else -1, lambda n: n >= least)


def number_or_name(text: str) -> float | str:
    """A number, or the text of what is one by name."""
    try:
        return float(text)
    except ValueError:
        return text


def number_or_column(must_be: str, holds: Callable[[float], bool]) -> Reader:
    """A number of which something holds, or the name of a column."""
    return read_as(must_be, number_or_name, lambda value: isinstance(value, str) or holds(value))


def _finite(value: Any) -> bool:
    return isinstance(value, str) or all(map(math.isfinite, value))


number = read_as("a number", float)
positive = read_as("a number > 0", float, lambda value: 0 < value < math.inf)
span = read_as("two numbers A,B that ascend", numbers("A,B"), lambda value: value[0] < value[1])
whole = read_as("a whole number", int)
place = numbers("X,Y,Z")
pixel = numbers("whole numbers R,C", int)
view = read_as(f"one of {', '.join(VIEWS)}, or X,Y,Z", lambda text: text if text in VIEWS else place(text), _finite, VIEWS)
light = read_as("X,Y,Z or head", lambda text: text if text == HEAD else place(text), _finite, (HEAD,))
center = read_as("X,Y,Z, densest or mass", lambda text: text if text in AROUND else place(text), _finite, AROUND)
size = read_as(
    "pixels, at least 1 pixel each way, as 640x480",
    lambda text: tuple(map(int, text.lower().split("x"))) * (1 if "x" in text.lower() else 2),
    lambda value: len(value) == 2 and min(value) > 0,
)
box = read_as(
    "three lengths > 0 as LX,LY,LZ, or none",
    lambda text: None if text == NONE else numbers("LX,LY,LZ")(text),
    lambda value: value is None or (_finite(value) and min(value) > 0),
)
memory = read_as(
    "a positive number of GiB",
    lambda text: float(re.sub(r"\s*GiB$", "", text, flags=re.IGNORECASE)),
    lambda value: 0 < value < GIB,
)
optical_depth = read_as("a number of at most 1e6", float, lambda value: value <= 1e6)
devices = read_as("all or a number of devices", lambda text: text if text == "all" else int(text))
color = read_as(
    "a column, the name of a colour, #rrggbb, or R,G,B from 0 to 1, as in 1,0.5,0",
    lambda text: rgb(text) if "," in text or text.startswith("#") or text in COLORS else text,
)


def level(text: str) -> float | bool:
    """A number, or False for `none`."""
    return False if text == NONE else number(text)


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


def unit(text: str) -> str:
    """Names of units with powers, as `Msun/kpc**3`."""
    return _known(text, lambda unit: checked_unit(respelled(unit)[1]), "unit")


def length_unit(text: str) -> str:
    """The same of lengths, as `kpc`."""
    return _known(text, stated_length, "unit")


def background(text: str) -> str:
    """`transparent`, or a colour."""
    return text if text == "transparent" else _known(text, rgb, "color")


SHAPES: dict[str, tuple[str, Callable[[tuple[float, ...]], Clip]]] = {
    "box": ("X0,Y0,Z0,X1,Y1,Z1", lambda given: Box(given[:3], given[3:])),
    "sphere": ("X,Y,Z,R", lambda given: Sphere(given[:3], given[3])),
    "plane": ("X,Y,Z,NX,NY,NZ", lambda given: Plane(given[:3], given[3:])),
}  # of each: its numbers, and the clip that they make


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
        meant = did_you_mean(kind, SHAPES)
        raise ValueError(f"must be {kinds}, with ~ before it for what is outside, or none; got {text!r}{meant}")
    made = _shape(kind, given, text)
    return ~made if text.startswith("~") else made


def clips(given: Sequence[Clip | None]) -> tuple[Clip, ...]:
    """All that are given; `none`, which stands alone, shows everything."""
    shapes = tuple(one for one in given if one is not None)
    if len(shapes) < len(given) > 1:
        raise ValueError("none stands alone: it shows everything")
    return shapes


def plane(text: str) -> Clip:
    """A place on it, and where it points to."""
    return _shape("plane", text, text)


class Part(tuple[int, int]):
    """Which part, from 0 on, and of how many; written as it was asked for."""

    text = ""

    def __str__(self) -> str:
        return self.text


def _tile(text: str) -> Part:
    """Arrays of jobs count from 0 or from 1, and either way all parts are there."""
    index, of = (int(part) for part in text.split("/"))
    if not (of > 0 and 0 <= index <= of):
        raise ValueError
    part = Part((index % of, of))
    part.text = f"{index}/{of}"
    return part


tile = read_as("I/N, as 1/4 for the second of four: I must lie in [0, N], and N be at least 1", _tile)


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
    match = BEHIND.fullmatch(text)
    if match is None or match["options"] is None or Path(text).exists():
        return text, {}
    parts = re.split(r",(?=\w+=)", match["options"])
    return match["file"], dict(part.split("=", 1) for part in parts)  # type: ignore[misc]
