"""Where and which on the command line: conditions, shares, periodic boxes, and clips.

Flow: options -> [cli_where] -> particles, Scene.within, what there is to frame -> cli.
"""

from __future__ import annotations

import argparse
import functools
import operator
from typing import Any

import numpy as np

from jaxsph.cli.console import UsageError, say, wrong_usage
from jaxsph.cli.options import replaced
from jaxsph.model import Particles
from jaxsph.model.camera.camera import Bounded, BoundingBox
from jaxsph.model.clips.clips import Clip
from jaxsph.model.clips.shapes import Box, Plane, Sphere
from jaxsph.sequence.snapshots import center_of
from jaxsph.sequence.survey import Survey

OF_FILES = ("where", "share", "box", "not_periodic", "center")
OF_PARTICLES = (*OF_FILES, "slice")
DENSEST = "densest"
CLIPS = ("clip_plane", "clip_box", "cut_box", "clip_sphere", "cut_sphere")


def add_selection(parser: argparse.ArgumentParser) -> None:
    """Options of which particles of a file are shown."""
    add = parser.add_argument_group("which particles of a file").add_argument
    add("--where", metavar="CONDITION", help='such as "Temperature > 1e4 and Density < 2"; names as `jaxsph info` lists them')
    add("--share", type=float, metavar="S", help="a share of them, as 0.1, for a quick look: their field is another one")
    add("--box", nargs=3, type=float, metavar=("LX", "LY", "LZ"), help="sides of a periodic box (default: the file's)")
    add("--not-periodic", action="store_true", default=None, help="leave the file's box aside: nothing reaches across its faces")


def add_places(parser: argparse.ArgumentParser, *, slices: bool = True) -> None:
    """Options of where things are shown."""
    add = parser.add_argument_group("where", "Clips may be repeated: what is in all of them is shown.").add_argument
    more = f"middle of a periodic box: X Y Z, or {DENSEST} for the densest point"
    add("--center", nargs="+", metavar=("X", "Y Z"), help=more)
    vector = ("X", "Y", "Z")
    clips: dict[str, Any] = {"type": float, "action": "append"}
    more = "what is on the side that (NX, NY, NZ) points to"
    add("--clip-plane", nargs=6, metavar=(*vector, "NX", "NY", "NZ"), **clips, help=more)
    corners = ("X0", "Y0", "Z0", "X1", "Y1", "Z1")
    add("--clip-box", nargs=6, metavar=corners, **clips, help="what is inside of a box")
    add("--cut-box", nargs=6, metavar=corners, **clips, help="what is outside of it")
    add("--clip-sphere", nargs=4, metavar=(*vector, "R"), **clips, help="what is inside of a sphere")
    add("--cut-sphere", nargs=4, metavar=(*vector, "R"), **clips, help="what is outside of it")
    if slices:
        more = "the quantity on a plane through (X, Y, Z), seen from where (NX, NY, NZ) points to; OUT may be .npy, too"
        add("--slice", nargs=6, type=float, metavar=(*vector, "NX", "NY", "NZ"), help=more)


def settled(options: argparse.Namespace) -> argparse.Namespace:
    """The options with what `--center` has taken from FILE where it belongs; what needs no file is checked.

    Raises:
        UsageError: options that are no numbers, or do not go together.
    """
    given = getattr(options, "center", None)
    if given is not None:
        wanted = 1 if given[0] == DENSEST else 3
        if len(given) == wanted + 1 and options.source is None:
            *given, source = given
            options = replaced(options, source=source)
        options = replaced(options, center=DENSEST if given == [DENSEST] else _numbers(given))
    if options.box is not None and options.not_periodic:
        raise UsageError("--box and --not-periodic exclude each other")
    if options.box is not None and not all(np.isfinite(side) and side > 0 for side in options.box):
        raise UsageError(f"--box must be three lengths > 0, got {' '.join(f'{side:g}' for side in options.box)}")
    clip_of(options)
    return options


def _numbers(given: list[str]) -> list[float]:
    try:
        numbers = [float(value) for value in given]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise UsageError(f"--center must be X Y Z or {DENSEST}, got {' '.join(given)}")
    return numbers


def selected(options: argparse.Namespace) -> dict[str, Any]:
    """Which particles of a file are asked for, as `io.particles_from_table` is to be given them."""
    box = None if getattr(options, "not_periodic", None) else getattr(options, "box", None) or "file"
    return {"box": box, "where": getattr(options, "where", None), "share": getattr(options, "share", None)}


def centered(particles: Particles, options: argparse.Namespace) -> Particles:
    """With the middle of a periodic box where it is asked for."""
    at = getattr(options, "center", None)
    if at is None:
        return particles
    if particles.box is None:
        raise UsageError("--center is for periodic boxes, and this is none; give its sides by --box, or look at it by --target")
    moved = particles.centered(at)
    _say_center(np.mean(moved.bounds(), 0))
    return moved


def middle_of(survey: Survey, options: argparse.Namespace) -> tuple[float, float, float] | None:
    """The same of a sequence."""
    if options.center is not None and survey.box is None:
        raise UsageError("--center is for periodic boxes, and these files do not have one; give its sides by --box")
    center = center_of(survey, options.center)
    if center is not None:
        _say_center(center)
    return center


def _say_center(center: Any) -> None:
    say("center", " ".join(f"{value:.6g}" for value in center))


def clip_of(options: argparse.Namespace) -> Clip | None:
    """What is in all clips that are asked for; None where there are none."""
    clips: list[Clip] = []
    makers = (plane, _box, lambda numbers: ~_box(numbers), _sphere, lambda numbers: ~_sphere(numbers))
    for name, make in zip(CLIPS, makers, strict=True):
        with wrong_usage(f"--{name.replace('_', '-')}: "):
            clips += [make(numbers) for numbers in getattr(options, name, None) or ()]
    return functools.reduce(operator.and_, clips) if clips else None


def plane(numbers: list[float]) -> Plane:
    """Of a place on it, and where it points to."""
    return Plane(numbers[:3], numbers[3:])


def _box(numbers: list[float]) -> Box:
    return Box(numbers[:3], numbers[3:])


def _sphere(numbers: list[float]) -> Sphere:
    return Sphere(numbers[:3], numbers[3])


def framed(parts: Bounded, options: argparse.Namespace) -> Bounded:
    """What there is to frame: all of it, or what is in the boxes and spheres that it is clipped by.

    Raises:
        UsageError: nothing is.
    """
    inner = [(numbers[:3], numbers[3:]) for numbers in getattr(options, "clip_box", None) or ()]
    for x, y, z, radius in getattr(options, "clip_sphere", None) or ():
        inner.append(([value - radius for value in (x, y, z)], [value + radius for value in (x, y, z)]))
    if not inner:
        return parts
    lower, upper = parts.bounds()
    low, high = np.max([lower, *(one for one, _ in inner)], 0), np.min([upper, *(other for _, other in inner)], 0)
    if not (low < high).all():
        raise UsageError(f"nothing is inside of --clip-box and --clip-sphere; there is something {ends_of(lower, upper)}")
    return BoundingBox(low, high)


def ends_of(lower: np.ndarray, upper: np.ndarray) -> str:
    """From where to where a box is, in words."""
    ends = (" ".join(f"{value:.6g}" for value in end) for end in (lower, upper))
    return "from " + " to ".join(ends)


def left_out(options: argparse.Namespace) -> list[tuple[str, Any]]:
    """What is not shown, as metadata of a picture."""
    given = {name: getattr(options, name, None) for name in ("where", "share", *CLIPS)}
    return [(f"jaxsph.{name}", value if isinstance(value, str | float) else str(value)) for name, value in given.items() if value]
