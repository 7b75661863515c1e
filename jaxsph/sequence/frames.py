"""Many frames: each a task of its own, one plan for all of them, files that are there already left as they are.

Flow: sources, cameras, settings -> [frames: FrameTask] -> plan -> render -> images or files.
"""

from __future__ import annotations

import itertools
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.path import CameraPath
from jaxsph.model.image import Image
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.sequence.snapshots import Moment, Snapshots, Still
from jaxsph.sequence.survey import UnreadFile
from jaxsph.sequence.task import FrameFile, FrameTask, GrowingPlan, UnwritableError, each_or_raise, rendered, unmade, written

AHEAD = 16
"""Cameras, evenly spread, that are measured with the first scene before anything is compiled: it takes milliseconds each."""


@overload
def render_frames(sources: Any, cameras: Any, settings: Settings | None = None, client: Any = None) -> Iterator[Image]: ...
@overload
def render_frames(
    sources: Any, cameras: Any, settings: Settings | None = None, client: Any = None, *, output: str | os.PathLike[str]
) -> Iterator[FrameFile]: ...
def render_frames(
    sources: Any,
    cameras: Any,
    settings: Settings | None = None,
    client: Any = None,
    *,
    output: str | os.PathLike[str] | None = None,
) -> Iterator[Image] | Iterator[FrameFile]:
    """Render a sequence of frames: one after the other, as they are asked for, or on the workers of a cluster.

    All frames share one plan, which grows by more than a frame needs where it has to: so a few are compiled for, and all others
    are not. An image is the same bits whichever frames were rendered before it.

    Args:
        sources: what to show, one a frame: scenes, functions that make one (`Snapshots.moments`), or files of particles, which
            are shown with one transfer function (`Snapshots.from_files`, whose defaults are taken). Any iterable, of which no
            more than one frame is held; or one source for all frames.
        cameras: one a frame, from any iterable (`CameraPath.cameras`); or one for all frames.
        settings: as for `jaxsph.render`, for all frames.
        client: a `distributed.Client`, whose workers render the frames: each reads what it renders, and writes it to `output`;
            without `output` images come back. Frames come in order, two a worker are on the way; they are the same bits as
            without a client. A worker that dies is replaced by its cluster, and its frames are tried again. None renders here.
        output: where to write frames instead: a folder, or a pattern such as `"frames/{:05d}.exr"` for numbers from 1 on.
            A frame whose file is there, of the same source, camera, settings and version, is not rendered again. Files are
            written whole or not at all.

    Yields:
        Images; or with `output` what was written, as `FrameFile`: one with an `error` where a frame could not be made, as its
        file is damaged. All others are made nevertheless.

    Raises:
        FramesError: with `output`, at the end: frames that could not be made. Without, an image that cannot be made raises when
            it is its turn.
        ValueError: another `client`; more sources than cameras or the other way round; a place that cannot be written to; as
            `jaxsph.render`.
    """
    _require_client(client)
    tasks = _tasks(sources, cameras, settings or Settings(), _pattern(output))
    ahead = _some(cameras)
    if client is not None:
        from jaxsph.sequence.cluster import frames_on

        frames = frames_on(client, tasks, ahead)
    elif output is None:
        plan = GrowingPlan(ahead)
        frames = (rendered(task, task.scene(), plan) for task in tasks)
    else:
        frames = _files(tasks, GrowingPlan(ahead))
    return frames if output is None else each_or_raise(frames)


def _require_client(client: Any) -> None:
    """Dask's synchronous client, known without importing it: who has one has imported it."""
    library = sys.modules.get("distributed")
    if client is None or (library is not None and isinstance(client, library.Client) and not client.asynchronous):
        return
    must = "must be a `distributed.Client` that is not asynchronous, or None to render here"
    raise ValueError(f"`client` {must}, got {type(client).__name__}")


def _some(cameras: Any) -> Sequence[Camera]:
    """Cameras that are known ahead, evenly spread."""
    if not isinstance(cameras, Sequence):
        return ()
    some = [cameras[round(place)] for place in np.linspace(0, len(cameras) - 1, min(AHEAD, len(cameras)))]
    return some if len({id(camera) for camera in some}) > 1 else ()


def _files(tasks: Iterator[FrameTask], plan: GrowingPlan) -> Iterator[FrameFile]:
    """Write what is not there yet; what cannot be made is told of."""
    for task in tasks:
        plan.first = plan.first or task
        try:
            frame = written(task, plan)
        except UnwritableError:
            raise
        except Exception as error:
            frame = unmade(task, error)
            plan.first = None if plan.first is task else plan.first
        yield frame


def _tasks(sources: Any, cameras: Any, settings: Settings, output: Callable[[int], Path] | None) -> Iterator[FrameTask]:
    if isinstance(cameras, CameraPath):
        raise ValueError("`cameras` must be cameras; take those of so many frames by `path.cameras(frames)`")
    for name, value in (("sources", sources), ("cameras", cameras)):
        if not isinstance(value, Iterable) and not _is_one(value):
            must = "must be one of them for all frames or an iterable of one a frame"
            raise ValueError(f"`{name}` {must}, got {type(value).__name__}")
    sources = Moment(Still(sources)) if isinstance(sources, Scene) else _read(sources, strict=output is None)
    one_source, one_camera = _is_one(sources), isinstance(cameras, Camera)
    if not one_source and not one_camera:
        numbers = [len(each) for each in (sources, cameras) if hasattr(each, "__len__")]
        if len(set(numbers)) > 1:
            both = f"there are {numbers[0]} `sources` and {numbers[1]} `cameras`"
            raise ValueError(f"{both}; give one of each a frame, or one for all")
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
        yield FrameTask(number, _source(source), camera, settings, None if output is None else output(number))


def _is_one(value: Any) -> bool:
    return isinstance(value, Scene | Camera | str | os.PathLike) or callable(value)


def _source(source: Any) -> Any:
    """The source of one frame; of a file that cannot be read, what says so when it is its turn."""
    try:
        return _read(source, strict=True)
    except (ValueError, OSError) as error:
        return UnreadFile(Path(source), str(error))


def _read(sources: Any, *, strict: bool) -> Any:
    """Files as moments of the sequence that they are; what else there is as it is."""
    paths = [sources] if isinstance(sources, str | os.PathLike) else sources
    if not isinstance(paths, list | tuple) or not paths or not all(isinstance(path, str | os.PathLike) for path in paths):
        return sources
    each = Snapshots.from_files(paths, strict=strict).each()
    return each[0] if paths is not sources else each


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
        must = "must be a folder, or a pattern such as 'frames/{:05d}.png' for the number of a frame"
        raise ValueError(f"`output` {must}, got {text!r}")
    return lambda number: Path(text.format(number))
