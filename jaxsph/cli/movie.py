"""The command `movie`: one file or a sequence of snapshots, seen by a camera that may move, as frames and an MP4 file.

Flow: files, options -> Snapshots, CameraPath, client -> render_frames -> [cli_movie] -> frames, movie, lines of text.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsph import io
from jaxsph.cli import look as cli_look
from jaxsph.cli import scene as cli_scene
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import (
    UsageError,
    camera_line,
    progress,
    refuse,
    require_writable,
    say,
    say_notes,
    say_report,
    span,
    tell_if_unseen,
    wrong_usage,
)
from jaxsph.cli.options import SCENE, replaced, require_support, settings_of
from jaxsph.io.libraries import require
from jaxsph.model import Camera, CameraPath
from jaxsph.model.camera.camera import Bounded, BoundingBox
from jaxsph.model.camera.path import middle
from jaxsph.sequence.frames import render_frames
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.sequence.survey import Reading, Survey, surveyed
from jaxsph.sequence.task import FrameFile, FramesError, Source, Still

MORE = "Frames are kept beside it, and what is there is not rendered again: the same command goes on where it was stopped."
SECONDS = 10.0
"""How long a movie is where nothing says so."""
MAX_FRAMES, MOST_DEGREES = 1_000_000, 360_000
"""What a typing error goes beyond, and no movie: 11 hours at 24 frames a second, and a thousand turns."""
DIRECTIONS = 36
"""Sides that a camera that goes around is to see all from."""
ANSWER = 30.0
"""Seconds within which a scheduler must answer."""
EVERY = 5.0
"""Seconds between two lines on what is done, where no bar is shown."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the command besides those of its source and picture, which are there already."""
    parser.set_defaults(size=None)  # so that the size in a file of key frames is taken unless another is asked for
    more = "(default: named after the first source, here); frames are in OUT_frames"
    parser.add_argument("-o", "--output", type=Path, metavar="OUT.mp4", help=more)
    group = parser.add_argument_group("movie")
    add = group.add_mutually_exclusive_group().add_argument
    add("--camera", type=Path, metavar="KEYS.json", help="key frames of the camera; times are seconds of the movie")
    add("--orbit", type=float, metavar="DEGREES", help="go around, counterclockwise as seen from above; 360 can be looped")
    add = group.add_argument
    add("--fps", type=float, default=24.0, metavar="F", help="frames a second (default 24)")
    add("--frames", type=int, metavar="N", help="(default: as long as KEYS; else 10 s, or one a snapshot if those are more)")
    add("--frame-format", choices=("png", "exr"), default="png", help="of the frames (default png)")
    add("--gaps", action="store_true", help="go on where numbers are missing in the names of a sequence")
    add("--strict", action="store_true", help="end where a file cannot be read (default: render the others)")
    add = parser.add_argument_group("several processes").add_mutually_exclusive_group().add_argument
    add("--workers", type=int, metavar="N", help="render frames by N processes of this machine, each with its share of the cores")
    add("--client", metavar="ADDRESS", help="render frames by the workers of a Dask scheduler, such as tcp://HOST:8786")


def run(options: argparse.Namespace) -> None:
    """Say what is shown, render the frames that are not there, and write the movie."""
    settings, output = settings_of(options), _checked(options)
    options = cli_where.settled(options)
    io.images.movie.encoder()
    sized, options = options.size is not None, replaced(options, size=options.size or (512, 512))
    with _client_of(options) as client:
        sources, camera, shown = _sequence(options) if len(options.source) > 1 else _still(options)
        path = _path(options, camera, shown, sized)
        number = 1 if isinstance(sources, Still) else len(sources.times) + len(sources.survey.unread)
        frames = _number_of_frames(options, path, number)
        if options.orbit is not None:
            path = _orbit(options, camera, shown, frames / options.fps)
        cameras = [camera] * frames if path is None else _OnPath(path, options.fps, frames)
        say("camera", camera_line(cameras[0], options))
        folder = output.with_name(f"{output.stem}_frames")
        pattern = folder / f"{{:05d}}.{options.frame_format}"
        at_once = 1 if client is None else max(len(client.nthreads()), 1)
        rendered = render_frames(_moments(sources, frames), cameras, settings, client, output=pattern)
        files, failed = _written(rendered, frames, folder, at_once)
        if files:
            _write(files, frames, options, cameras[0], output)
    if failed is not None:
        raise failed
    unread = () if isinstance(sources, Still) else sources.survey.unread
    if unread:
        raise ValueError(f"{len(unread)} of the snapshots cannot be read: {'; '.join(file.why for file in unread)}")


def _checked(options: argparse.Namespace) -> Path:
    """The output, once options make sense."""
    output: Path = options.output or Path(Path(options.source[0].removeprefix(SCENE)).stem + ".mp4")
    if output.suffix.lower() != ".mp4":
        raise UsageError(f"{output}: a movie must be .mp4; its frames may be EXR by --frame-format exr")
    require_writable(output, "a movie must be", (".mp4",))
    if not 0 < options.fps <= io.images.movie.MAX_FPS:
        raise UsageError(f"--fps must lie in (0, {io.images.movie.MAX_FPS:g}], got {options.fps:g}")
    if options.frames is not None and options.frames < 1:
        raise UsageError(f"--frames must be at least 1, got {options.frames}")
    if (options.frames or 0) > MAX_FRAMES:
        lasting = f"that is {options.frames / options.fps / 3600:,.4g} hours at --fps {options.fps:g}"
        raise UsageError(f"--frames must be at most {MAX_FRAMES:,}, got {options.frames:,}: {lasting}")
    if options.orbit is not None and not 0 < abs(options.orbit) <= MOST_DEGREES:
        raise UsageError(f"--orbit must be degrees other than 0, at most {MOST_DEGREES:g}, got {options.orbit:g}")
    if options.progressive:
        raise UsageError("--progressive is for one image; frames of a movie are rendered to their end")
    if len(options.source) == 1 and options.camera is None and options.orbit is None:
        raise UsageError("a movie of one source needs a camera that moves: --orbit 360 or --camera KEYS.json")
    if options.camera is not None:
        refuse(options, ("eye", "target", "fov"), "and --camera exclude each other; KEYS.json places the camera")
    if options.workers is not None and options.workers < 1:
        raise UsageError(f"--workers must be at least 1, got {options.workers}")
    return output


@contextlib.contextmanager
def _client_of(options: argparse.Namespace) -> Iterator[Any]:
    """The client that is asked for, until the block ends; None where frames are rendered by this process.

    Raises:
        ImportError: distributed is not installed.
        UsageError: no address.
        RuntimeError: a scheduler that does not answer.
    """
    if options.workers is None and options.client is None:
        yield None
        return
    distributed = require("distributed", "frames on several processes", "cluster")
    if options.workers is not None:
        from jaxsph.sequence.cluster import local_client

        with local_client(options.workers) as client:
            say("workers", f"{options.workers} processes of this machine")
            yield client
        return
    try:
        connected = distributed.Client(options.client, timeout=ANSWER, name="jaxsph")
    except (TimeoutError, OSError) as error:
        raise RuntimeError(
            f"--client {options.client}: no scheduler answers there within {ANSWER:g} s; start one by `dask scheduler`, "
            "or take --workers N for processes of this machine"
        ) from error
    except ValueError as error:
        raise UsageError(f"--client {options.client} is no address of a scheduler, such as tcp://HOST:8786 ({error})") from error
    with connected as client:
        number = len(client.nthreads())
        say("cluster", f"{options.client}, {number} workers" if number else f"{options.client}; waiting for its first worker")
        yield client


def _still(options: argparse.Namespace) -> tuple[Still, Camera, Bounded]:
    """One source, its camera, and what there is to see from all sides."""
    options = replaced(options, source=options.source[0])
    scene, camera, _ = cli_scene.scene_of(options)
    scene = dataclasses.replace(scene, within=cli_where.clip_of(options))
    if scene.parts and not scene.media:
        return Still(scene), camera, cli_where.framed(scene, options)
    near, far = float(camera.near), float(camera.far)  # media do not say how large they are: what the camera sees of depth
    wide = float(camera.half_height) * (far + near) / 2 * max(camera.width / camera.height, 1)
    center, reach = np.array(middle(camera)), max(wide, (far - near) / 2)
    return Still(scene), camera, cli_where.framed(BoundingBox(center - reach, center + reach), options)


def _sequence(options: argparse.Namespace) -> tuple[Snapshots, Camera, Bounded]:
    """The snapshots and their look, as said on the way; a camera, and what there ever is."""
    for path in options.source:
        if path.startswith(SCENE) or (Path(path).exists() and io.is_volume(path)):
            raise UsageError(f"a sequence is one of particle files, but there is {path}; give it alone")
    of_one = "particles", "frame", "iso", "volume", "points", "mix"
    refuse(options, of_one, "is not for a sequence of particle files")
    require_support(options)
    more = {**cli_where.selected(options), "opacity_by": cli_scene.opacity_by(options)}
    reading = Reading(options.quantity, options.support, options.kernel, options.part_type, **more)
    with progress("read", " files") as show, wrong_usage(of=io.ConditionError):
        try:
            survey = surveyed(options.source, reading, gaps=options.gaps, strict=options.strict, progress=show)
        except ValueError as error:
            if "missing" in str(error) and not options.gaps:
                raise ValueError(f"{error}; --gaps goes on without") from error
            raise
    _say_survey(survey)
    looks = options if options.transfer is not None else replaced(options, range=options.range or survey.span)
    transfer = cli_look.look(survey.middle, looks, survey.quantity, cli_scene.ramp_of(survey.report))
    of_range = "as asked for" if options.range else f"nearly all values of all {len(survey.files)} snapshots"
    say("", f"for all frames; range: {of_range}; extinction: by {survey.report.path}")
    center = cli_where.middle_of(survey, options)
    snapshots = Snapshots(survey, transfer, center, cli_where.clip_of(options))
    return snapshots, cli_scene.camera_of(snapshots, options), cli_where.framed(snapshots, options)


def _say_survey(survey: Survey) -> None:
    files, times = survey.files, survey.order.times
    counts = span([file.num_particles for file in files])
    say("sequence", f"{len(files)} snapshots, {files[0].path} to {files[-1].path}, {counts} particles each")
    say("times", f"{span(times)}, {survey.order.told}")
    for unread in survey.unread:
        say("unread", f"{unread.why}; frames that need it are left out")
    for sentence in survey.told():
        say("between", sentence)
    say_report(survey.report)
    say_notes(survey.report.notes)


def _moments(sources: Still | Snapshots, frames: int) -> Still | Sequence[Source]:
    """Of a sequence, evenly in time from the first snapshot to the last."""
    if isinstance(sources, Still):
        return sources
    return sources.moments(np.linspace(sources.times[0], sources.times[-1], frames).tolist())


def _path(options: argparse.Namespace, camera: Camera, shown: Bounded, sized: bool) -> CameraPath | None:
    """Key frames, if there is a file of them, of its own size unless another is asked for."""
    if options.camera is None:
        return None
    size = {"width": camera.width, "height": camera.height} if sized else {}
    return io.read_camera_path(options.camera, shown=shown, **size)


def _number_of_frames(options: argparse.Namespace, path: CameraPath | None, snapshots: int) -> int:
    if options.frames is not None:
        return int(options.frames)
    if path is not None and path.end > path.start:
        seconds = path.end - path.start
        if seconds * options.fps >= MAX_FRAMES:
            long = f"lasts {seconds:g} s, from {path.start:g} to {path.end:g}, and times are seconds of the movie"
            most = f"at --fps {options.fps:g} that is more than {MAX_FRAMES:,} frames"
            raise ValueError(f"{options.camera}: {long}: {most}; correct the times, or give --frames")
        return round(seconds * options.fps) + 1
    return max(snapshots, round(SECONDS * options.fps))


class _OnPath(Sequence[Camera]):
    """The cameras of a path, each made when it is asked for: frame k is k / fps seconds after the first key."""

    def __init__(self, path: CameraPath, fps: float, frames: int) -> None:
        self._path, self._fps, self._frames = path, fps, range(frames)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, frame: Any) -> Any:
        if isinstance(frame, slice):
            return [self[one] for one in self._frames[frame]]
        return self._path.at(self._path.start + self._frames[frame] / self._fps)


def _orbit(options: argparse.Namespace, camera: Camera, shown: Bounded, seconds: float) -> CameraPath:
    """Around the middle of all there is, or the target, from where all is in view from every side unless the eye is given.

    It ends where its next frame would begin anew.
    """
    lower, upper = shown.bounds()
    center = (lower + upper) / 2 if options.target is None else np.asarray(options.target, np.float64)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (upper - lower) + lower
    radius = float(np.linalg.norm(corners - center, axis=1).max()) or 0.5
    up = options.up or (0.0, 1.0, 0.0)
    if options.eye is None:
        camera = _all_round(camera, shown, up)
    with wrong_usage():
        return CameraPath.orbit(camera, options.orbit, center=center, radius=radius, up=up, seconds=seconds)


def _all_round(camera: Camera, shown: Bounded, up: Any) -> Camera:
    """A camera with the same line of sight, as far away as the side that needs it most asks for."""
    forward = np.array(camera.axes, np.float64)[2]
    axis = np.asarray(up, np.float64) / np.linalg.norm(up)
    how: dict[str, Any] = {"up": up, "fov_degrees": 2 * math.degrees(math.atan(float(camera.half_height)))}
    how |= {"width": camera.width, "height": camera.height}
    turns = [Rotation.from_rotvec(2 * np.pi * side / DIRECTIONS * axis).apply(forward) for side in range(DIRECTIONS)]
    center = np.mean(shown.bounds(), 0)
    views = [Camera.framing(shown, direction=direction, **how) for direction in turns]
    distance = max(float(np.linalg.norm(view.exact_eye() - center)) for view in views)
    return Camera.look_at(center - distance * forward, center, **how, near=0.5 * distance, far=2 * distance)


def _written(rendered: Iterator[FrameFile], frames: int, folder: Path, at_once: int) -> tuple[list[Path], FramesError | None]:
    """The files of all frames, of which so many are rendered at once, and what is missing; on the way, said how far it is."""
    files: list[Path] = []
    failed: FramesError | None = None
    made, started = 0, time.perf_counter()
    since = last = started  # the first of each process compiles programs, and is left out of what a frame takes
    try:
        with progress("render", " frames") as show:
            for frame in rendered:
                if frame.error is None:
                    files.append(frame.path)
                else:
                    say("failed", f"frame {frame.number}: {frame.error}")
                made += frame.rendered
                now = time.perf_counter()
                since = now if made <= at_once else since
                if show is not None:
                    show(frame.number, frames)
                elif made > at_once and (now - last > EVERY or frame.number == frames):
                    last, each = now, (now - since) / (made - at_once)
                    say("frame", f"{frame.number} of {frames}, {each:.2f} s each, {_clock(each * (frames - frame.number))} left")
    except FramesError as error:  # at the end, of those that could not be made
        failed = error
    except KeyboardInterrupt:
        say("stopped", f"{len(files)} of {frames} frames are in {folder}; the same command goes on from there")
        raise
    there = "" if made == len(files) else f", {len(files) - made} of which were there already"
    say("frames", f"{folder}, {len(files)} files{there}; {time.perf_counter() - started:.2f} s")
    return files, failed


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"


def _write(files: Sequence[Path], frames: int, options: argparse.Namespace, camera: Camera, output: Path) -> None:
    """Write the movie, and say what it shows."""
    io.write_movie(output, files, options.fps)
    padded = " and a row or column to make both even" if camera.width % 2 or camera.height % 2 else ""
    count = f"{frames} frames" if len(files) == frames else f"{len(files)} of {frames} frames"
    duration = f"{len(files) / options.fps:.4g} s at {options.fps:g} a second"
    say("movie", f"{output}, {count}, {duration}, {camera.width} x {camera.height}{padded}")
    some = {files[0], files[len(files) // 2], files[-1]}
    tell_if_unseen(options.command, output, [io.read_image(path).color for path in some])
