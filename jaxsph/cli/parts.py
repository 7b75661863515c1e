"""Volumes and points on the command line, and what a picture of several parts needs: a warning where they lie apart.

Flow: files, options -> [parts] -> Volume, Points -> Scene -> commands.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxsph import io, scenes
from jaxsph.cli.console import attributes, ranges, say_notes, span, written_place
from jaxsph.cli.voice import report, result, say, tell
from jaxsph.model import Points, TransferFunction, Volume
from jaxsph.model.camera.camera import Bounded


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
            where = " and ".join(
                f"{name} in " + " x ".join(f"[{low:.4g}, {high:.4g}]" for low, high in zip(lower, upper, strict=True))
                for name, lower, upper in (one, other)
            )
            said.append(f"{where} lie {gap:.4g} apart: are they in the same units?")
    return said


def volumes_of(options: Any) -> list[tuple[str, Volume, TransferFunction]]:
    """The volumes of every `--volume`, each with its file and what it looks like."""
    made = []
    for beside in getattr(options, "volume", ()):
        volume, _ = volume_of_file(beside.file, beside.options.get("quantity"))
        name = beside.options.get("colormap", "viridis")
        look = scenes.default_transfer(volume, name)
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
    where = f"lower corner {written_place(table.lower)}, spacing {written_place(table.spacing)}"
    result(f"\n{where}\n\n`jaxsph render` would show")
    report(shape=table.shape, lower=table.lower, spacing=table.spacing, values=list(table.arrays))
    say("quantity", table.quantity(quantity)[0])
    return io.volume_from_table(table, quantity)[0]


def points_of(options: Any, *, described: bool = False) -> list[tuple[str, Points]]:
    """The points of every `--points`, by file; `described` says all that the files hold."""
    made = []
    for beside in getattr(options, "points", ()):
        table = io.read_table(beside.file, part_type=beside.options.get("type"))
        what = f"{beside.file}: {table.source}, {len(table):,} points"
        if described:
            result(what)
            attributes(table)
            result("\n`jaxsph render` would show as points")
        else:
            say("points", what)
        given = {name: value for name, value in beside.options.items() if name != "type"}
        points, taken = io.points_from_table(table, **{"colormap": "heat"} | given)
        say("radius", f"{span(taken.radius_range if taken.num_points else ())}: {taken.radius}")
        say("colours", taken.color)
        say("strength", f"{span(taken.strength_range if taken.num_points else ())}: {taken.strength}")
        say_notes(taken.notes)
        made.append((beside.file, points))
    return made
