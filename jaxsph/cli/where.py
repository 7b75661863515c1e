"""Where and which on the command line: conditions, shares, periodic boxes, clips and slices.

Flow: options -> [cli_where] -> particles, Scene.within, Slice -> cli.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import operator
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsph import io
from jaxsph.analysis.slices import slice_of
from jaxsph.cli.console import UsageError, say, span
from jaxsph.io.images.slices import SUFFIXES
from jaxsph.model import Camera, Image, Particles, Scene
from jaxsph.model.camera.camera import Bounded
from jaxsph.model.clips.clips import Clip
from jaxsph.model.clips.shapes import Box, Plane, Sphere
from jaxsph.sequence.snapshots import center_of
from jaxsph.sequence.survey import Survey

OF_FILES = ("where", "share", "box", "not_periodic", "center")
OF_PARTICLES = (*OF_FILES, "slice")
DENSEST = "densest"
NOT_OF_SLICES = (
    *("annotate", "eye", "target", "fov", "integrator", "tolerance", "estimator", "screen", "progressive", "relax"),
    "samples",
    *("opacity", "opacity_by", "memory", "devices", "from_disk", "volume", "points", "mix", "iso"),
)
"""Options that do nothing to the picture of a plane."""
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
    if not slices:
        return
    more = "the quantity on a plane through (X, Y, Z), seen from where (NX, NY, NZ) points to; OUT may be .npy, too"
    add("--slice", nargs=6, type=float, metavar=(*vector, "NX", "NY", "NZ"), help=more)


def settle(options: argparse.Namespace) -> None:
    """Tell what `--center` has taken from FILE, and check what needs no file.

    Raises:
        UsageError: options that are no numbers, or do not go together.
    """
    given = getattr(options, "center", None)
    if given is not None:
        wanted = 1 if given[0] == DENSEST else 3
        if len(given) == wanted + 1 and options.source is None:
            options.source = given.pop()
        options.center = DENSEST if given == [DENSEST] else _numbers(given)
    if options.box is not None and options.not_periodic:
        raise UsageError("--box and --not-periodic exclude each other")
    if options.box is not None and not all(np.isfinite(side) and side > 0 for side in options.box):
        raise UsageError(f"--box must be three lengths > 0, got {' '.join(f'{side:g}' for side in options.box)}")
    clip_of(options)
    if plane_of_slice(options) is not None:
        _refuse_beside_slice(options)


def _refuse_beside_slice(options: argparse.Namespace) -> None:
    """A slice looks straight at its plane, and casts no rays."""
    for name in NOT_OF_SLICES:
        given = getattr(options, name, None)
        if given is not None and given is not False:
            raise UsageError(f"--{name.replace('_', '-')} and --slice exclude each other: a slice casts no rays; leave one out")


def _numbers(given: list[str]) -> list[float]:
    try:
        numbers = [float(value) for value in given]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not np.isfinite(numbers).all():
        raise UsageError(f"--center must be X Y Z or {DENSEST}, got {' '.join(given)}")
    return numbers


class Selected(NamedTuple):
    """What `io.particles_from_table` is to be given."""

    box: Any
    where: str | None
    share: float | None


def selected(options: argparse.Namespace) -> dict[str, Any]:
    """Which particles of a file are asked for."""
    box = None if getattr(options, "not_periodic", None) else getattr(options, "box", None) or "file"
    return Selected(box, getattr(options, "where", None), getattr(options, "share", None))._asdict()


@contextlib.contextmanager
def conditions() -> Iterator[None]:
    """A condition that is not understood is wrong usage."""
    try:
        yield
    except io.ConditionError as error:
        raise UsageError(str(error)) from error


def centered(particles: Particles, options: argparse.Namespace) -> Particles:
    """With the middle of a periodic box where it is asked for."""
    at = getattr(options, "center", None)
    if at is None:
        return particles
    if particles.box is None:
        raise UsageError("--center is for periodic boxes, and this is none; give its sides by --box, or look at it by --target")
    moved = particles.centered(at)
    assert moved.box is not None
    lower, upper = moved.box.corners()
    say("center", " ".join(f"{value:.6g}" for value in (lower + upper) / 2))
    return moved


def middle_of(survey: Survey, options: argparse.Namespace) -> tuple[float, float, float] | None:
    """The same of a sequence."""
    if options.center is not None and survey.box is None:
        raise UsageError("--center is for periodic boxes, and these files do not have one; give its sides by --box")
    center = center_of(survey, options.center)
    if center is not None:
        say("center", " ".join(f"{value:.6g}" for value in center))
    return center


def shown(scene: Scene, options: argparse.Namespace) -> Scene:
    """The scene in what is clipped."""
    clip = clip_of(options)
    return scene if clip is None else dataclasses.replace(scene, within=clip)


def clip_of(options: argparse.Namespace) -> Clip | None:
    """What is in all clips that are asked for; None where there are none."""
    clips: list[Clip] = []
    makers = (_plane, _box, lambda numbers: ~_box(numbers), _sphere, lambda numbers: ~_sphere(numbers))
    for name, make in zip(CLIPS, makers, strict=True):
        for numbers in getattr(options, name, None) or ():
            with _named(name):
                clips.append(make(numbers))
    return functools.reduce(operator.and_, clips) if clips else None


def plane_of_slice(options: argparse.Namespace) -> Plane | None:
    """The plane of `--slice`."""
    if getattr(options, "slice", None) is None:
        return None
    with _named("slice"):
        return _plane(options.slice)


@contextlib.contextmanager
def _named(option: str) -> Iterator[None]:
    try:
        yield
    except ValueError as error:
        raise UsageError(f"--{option.replace('_', '-')}: {error}") from error


def _plane(numbers: list[float]) -> Plane:
    return Plane(numbers[:3], numbers[3:])


def _box(numbers: list[float]) -> Box:
    return Box(numbers[:3], numbers[3:])


def _sphere(numbers: list[float]) -> Sphere:
    return Sphere(numbers[:3], numbers[3])


class Clipped(NamedTuple):
    """What there is to frame, as far as boxes and spheres leave it."""

    lower: np.ndarray
    upper: np.ndarray

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """See `Bounded`."""
        return self.lower, self.upper


def framed(parts: Any, options: argparse.Namespace) -> Any:
    """What there is to frame: all of it, or what is in the boxes and spheres that it is clipped by.

    Raises:
        UsageError: nothing is.
    """
    inner = [(numbers[:3], numbers[3:]) for numbers in getattr(options, "clip_box", None) or ()]
    for x, y, z, radius in getattr(options, "clip_sphere", None) or ():
        inner.append(([value - radius for value in (x, y, z)], [value + radius for value in (x, y, z)]))
    if not inner or parts is None:
        return parts
    bounded: Bounded = parts
    lower, upper = bounded.bounds()
    low = functools.reduce(np.maximum, [np.asarray(one) for one, _ in inner], lower)
    high = functools.reduce(np.minimum, [np.asarray(other) for _, other in inner], upper)
    if not (low < high).all():
        raise UsageError(f"nothing is inside of --clip-box and --clip-sphere; there is something {_ends(lower, upper)}")
    return Clipped(low, high)


def _ends(lower: np.ndarray, upper: np.ndarray) -> str:
    ends = (" ".join(f"{value:.6g}" for value in end) for end in (lower, upper))
    return "from " + " to ".join(ends)


def labelled(image: Image, options: argparse.Namespace) -> Image:
    """With what was left out, in its metadata."""
    return dataclasses.replace(image, metadata=(*image.metadata, *_labels(options)))


def _labels(options: argparse.Namespace) -> list[tuple[str, Any]]:
    given = {name: getattr(options, name, None) for name in ("where", "share", *CLIPS)}
    return [(f"jaxsph.{name}", value if isinstance(value, str | float) else str(value)) for name, value in given.items() if value]


def save_slice(scene: Scene, camera: Camera, options: argparse.Namespace, output: Path) -> None:
    """Make the picture of `--slice`."""
    plane, particles = plane_of_slice(options), scene.particles
    assert plane is not None and particles is not None
    started = time.perf_counter()
    size = {"width": camera.width, "height": camera.height}
    made = slice_of(particles, plane, within=scene.within, up=options.up, **size)
    there = np.isfinite(made.values)
    if not there.any():
        raise ValueError(f"no particle reaches the plane of --slice; there are particles {_ends(*particles.bounds())}")
    made = dataclasses.replace(made, metadata=(*made.metadata, *_labels(options)))
    made.save(output, scene.transfer)
    say("slice", f"{span(made.values[there])}, {there.mean():.1%} of the pixels inside of supports")
    say("image", f"{output}, {camera.width} x {camera.height}, {made.pixel_size:.6g} a pixel")
    say("time", f"{time.perf_counter() - started:.2f} s")


def suffixes(options: argparse.Namespace, usual: tuple[str, ...]) -> tuple[str, ...]:
    """Of files that the picture may be written to."""
    return SUFFIXES if getattr(options, "slice", None) is not None else usual
