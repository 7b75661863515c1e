"""Volumes and points on the command line, and what a picture of several parts needs: a warning where they lie apart.

Flow: files, options -> [parts] -> Volume, Points -> Scene -> commands.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxsph import io, scenes
from jaxsph.cli.console import UsageError, attributes, ranges, say_notes, span
from jaxsph.cli.options.values import Beside, number_or_name
from jaxsph.cli.voice import report, result, say, tell
from jaxsph.model import Points, TransferFunction, Volume
from jaxsph.model.camera.camera import Bounded
from jaxsph.model.image import COLORS, rgb

CHECKED: dict[str, tuple[str, Callable[[float], bool]]] = {
    "radius": ("> 0", lambda value: bool(np.isfinite(value) and value > 0)),
    "opacity": ("in [0, 1)", lambda value: 0 <= value < 1),
}
"""Options of points that are numbers, or names of columns."""


def check(options: Any) -> None:
    """Raise `UsageError` where an option of a file beside the source is out of range."""
    for beside in options.points:
        for name, (must_be, holds) in CHECKED.items():
            value = number_or_name(beside.options.get(name, ""))
            if isinstance(value, float) and not holds(value):
                raise UsageError(f"--points {beside.file}: {name} must be {must_be}, got {value:g}")
        _color(beside)
        _type(beside)


def warn_apart(parts: Sequence[tuple[str, Bounded]], command: str) -> None:
    """A line on stderr for each two parts that lie far apart."""
    for sentence in apart(parts):
        tell(command, f"warning: {sentence}")


def apart(parts: Sequence[tuple[str, Bounded]]) -> list[str]:
    """A sentence for each two named parts whose boxes are farther apart than either is large: their units may differ."""
    boxes = [(name, *part.bounds()) for name, part in parts]
    said = []
    for one, other in itertools.combinations([box for box in boxes if (box[2] > box[1]).any()], 2):
        gap = float(np.linalg.norm(np.maximum(np.maximum(one[1] - other[2], other[1] - one[2]), 0)))
        if gap > max(float(np.linalg.norm(upper - lower)) for _, lower, upper in (one, other)):
            where = " and ".join(f"{name} in {_box(lower, upper)}" for name, lower, upper in (one, other))
            said.append(f"{where} lie {gap:.4g} apart: are they in the same units?")
    return said


def _box(lower: np.ndarray, upper: np.ndarray) -> str:
    return " x ".join(f"[{low:.4g}, {high:.4g}]" for low, high in zip(lower, upper, strict=True))


def volumes_of(options: Any) -> list[tuple[str, Volume, TransferFunction]]:
    """The volumes of every `--volume`, each with its file and what it looks like."""
    made = []
    for beside in getattr(options, "volume", ()):
        volume, _ = volume_of_file(beside.file, beside.options.get("quantity"))
        name = beside.options.get("colormap", "viridis")
        look = scenes.default_volume_transfer(volume, name)
        say("colours", f"{name} over {span(look.values)}, extinction {span(look.extinction)} per unit length")
        made.append((beside.file, volume, look))
    return made


def volume_of_file(path: str, quantity: str | None) -> tuple[Volume, str]:
    """A volume, and the name of its values."""
    table = io.read_volume_table(path)
    say("file", f"{path}: {table.source}, {' x '.join(map(str, table.shape))} points")
    volume, name = io.volume_from_table(table, quantity)
    say("quantity", f"{name}, {volume.values.dtype}, {span(np.asarray(volume.values))}")
    say_notes(table.conventions)
    return volume, name


def described_volume(path: str, quantity: str | None) -> Volume:
    """Say what a file of a volume holds, and what of it would be shown."""
    table = io.read_volume_table(path)
    result(f"{path}: {table.source}, {' x '.join(map(str, table.shape))} points")
    for sentence in table.conventions:
        result(f"  {sentence}")
    result("")
    for name, values in table.arrays.items():
        columns = values.reshape(-1, *values.shape[3:])
        result(f"  {name}  {' x '.join(map(str, values.shape))}  {values.dtype}  {ranges(columns)}")
    corner, step = (" ".join(f"{number:.6g}" for number in vector) for vector in (table.lower, table.spacing))
    result(f"\nlower corner {corner}, spacing {step}\n\n`jaxsph render` would show")
    report(shape=table.shape, lower=table.lower, spacing=table.spacing, values=list(table.arrays))
    say("quantity", table.quantity(quantity)[0])
    return io.volume_from_table(table, quantity)[0]


def points_of(options: Any, *, described: bool = False) -> list[tuple[str, Points]]:
    """The points of every `--points`, by file; `described` says all that the files hold."""
    made = []
    for beside in getattr(options, "points", ()):
        table = io.read_table(beside.file, part_type=_type(beside))
        what = f"{beside.file}: {table.source}, {len(table):,} points"
        if described:
            result(what)
            attributes(table)
            result("\n`jaxsph render` would show as points")
        else:
            say("points", what)
        made.append((beside.file, _points(table, beside)))
    return made


def _points(table: io.ParticleTable, beside: Beside) -> Points:
    """The points of a table, and what was taken for them, said."""
    points, taken = io.points_from_table(
        table,
        **{name: number_or_name(beside.options[name]) for name in CHECKED if name in beside.options},
        color=_color(beside),
        colormap=beside.options.get("colormap", "heat"),
    )
    say("radius", f"{span(taken.radius_range if taken.num_points else ())}: {taken.radius}")
    say("colours", taken.color)
    say("strength", f"{span(taken.strength_range if taken.num_points else ())}: {taken.strength}")
    say_notes(taken.notes)
    return points


def _type(beside: Beside) -> int | None:
    text = beside.options.get("type")
    try:
        return None if text is None else int(text)
    except ValueError:
        raise UsageError(f"--points {beside.file}: type must be a whole number, got {text!r}") from None


def _color(beside: Beside) -> tuple[float, ...] | str | None:
    """Three numbers where there are commas, a colour where it has a name, else the name of a column."""
    text = beside.options.get("color")
    if text is None or not ("," in text or text.startswith("#") or text in COLORS):
        return text
    try:
        return rgb(text)
    except ValueError:
        must = "a column, the name of a colour, #rrggbb, or R,G,B from 0 to 1, as in 1,0.5,0"
        raise UsageError(f"--points {beside.file}: color must be {must}; got {text!r}") from None
