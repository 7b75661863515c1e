"""Volumes and points on the command line, and what a picture of several parts needs: a warning where they lie apart.

Flow: files, options -> [cli_parts] -> Volume, Points -> Scene -> cli.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Sequence

import numpy as np

from jaxsph import io
from jaxsph.cli import look as cli_look
from jaxsph.cli.console import UsageError, attributes, ranges, refuse, say, say_notes, span, tell
from jaxsph.model import Points, TransferFunction, Volume
from jaxsph.model.camera.camera import Bounded

OF_POINTS = "point_radius", "point_opacity", "point_color", "point_colormap", "point_type"
OF_VOLUMES = "volume_quantity", "volume_colormap"


def add_options(parser: argparse.ArgumentParser, *, mixed: bool = True) -> None:
    """Options of volumes and point sets that share a picture with the source."""
    add = parser.add_argument_group("volumes beside the source").add_argument
    more = "a volume in the same picture; may be repeated, and be there without a source"
    add("--volume", action="append", metavar="FILE", help=more)
    add("--volume-quantity", metavar="NAME", help="which of its values (default: the first of one number a point)")
    add("--volume-colormap", metavar="NAME", help="(default viridis)")
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


def check(options: argparse.Namespace) -> None:
    """Raise `UsageError` where options have nothing that they are for, or are out of range."""
    for names, needed in ((OF_POINTS, "points"), (OF_VOLUMES, "volume")):
        if not getattr(options, needed):
            refuse(options, names, f"is for --{needed} FILE, and there is none")
    radius, opacity = _number_or_name(options.point_radius), _number_or_name(options.point_opacity)
    if isinstance(radius, float) and not (np.isfinite(radius) and radius > 0):
        raise UsageError(f"--point-radius must be > 0, got {radius:g}")
    if isinstance(opacity, float) and not 0 <= opacity < 1:
        raise UsageError(f"--point-opacity must be in [0, 1), got {opacity:g}")
    _color(options.point_color)


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


def volumes_of(options: argparse.Namespace) -> list[tuple[str, Volume, TransferFunction]]:
    """The volumes of every file of `--volume`, each with its file and what it looks like."""
    files = [(path, volume_of_file(path, options.volume_quantity)[0]) for path in getattr(options, "volume", None) or ()]
    return [(path, volume, cli_look.look_of_volume(volume, options.volume_colormap or "viridis")) for path, volume in files]


def volume_of_file(path: str, quantity: str | None) -> tuple[Volume, str]:
    """A volume, and the name of its values."""
    table = io.read_volume_table(path)
    say("file", f"{path}: {table.source}, {' x '.join(map(str, table.shape))} points")
    try:
        volume, name = io.volume_from_table(table, quantity)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    say("quantity", f"{name}, {volume.values.dtype}, {span(np.asarray(volume.values))}")
    say_notes(table.conventions)
    return volume, name


def described_volume(path: str, quantity: str | None) -> Volume:
    """Say what a file of a volume holds, and what of it would be shown."""
    table = io.read_volume_table(path)
    print(f"{path}: {table.source}, {' x '.join(map(str, table.shape))} points")
    for sentence in table.conventions:
        print(f"  {sentence}")
    print()
    for name, values in table.arrays.items():
        columns = values.reshape(-1, *values.shape[3:])
        print(f"  {name}  {' x '.join(map(str, values.shape))}  {values.dtype}  {ranges(columns)}")
    corner, step = (" ".join(f"{number:.6g}" for number in vector) for vector in (table.lower, table.spacing))
    print(f"\nlower corner {corner}, spacing {step}\n\n`jaxsph render` would show")
    say("quantity", table.quantity(quantity)[0])
    return io.volume_from_table(table, quantity)[0]


def points_of(options: argparse.Namespace, *, described: bool = False) -> list[tuple[str, Points]]:
    """The points of every file of `--points`, by file; `described` says all that the files hold."""
    made = []
    for path in getattr(options, "points", None) or ():
        table = io.read_table(path, part_type=options.point_type)
        what = f"{path}: {table.source}, {len(table):,} points"
        if described:
            print(what)
            attributes(table)
            print("\n`jaxsph render` would show as points")
        else:
            say("points", what)
        made.append((path, _points(table, options)))
    return made


def _points(table: io.ParticleTable, options: argparse.Namespace) -> Points:
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
    say_notes(report.notes)
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
