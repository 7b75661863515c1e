"""From where, where and which on the command line: cameras of what is no scene, middles of boxes, and clips.

Flow: options -> [where] -> Camera, Scene.within, what there is to frame -> commands.
"""

from __future__ import annotations

import dataclasses
import functools
import operator
from typing import Any

import numpy as np

from jaxsph.cli.console import UsageError, written_place, wrong_usage
from jaxsph.cli.voice import say
from jaxsph.io import ParticleTable
from jaxsph.io.opening.views import FOV_DEGREES, length_of, place_of, told_of_up
from jaxsph.io.table import CodeUnit
from jaxsph.model import Camera, Particles, Scene
from jaxsph.model.camera.camera import Bounded, BoundingBox
from jaxsph.model.camera.framing import UP, VIEWS, sight, snug, snug_box, upright
from jaxsph.model.clips import Clip
from jaxsph.model.preview.frame import Direction
from jaxsph.sequence.snapshots import center_of
from jaxsph.sequence.survey import Survey

PLACED = ("center", "width", "view", "eye", "target", "up", "fov_degrees", "frame_all")
"""Options that place a camera."""


def is_placed(options: Any) -> bool:
    """Whether any option says where the camera is."""
    return any(getattr(options, name, None) not in (None, False) for name in PLACED)


def camera_of(shown: Bounded, options: Any, depths: tuple[float, float] | None = None, unit: CodeUnit | None = None) -> Camera:
    """The camera asked for, of what there is to frame; where only a part is said, the rest frames it. Between `depths`, or snug.

    Raises:
        UsageError: options that do not go together, or that the place does not suit.
    """
    shown = left_by(clip_of(options), shown)
    lower, upper = shown.bounds()
    width, height = options.size
    with wrong_usage():
        if options.eye is not None:
            return _from_eye(shown, options, depths)
        if options.view in ("face-on", "edge-on"):
            raise ValueError(f"--view {options.view} is for a single file that is rendered; choose x, y, z or iso")
        at = (lower + upper) / 2 if options.center is None else np.asarray(options.center, np.float64)
        if (at < lower).any() or (at > upper).any():
            raise ValueError(f"--center {written_place(at)} is outside of everything: that lies {ends_of(lower, upper)}")
        tall = None if options.width is None else length_of(options.width, "width", unit)[0] * height / width
        if options.view in VIEWS:
            return _along(shown, options, tall, depths)
        forward, up = sight("iso", options.up)
        if tall is not None:
            made = Direction.along(forward, up, _fov(options), options.size).camera(at, tall, Scene())
            return snug_box(made, lower, upper)
        shown = BoundingBox(at - (upper - lower) / 2, at + (upper - lower) / 2) if options.center is not None else shown
        return Camera.framing(shown, direction=forward, up=up, fov_degrees=_fov(options), width=width, height=height)


def _along(shown: Bounded, options: Any, tall: float | None, depths: tuple[float, float] | None) -> Camera:
    """With parallel rays along an axis; `depths` are coordinates along it."""
    width, height = options.size
    whole = Camera.along_axis(shown, options.view, width, height, depth_range=depths, up=options.up)
    if tall is None and options.center is None:
        return whole
    tall = 2 * float(whole.half_height) if tall is None else tall
    _, up, forward = np.asarray(whole.axes, np.float64)
    eye = whole.exact_eye()
    at = eye if options.center is None else np.asarray(options.center, np.float64)
    moved = eye + (at - eye) - ((at - eye) @ forward) * forward
    return Camera.orthographic(moved, moved + forward, up, tall, width, height, near=float(whole.near), far=float(whole.far))


def _from_eye(shown: Bounded, options: Any, depths: tuple[float, float] | None) -> Camera:
    lower, upper = shown.bounds()
    width, height = options.size
    target = (lower + upper) / 2 if options.target is None else options.target
    near, far = depths or (1e-3, 1.0)
    up = upright(np.subtract(target, options.eye), options.up)
    made = Camera.look_at(options.eye, target, up, _fov(options), width, height, near=near, far=far)
    if depths is not None:
        return made
    return snug(made, shown) if isinstance(shown, Particles) else snug_box(made, lower, upper)


def placed(options: Any, particles: Particles, table: ParticleTable | None) -> Any:
    """The options with the place that is asked for in the middle, and what is up; both said."""
    if options.center is not None:
        with wrong_usage():
            options = dataclasses.replace(options, center=tuple(place_of(Scene(particles=particles), options.center, table)))  # type: ignore[arg-type]
        say("center", written_place(options.center))
    return options if table is None else upward(options, table.up, table.source)


def upward(options: Any, up: Any = UP, source: str = "") -> Any:
    """The options with what is up: as asked for, or as the kind of file has it, which is said."""
    if options.up is None:
        say("up", told_of_up(up, source))
    return dataclasses.replace(options, up=options.up or up)


def _fov(options: Any) -> float:
    return FOV_DEGREES if options.fov_degrees is None else float(options.fov_degrees)


def middle_of(survey: Survey, options: Any) -> tuple[float, float, float] | None:
    """What is to be in the middle of the periodic box of a sequence."""
    given = options.center
    if given is None:
        return None
    if survey.box is None:
        raise UsageError("--center is for periodic boxes, and these files do not have one; give its sides by --box-size")
    if given == "mass":
        raise UsageError("--center mass is for one file; of a sequence give X,Y,Z or densest")
    center = center_of(survey, list(given) if not isinstance(given, str) else given)
    if center is not None:
        say("center", written_place(center))
    return center


def clip_of(options: Any) -> Clip | None:
    """What is in all clips that are asked for; None where there are none."""
    return functools.reduce(operator.and_, options.clips) if options.clips else None


def left_by(clip: Clip | None, parts: Bounded) -> Bounded:
    """What there is to frame: all of it, or what a clip leaves.

    Raises:
        UsageError: that is nothing.
    """
    if clip is None:
        return parts
    lower, upper = parts.bounds()
    low, high = np.array([clip.ends(axis, lower, upper) for axis in np.eye(3)]).T
    if not (low < high).all():
        raise UsageError(f"nothing is inside of --clip; there is something {ends_of(lower, upper)}")
    return BoundingBox(low, high)


def ends_of(lower: np.ndarray, upper: np.ndarray) -> str:
    """From where to where a box is, in words."""
    return f"from {written_place(lower)} to {written_place(upper)}"


def left_out(options: Any) -> list[tuple[str, Any]]:
    """What is not shown, as metadata of a picture."""
    clips = " ".join(word.removeprefix("--clip=") for word in options.words if word.startswith("--clip="))
    given = {"where": options.where, "share": options.share, "clip": clips}
    return [(f"jaxsph.{name}", value) for name, value in given.items() if value]
