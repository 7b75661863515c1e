"""Many frames: each a task of its own, one plan for all of them, files that are there already left as they are.

Flow: sources, cameras, settings -> [frames: FrameTask] -> plan -> render -> images or files.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, overload

import jax
import numpy as np

from jaxsph import io
from jaxsph.field.in_octree import reachable
from jaxsph.model import Camera, CameraPath, Image, Scene, Settings
from jaxsph.plan import Plan
from jaxsph.planning import plan as make_plan
from jaxsph.render import render
from jaxsph.snapshots import Snapshots
from jaxsph.version import __version__

Source = Scene | Callable[[], Scene]
FINGERPRINT = "jaxsph.frame"
"""Name of the metadata by which a frame that is there is told from one of other settings."""
FIRST_HEADROOM, MORE_HEADROOM = 1.5, 3.0
"""Room beyond need, of the first frame's plan and of those grown from it: where pairs grow tenfold there are three plans.

Room costs no time that could be measured on CPUs (at 43,740 particles and 256 x 256 pixels, up to 25 times what was needed)."""
AHEAD = 16
"""Cameras, evenly spread, that are measured with the first scene before anything is compiled: it takes milliseconds each."""


@dataclasses.dataclass(frozen=True)
class FrameTask:
    """All that one frame depends on; it can be done anywhere, and twice with the same result.

    Attributes:
        number: from 1 on.
        source: a scene, or what gives one when it is called.
        camera, settings: as for `jaxsph.render`.
        output: `.png` or `.exr` to write; None makes an image.
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
        """A digest of all that the picture depends on; of files, of their names, sizes and times of change."""
        mark = getattr(self.source, "fingerprint", None) or digest_of(scene or self.scene())
        settings = dataclasses.replace(self.settings, memory_limit=None)
        parts = __version__, jax.config.read("jax_enable_x64"), settings, digest_of(self.camera), mark
        return "f" + hashlib.sha256(repr(parts).encode()).hexdigest()[:24]


@dataclasses.dataclass(frozen=True, eq=False)
class Still:
    """One scene as the source of many frames, of which a digest is taken once."""

    scene: Scene

    def __call__(self) -> Scene:
        """The scene."""
        return self.scene

    @functools.cached_property
    def fingerprint(self) -> str:
        """A digest of all of its arrays, and of what they are called."""
        return digest_of(self.scene)


def digest_of(tree: Any) -> str:
    """A digest of a tree of arrays: structure, types, shapes and numbers."""
    leaves, structure = jax.tree.flatten(tree)
    digest = hashlib.sha256(repr(structure).encode())
    for leaf in map(np.asarray, leaves):
        digest.update(f"{leaf.dtype} {leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


@dataclasses.dataclass(frozen=True)
class FrameFile:
    """A frame that is on disk.

    Attributes:
        number: from 1 on.
        path: where.
        rendered: False where it was there already.
        stats: of its image; empty where it was there already.
    """

    number: int
    path: Path
    rendered: bool
    stats: dict[str, Any]


class GrowingPlan:
    """One plan for all frames of a sequence, with the choices of the first frame and room for the largest so far.

    Its first has room for the first scene from all of some cameras, `ahead`.
    """

    def __init__(self, ahead: Sequence[Camera] = ()) -> None:
        self._plan: Plan | None = None
        self._ahead = ahead

    def fits(self, scene: Scene, camera: Camera, settings: Settings) -> Plan:
        """The plan, grown if this frame asks for it."""
        if self._plan is not None:
            self._plan = make_plan(scene, camera, settings, like=self._plan, headroom=MORE_HEADROOM)
            return self._plan
        made = make_plan(scene, camera, settings, headroom=FIRST_HEADROOM)
        for later in self._ahead:
            made = make_plan(scene, later, settings, like=made, headroom=FIRST_HEADROOM)
        self._plan = made
        return made

    @property
    def is_made(self) -> bool:
        """Whether there has been a frame."""
        return self._plan is not None


@overload
def render_frames(sources: Any, cameras: Any, settings: Settings | None = None, client: None = None) -> Iterator[Image]: ...
@overload
def render_frames(
    sources: Any, cameras: Any, settings: Settings | None = None, client: None = None, *, output: str | os.PathLike[str]
) -> Iterator[FrameFile]: ...
def render_frames(
    sources: Any,
    cameras: Any,
    settings: Settings | None = None,
    client: None = None,
    *,
    output: str | os.PathLike[str] | None = None,
) -> Iterator[Image] | Iterator[FrameFile]:
    """Render a sequence of frames, one after the other, as they are asked for.

    All frames share one plan, which grows by more than a frame needs where it has to: so a few are compiled for, and all others
    are not. An image is the same bits whichever frames were rendered before it.

    Args:
        sources: what to show, one a frame: scenes, functions that make one (`Snapshots.moments`), or files of particles, which
            are shown with one transfer function (`Snapshots.from_files`, whose defaults are taken). Any iterable, of which no
            more than one frame is held; or one source for all frames.
        cameras: one a frame, from any iterable (`CameraPath.cameras`); or one for all frames.
        settings: as for `jaxsph.render`, for all frames.
        client: None. Frames are rendered in this process.
        output: where to write frames instead: a folder, or a pattern such as `"frames/{:05d}.exr"` for numbers from 1 on.
            A frame whose file is there, of the same source, camera, settings and version, is not rendered again. Files are
            written whole or not at all.

    Yields:
        Images; or with `output` what was written, as `FrameFile`.

    Raises:
        ValueError: another `client`; more sources than cameras or the other way round; as `jaxsph.render`.
    """
    if client is not None:
        raise ValueError(f"`client` must be None, got {type(client).__name__}; frames are rendered in this process")
    tasks, plan = _tasks(sources, cameras, settings or Settings(), _pattern(output)), GrowingPlan(_some(cameras))
    return _images(tasks, plan) if output is None else _files(tasks, plan)


def _some(cameras: Any) -> Sequence[Camera]:
    """Cameras that are known ahead, evenly spread."""
    if not isinstance(cameras, Sequence) or len({id(camera) for camera in cameras}) < 2:
        return ()
    return [cameras[round(place)] for place in np.linspace(0, len(cameras) - 1, min(AHEAD, len(cameras)))]


def _images(tasks: Iterator[FrameTask], plan: GrowingPlan) -> Iterator[Image]:
    for task in tasks:
        yield rendered(task, task.scene(), plan)


def _files(tasks: Iterator[FrameTask], plan: GrowingPlan) -> Iterator[FrameFile]:
    """Write what is not there yet. The first frame is planned for, whether it is there or not: its choices are all frames'."""
    first = None
    for task in tasks:
        first = first or task
        scene = None if hasattr(task.source, "fingerprint") else task.scene()
        mark = task.fingerprint(scene)
        assert task.output is not None
        if fingerprint_of(task.output) == mark:
            yield FrameFile(task.number, task.output, False, {})
            continue
        if not plan.is_made and task is not first:
            plan.fits(reachable(first.scene(), first.settings), first.camera, first.settings)
        image = rendered(task, task.scene() if scene is None else scene, plan)
        marked = dataclasses.replace(image, metadata=(*image.metadata, (FINGERPRINT, mark)))
        task.output.parent.mkdir(parents=True, exist_ok=True)
        marked.save(task.output)
        yield FrameFile(task.number, task.output, True, image.stats)


def rendered(task: FrameTask, scene: Scene, plan: GrowingPlan) -> Image:
    """The image of a task."""
    scene = reachable(scene, task.settings)
    return render(scene, task.camera, task.settings, plan=plan.fits(scene, task.camera, task.settings))


def fingerprint_of(path: Path) -> str | None:
    """What a frame's file says that it was made of; None where there is none, or none that can be read to its end."""
    if not path.exists():
        return None
    try:
        return str(dict(io.read_image(path).metadata).get(FINGERPRINT))
    except (ValueError, OSError):
        return None


def _tasks(sources: Any, cameras: Any, settings: Settings, output: Callable[[int], Path] | None) -> Iterator[FrameTask]:
    if isinstance(cameras, CameraPath):
        raise ValueError("`cameras` must be cameras; take those of so many frames by `path.cameras(frames)`")
    for name, value in (("sources", sources), ("cameras", cameras)):
        if not isinstance(value, Iterable) and not _is_one(value):
            raise ValueError(
                f"`{name}` must be one of them for all frames or an iterable of one a frame, got {type(value).__name__}"
            )
    sources = Still(sources) if isinstance(sources, Scene) else _read(sources)
    one_source, one_camera = _is_one(sources), isinstance(cameras, Camera)
    if not one_source and not one_camera:
        _require_as_many(sources, cameras)
    if one_source:
        sources = [sources] if one_camera else itertools.repeat(sources)
    if one_camera:
        cameras = itertools.repeat(cameras)
    return _numbered(sources, cameras, settings, output, strict=not one_source and not one_camera)


def _numbered(
    sources: Iterable[Any], cameras: Iterable[Any], settings: Settings, output: Callable[[int], Path] | None, strict: bool
) -> Iterator[FrameTask]:
    ended = object()
    pairs = itertools.zip_longest(sources, cameras, fillvalue=ended) if strict else zip(sources, cameras, strict=False)
    for number, (source, camera) in enumerate(pairs, 1):
        if source is ended or camera is ended:
            more, fewer = ("sources", "cameras") if camera is ended else ("cameras", "sources")
            raise ValueError(f"there are more `{more}` than the {number - 1} `{fewer}`, all of which were rendered")
        yield FrameTask(number, _read(source), camera, settings, None if output is None else output(number))


def _is_one(value: Any) -> bool:
    return isinstance(value, Scene | Camera | str | os.PathLike) or callable(value)


def _read(sources: Any) -> Any:
    """Files as moments of the sequence that they are; what else there is as it is."""
    paths = [sources] if isinstance(sources, str | os.PathLike) else sources
    if not isinstance(paths, list | tuple) or not paths or not all(isinstance(path, str | os.PathLike) for path in paths):
        return sources
    snapshots = Snapshots.from_files(paths)
    moments = snapshots.moments(snapshots.times)
    return moments[0] if paths is not sources else moments


def _require_as_many(sources: Any, cameras: Any) -> None:
    numbers = [len(each) for each in (sources, cameras) if hasattr(each, "__len__")]
    if len(set(numbers)) > 1:
        raise ValueError(f"there are {numbers[0]} `sources` and {numbers[1]} `cameras`; give one of each a frame, or one for all")


def _pattern(output: str | os.PathLike[str] | None) -> Callable[[int], Path] | None:
    if output is None:
        return None
    text = os.fspath(output)
    if Path(text).suffix == "":
        return lambda number: Path(text) / f"{number:05d}.png"
    try:
        known = len({text.format(number) for number in (1, 2)}) == 2
    except (IndexError, KeyError, ValueError):
        known = False
    if not known:
        raise ValueError(
            f"`output` must be a folder, or a pattern such as 'frames/{{:05d}}.png' for the number of a frame, got {text!r}"
        )
    return lambda number: Path(text.format(number))
