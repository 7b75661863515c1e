"""One frame of a sequence, as a task that can be done anywhere: read, planned for, rendered, written.

Flow: source, camera, settings -> [task: FrameTask] -> plan -> render -> image or file.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from jaxsph import io
from jaxsph.engine.planning.fit import plan as make_plan
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.render import render
from jaxsph.io.images.image_files import LIGHT
from jaxsph.io.replace import digest_of, fingerprint
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.numerics import __version__
from jaxsph.numerics.trees import line_of

Source = Scene | Callable[[], Scene]
FINGERPRINT = "jaxsph.frame"
"""Name of the metadata by which a frame that is there is told from one of other settings."""
FIRST_HEADROOM, MORE_HEADROOM = 1.5, 3.0
"""Room beyond need, of the first frame's plan and of those grown from it: where pairs grow tenfold there are three plans.

Room costs no time that could be measured on CPUs (at 43,740 particles and 256 x 256 pixels, up to 25 times what was needed)."""


@dataclasses.dataclass(frozen=True)
class FrameTask:
    """All that one frame depends on; it can be done anywhere, and twice with the same result.

    Numbers begin at 1; without an `output`, `.png` or `.exr`, it makes an image.
    """

    number: int
    source: Source
    camera: Camera
    settings: Settings
    output: Path | None = None

    def scene(self) -> Scene:
        """The scene, read now if it is a file's."""
        return self.source if isinstance(self.source, Scene) else self.source()

    def fingerprint(self, scene: Scene | None = None) -> str:
        """A digest of all that the picture depends on; of files, of their names, sizes and times of change.

        What EXR files hold of colours is part of it: frames of a sequence are all of one kind.
        """
        mark = getattr(self.source, "fingerprint", None) or digest_of(scene or self.scene())
        settings = dataclasses.replace(self.settings, memory_limit=None)
        return fingerprint("f", __version__, LIGHT, jax.config.read("jax_enable_x64"), settings, digest_of(self.camera), mark)


@dataclasses.dataclass(frozen=True)
class FrameFile:
    """A frame of a sequence that is written to disk.

    Attributes:
        number: from 1 on.
        path: where.
        rendered: False where it was there already, and where it could not be made.
        stats: of its image; empty where none was rendered.
        error: why it could not be made; None where it is there.
    """

    number: int
    path: Path
    rendered: bool
    stats: dict[str, Any]
    error: str | None = None

    def __repr__(self) -> str:
        how = self.error or ("rendered" if self.rendered else "there already")
        return line_of("FrameFile", f"{self.number}", f"{self.path}", how)


class FramesError(ValueError):
    """Some frames could not be made; all others were.

    Attributes:
        failed: those that could not, each with its `error`.
        frames: how many there are in all.
    """

    def __init__(self, failed: Sequence[FrameFile], frames: int) -> None:
        self.failed, self.frames = tuple(failed), frames
        reasons = dict.fromkeys(str(frame.error) for frame in failed)
        numbers = {why: [frame.number for frame in failed if str(frame.error) == why] for why in reasons}
        told = "; ".join(f"{_runs(which)}: {why}" for why, which in numbers.items())
        super().__init__(f"{len(failed)} of {frames} frames could not be made: {told}")

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.failed, self.frames)


def each_or_raise(frames: Iterator[FrameFile]) -> Iterator[FrameFile]:
    """All frames, and at the end `FramesError` where some could not be made."""
    failed, last = [], 0
    for frame in frames:
        last = frame.number
        if frame.error is not None:
            failed.append(frame)
        yield frame
    if failed:
        raise FramesError(failed, last)


class UnwritableError(ValueError):
    """A frame cannot be written where it belongs; nor can those after it."""


def _runs(numbers: Sequence[int]) -> str:
    """`frame 7`, or `frames 3, 5 to 9`."""
    groups = itertools.groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])
    runs = [[number for _, number in group] for _, group in groups]
    told = ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)
    return f"frame{'s' if len(numbers) > 1 else ''} {told}"


@dataclasses.dataclass
class GrowingPlan:
    """One plan for all frames of a sequence, with the choices of the first frame and room for the largest so far."""

    ahead: Sequence[Camera] = ()  # from all of which its first has room for the first scene
    made: Plan | None = None
    first: FrameTask | None = None  # the frame that it is made for, whether that is rendered or not

    def fits(self, scene: Scene, camera: Camera, settings: Settings) -> Plan:
        """The plan, grown if this frame asks for it."""
        if self.made is not None:
            self.made = make_plan(scene, camera, settings, like=self.made, headroom=MORE_HEADROOM)
            return self.made
        self.made = make_plan(scene, camera, settings, headroom=FIRST_HEADROOM)
        for later in self.ahead:
            self.made = make_plan(scene, later, settings, like=self.made, headroom=FIRST_HEADROOM)
        return self.made

    def begin(self) -> None:
        """Make its choices by the first frame, unless they are made."""
        if self.made is None and self.first is not None:
            self.fits(self.first.scene(), self.first.camera, self.first.settings)


def rendered(task: FrameTask, scene: Scene, plan: GrowingPlan) -> Image:
    """The image of a task."""
    return render(scene, task.camera, task.settings, plan=plan.fits(scene, task.camera, task.settings))


def written(task: FrameTask, plan: GrowingPlan) -> FrameFile:
    """Write the frame of a task, unless it is there; `UnwritableError` where there is no place for it."""
    assert task.output is not None
    scene = None if hasattr(task.source, "fingerprint") else task.scene()
    mark = task.fingerprint(scene)
    if fingerprint_of(task.output) == mark:
        return FrameFile(task.number, task.output, False, {})
    if plan.first is not None and task.number != plan.first.number:
        with contextlib.suppress(ValueError, OSError):  # it was read once, and is no more what it was
            plan.begin()
    image = rendered(task, task.scene() if scene is None else scene, plan)
    marked = dataclasses.replace(image, metadata=(*image.metadata, (FINGERPRINT, mark)))
    try:
        task.output.parent.mkdir(parents=True, exist_ok=True)
        marked.save(task.output)
    except (ValueError, OSError) as error:
        raise UnwritableError(f"frame {task.number} cannot be written: {error}") from error
    return FrameFile(task.number, task.output, True, image.stats)


def unmade(task: FrameTask, error: BaseException | None) -> FrameFile:
    """What is told of a frame that could not be made."""
    assert task.output is not None
    if isinstance(error, OSError) and error.filename is not None:
        why = f"{os.fspath(error.filename)}: {error.strerror or type(error).__name__}"
    else:
        why = str(error) or type(error).__name__
    return FrameFile(task.number, task.output, False, {}, why)


def fingerprint_of(path: Path) -> str | None:
    """What a frame's file says that it was made of; None where there is none, or none that can be read to its end."""
    if not path.exists():
        return None
    try:
        return str(dict(io.read_image(path).metadata).get(FINGERPRINT))
    except (ValueError, OSError):
        return None
