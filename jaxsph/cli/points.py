"""Points on the command line, and what a picture of several parts needs: one box to frame, and a warning where they lie apart.

Flow: files, options -> [cli_points] -> Points -> Scene -> cli.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxsph import io
from jaxsph.cli.console import UsageError, attributes, say, span
from jaxsph.model import Points, Scene, TransferFunction, Volume
from jaxsph.model.camera.camera import Bounded

LOOK = "point_radius", "point_opacity", "point_color", "point_colormap", "point_type"


@dataclasses.dataclass(frozen=True)
class Together:
    """The box around several parts, as one thing to frame; parts that are empty have none.

    Attributes:
        parts: by what they are called.
    """

    parts: Sequence[tuple[str, Bounded]]

    def boxes(self) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """Name, lower and upper corner of each that is not empty."""
        named = [(name, *part.bounds()) for name, part in self.parts]
        return [(name, lower, upper) for name, lower, upper in named if (upper > lower).any()]

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner."""
        boxes = self.boxes()
        if not boxes:
            return np.zeros(3), np.zeros(3)
        return np.min([lower for _, lower, _ in boxes], 0), np.max([upper for _, _, upper in boxes], 0)

    def apart(self) -> list[str]:
        """A sentence for each two parts whose boxes are farther apart than either is large: their units may differ."""
        said = []
        for one, other in itertools.combinations(self.boxes(), 2):
            gap = float(np.linalg.norm(np.maximum(np.maximum(one[1] - other[2], other[1] - one[2]), 0)))
            if gap > max(float(np.linalg.norm(upper - lower)) for _, lower, upper in (one, other)):
                boxes = " and ".join(f"{name} in {_box(lower, upper)}" for name, lower, upper in (one, other))
                said.append(f"{boxes} lie {gap:.4g} apart: are they in the same units?")
        return said


def add_options(parser: argparse.ArgumentParser, *, mixed: bool = True) -> None:
    """Options of point sets."""
    group = parser.add_argument_group("points", "stars, galaxies, tracers: each of its own radius, colour and opacity")
    add = group.add_argument
    more = "a particle file whose rows are points; may be repeated, and be there without a source"
    add("--points", action="append", metavar="FILE", help=more)
    add("--point-radius", metavar="R", help="a number, or the name of a column (default: the file's)")
    add("--point-opacity", metavar="A", help="through the centre: a number in [0, 1), or a column (default: the file's, or 0.8)")
    add("--point-color", metavar="COLOR", help="R,G,B from 0 to 1, or a column (default: the file's, or white)")
    add("--point-colormap", metavar="NAME", help="shows a --point-color of one number a point (default heat)")
    add("--point-type", type=int, metavar="N", help="of a Gadget-like file, such as 4 for stars (default: gas, else the first)")
    if mixed:
        mix = "how parts mix their colours: by extinction, or as sums of colour times opacity (default extinction)"
        add("--mix", choices=("extinction", "opacity"), help=mix)


def check_usage(options: argparse.Namespace) -> None:
    """Raise `UsageError` where options have nothing that they are for, or are out of range."""
    for names, needed in ((LOOK, "points"), (("volume_quantity", "volume_colormap"), "volume")):
        alone = [name for name in names if getattr(options, name) is not None and not getattr(options, needed)]
        if alone:
            raise UsageError(f"--{alone[0].replace('_', '-')} is for --{needed} FILE, and there is none")
    radius, opacity = _number_or_name(options.point_radius), _number_or_name(options.point_opacity)
    if isinstance(radius, float) and not (np.isfinite(radius) and radius > 0):
        raise UsageError(f"--point-radius must be > 0, got {radius:g}")
    if isinstance(opacity, float) and not 0 <= opacity < 1:
        raise UsageError(f"--point-opacity must be in [0, 1), got {opacity:g}")
    _color(options.point_color)


def points_of(options: argparse.Namespace) -> list[tuple[str, Points]]:
    """The points of every file of `--points`, by file."""
    made = []
    for path in options.points or ():
        table = io.read_table(path, part_type=options.point_type, progress=sys.stderr.isatty())
        say("points", f"{path}: {table.source}, {len(table):,} points")
        made.append((path, _settled(table, options)))
    return made


def with_parts(
    scene: Scene | None,
    volumes: Sequence[tuple[Volume, TransferFunction]],
    points: Sequence[Points],
    mix: str | None,
) -> Scene:
    """A scene with more volumes and point sets in it; of nothing but them where there is none."""
    scene = Scene() if scene is None else scene
    pairs, sets = (*scene.volumes, *volumes), (*scene.point_sets, *points)
    parts: dict[str, Any] = {"mix": mix or scene.mix}
    if pairs:
        parts |= {"volume": tuple(volume for volume, _ in pairs), "volume_transfer": tuple(look for _, look in pairs)}
    if sets:
        parts["points"] = sets
    return dataclasses.replace(scene, **parts)


def warn(parts: Together, command: str) -> None:
    """A line on stderr for each two parts that lie far apart."""
    for sentence in parts.apart():
        print(f"jaxsph {command}: warning: {sentence}", file=sys.stderr)


def describe(options: argparse.Namespace) -> list[tuple[str, Points]]:
    """Say what files of points hold, and what of it would be shown; the points by file."""
    made = []
    for path in options.points or ():
        table = io.read_table(path, part_type=options.point_type, progress=sys.stderr.isatty())
        print(f"{path}: {table.source}, {len(table):,} points")
        attributes(table)
        print("\n`jaxsph render` would show as points")
        made.append((path, _settled(table, options)))
    return made


def _settled(table: io.ParticleTable, options: argparse.Namespace) -> Points:
    """The points of a table, and what was taken for them, said."""
    points, report = io.points_from_table(
        table,
        radius=_number_or_name(options.point_radius),
        opacity=_number_or_name(options.point_opacity),
        color=_color(options.point_color),
        colormap=options.point_colormap or "heat",
    )
    say("radius", f"{span(report.radius_range if report.num_points else ())}: {report.radius}")
    say("colours", report.color)
    say("strength", f"{span(report.strength_range if report.num_points else ())}: {report.strength}")
    for note in report.notes:
        say("note", note)
    return points


def _number_or_name(text: str | None) -> float | str | None:
    try:
        return None if text is None else float(text)
    except ValueError:
        return text


def _color(text: str | None) -> tuple[float, ...] | str | None:
    """Three numbers where there are commas, else the name of a column."""
    if text is None or "," not in text:
        return text
    try:
        color = tuple(float(part) for part in text.split(","))
    except ValueError:
        color = ()
    if len(color) != 3 or not all(0 <= part <= 1 for part in color):
        raise UsageError(f"--point-color must be a column or R,G,B from 0 to 1, as in 1,0.5,0; got {text!r}")
    return color


def _box(lower: np.ndarray, upper: np.ndarray) -> str:
    return " x ".join(f"[{low:.4g}, {high:.4g}]" for low, high in zip(lower, upper, strict=True))
