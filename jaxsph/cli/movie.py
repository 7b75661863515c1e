"""The command `movie`: one file or a sequence of snapshots, seen by a camera that may move, as frames and an MP4 file.

Flow: files, options -> Snapshots, CameraPath -> render_frames -> [cli_movie] -> frames, movie, lines of text.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsph import io, scenes
from jaxsph.cli import cluster as cli_cluster
from jaxsph.cli import frames as cli_frames
from jaxsph.cli import particles as cli_particles
from jaxsph.cli import transfer as cli_transfer
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import UsageError, camera_line, progress, say, span, tell_if_unseen
from jaxsph.cli.points import Together
from jaxsph.model import Camera, CameraPath, Scene, Settings
from jaxsph.model.camera.camera import Bounded
from jaxsph.model.camera.path import middle
from jaxsph.sequence.frames import render_frames
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.sequence.survey import Reading, Survey, UnreadFile, surveyed
from jaxsph.sequence.task import FramesError, Source, Still

MORE = "Frames are kept beside it, and what is there is not rendered again: the same command goes on where it was stopped."
SECONDS = 10.0
"""How long a movie is where nothing says so."""
MAX_FRAMES, MOST_DEGREES = 1_000_000, 360_000
"""What a typing error goes beyond, and no movie: 11 hours at 24 frames a second, and a thousand turns."""
DIRECTIONS = 36
"""Sides that a camera that goes around is to see all from."""

OneScene = Callable[[argparse.Namespace], tuple[Scene, Camera]]


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
    add(
        "--strict",
        action="store_true",
        help="end where a file cannot be read (default: render the others)",
    )
    cli_cluster.add_options(parser)


def run(options: argparse.Namespace, settings: Settings, one_scene: OneScene) -> None:
    """Say what is shown, render the frames that are not there, and write the movie."""
    output = _checked(options)
    cli_cluster.check(options)
    cli_where.settle(options)
    io.movie.encoder()
    _choose_size(options)
    with cli_cluster.client_of(options) as client:
        _run(options, settings, one_scene, output, client)


def _run(options: argparse.Namespace, settings: Settings, one_scene: OneScene, output: Path, client: Any) -> None:
    if len(options.source) > 1:
        snapshots = _sequence(options)
        shown: Bounded = cli_where.framed(snapshots, options)
        camera = _framed(shown, options)
        number = len(snapshots.times) + len(snapshots.survey.unread)
    else:
        options.source = options.source[0]
        scene, camera = one_scene(options)
        scene = cli_where.shown(scene, options)
        snapshots, shown, number = None, cli_where.framed(_shown(scene, camera), options), 1
    path = _path(options, camera, shown)
    frames = _number_of_frames(options, path, number)
    cameras = _cameras(path, options, camera, shown, frames)
    sources: Still | Sequence[Source] = Still(scene) if snapshots is None else _moments(snapshots, frames)
    say("camera", camera_line(cameras[0], options))
    folder = output.with_name(f"{output.stem}_frames")
    pattern = folder / f"{{:05d}}.{options.frame_format}"
    at_once = 1 if client is None else max(len(client.nthreads()), 1)
    rendered = render_frames(sources, cameras, settings, client, output=pattern)
    files, failed = cli_frames.written(rendered, frames, folder, at_once)
    if files:
        io.write_movie(output, files, options.fps)
        _say_movie(output, len(files), frames, options.fps, cameras[0])
        some = {files[0], files[len(files) // 2], files[-1]}
        tell_if_unseen(options.command, output, [io.read_image(path).color for path in some])
    _require_all(failed, () if snapshots is None else snapshots.survey.unread)


def _say_movie(output: Path, files: int, frames: int, fps: float, camera: Camera) -> None:
    padded = " and a row or column to make both even" if camera.width % 2 or camera.height % 2 else ""
    size = f"{camera.width} x {camera.height}{padded}"
    count = f"{frames} frames" if files == frames else f"{files} of {frames} frames"
    say("movie", f"{output}, {count}, {files / fps:.4g} s at {fps:g} a second, {size}")


def _require_all(failed: FramesError | None, unread: Sequence[UnreadFile]) -> None:
    """Raise what is missing in a movie, once it is written without."""
    if failed is not None:
        raise failed
    if unread:
        raise ValueError(f"{len(unread)} of the snapshots cannot be read: {'; '.join(file.why for file in unread)}")


def _checked(options: argparse.Namespace) -> Path:
    """The output, once options make sense."""
    output: Path = options.output or Path(Path(options.source[0].removeprefix("scene:")).stem + ".mp4")
    if output.suffix.lower() != ".mp4":
        raise UsageError(f"{output}: a movie must be .mp4; its frames may be EXR by --frame-format exr")
    if not output.parent.is_dir():
        raise ValueError(f"{output}: there is no folder {output.parent} to write it to; make it first")
    if not 0 < options.fps <= io.movie.MAX_FPS:
        raise UsageError(f"--fps must lie in (0, {io.movie.MAX_FPS:g}], got {options.fps:g}")
    if options.frames is not None and options.frames < 1:
        raise UsageError(f"--frames must be at least 1, got {options.frames}")
    if (options.frames or 0) > MAX_FRAMES:
        raise UsageError(f"--frames must be at most {MAX_FRAMES:,}, got {options.frames:,}: {_lasting(options)}")
    if options.orbit is not None and not 0 < abs(options.orbit) <= MOST_DEGREES:
        raise UsageError(f"--orbit must be degrees other than 0, at most {MOST_DEGREES:g}, got {options.orbit:g}")
    if options.progressive:
        raise UsageError("--progressive is for one image; frames of a movie are rendered to their end")
    if len(options.source) == 1 and options.camera is None and options.orbit is None:
        raise UsageError("a movie of one source needs a camera that moves: --orbit 360 or --camera KEYS.json")
    placed = [name for name in ("eye", "target", "fov") if getattr(options, name) is not None]
    if options.camera is not None and placed:
        raise UsageError(f"--{placed[0]} and --camera exclude each other; KEYS.json places the camera")
    return output


def _lasting(options: argparse.Namespace) -> str:
    hours = options.frames / options.fps / 3600
    return f"that is {hours:,.4g} hours at --fps {options.fps:g}"


def _choose_size(options: argparse.Namespace) -> None:
    """The size asked for, else that of the file of key frames, else 512 x 512."""
    options.sized = options.size is not None
    options.size = options.size or (512, 512)


def _sequence(options: argparse.Namespace) -> Snapshots:
    """The snapshots and their look, as said on the way."""
    for path in options.source:
        if path.startswith("scene:") or (Path(path).exists() and io.is_volume(path)):
            raise UsageError(f"a sequence is one of particle files, but there is {path}; give it alone")
    for name in ("particles", "frame", "iso", "volume", "points", "mix"):
        if getattr(options, name, None) is not None:
            raise UsageError(f"--{name} is not for a sequence of particle files")
    if options.support is not None and not (np.isfinite(options.support) and options.support > 0):
        raise UsageError(f"--support must be > 0, got {options.support:g}")
    more = {**cli_where.selected(options), "opacity_by": cli_particles.opacity_by(options)}
    reading = Reading(options.quantity, options.support, options.kernel, options.part_type, **more)
    with progress("read", " files") as show, cli_where.conditions():
        survey = _surveyed(options, reading, show)
    _say_survey(survey)
    asked = options.range
    if options.transfer is None:
        options.range = options.range or survey.span
    transfer = cli_transfer.look(survey.middle, options, survey.quantity, cli_particles.ramp_of(survey.report))
    of_range = "as asked for" if asked else f"nearly all values of all {len(survey.files)} snapshots"
    say("", f"for all frames; range: {of_range}; extinction: by {survey.report.path}")
    center = cli_where.middle_of(survey, options)
    return Snapshots(survey, transfer, center, cli_where.clip_of(options))


def _surveyed(options: argparse.Namespace, reading: Reading, show: Callable[[int, int], None] | None) -> Survey:
    try:
        return surveyed(options.source, reading, gaps=options.gaps, strict=options.strict, progress=show)
    except ValueError as error:
        if "missing" in str(error) and not options.gaps:
            raise ValueError(f"{error}; --gaps goes on without") from error
        raise


def _say_survey(survey: Survey) -> None:
    files, times = survey.files, survey.order.times
    counts = span([file.num_particles for file in files])
    say("sequence", f"{len(files)} snapshots, {files[0].path} to {files[-1].path}, {counts} particles each")
    say("times", f"{span(times)}, {survey.order.told}")
    for unread in survey.unread:
        say("unread", f"{unread.why}; frames that need it are left out")
    for sentence in survey.told():
        say("between", sentence)
    say("support", survey.report.support)
    say("volume", survey.report.volume)
    say("kernel", survey.report.kernel)
    for note in survey.report.notes:
        say("note", note)


def _shown(scene: Scene, camera: Camera) -> Bounded:
    """The box around all parts of a scene or, where parts do not say how large they are, around what the camera sees of depth."""
    parts: list[Bounded] = [volume for volume, _ in scene.volumes] + list(scene.point_sets)
    parts += [] if scene.particles is None else [scene.particles]
    if parts and not scene.media:
        return Together([("", part) for part in parts])
    near, far = float(camera.near), float(camera.far)
    wide = float(camera.half_height) * (far + near) / 2 * max(camera.width / camera.height, 1)
    return _Box(np.array(middle(camera)), max(wide, (far - near) / 2))


@dataclasses.dataclass(frozen=True)
class _Box:
    middle: np.ndarray
    reach: float

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        return self.middle - self.reach, self.middle + self.reach


def _framed(shown: Bounded, options: argparse.Namespace) -> Camera:
    """The camera asked for, or one that frames all that there ever is."""
    width, height = options.size
    up, fov = options.up or (0.0, 1.0, 0.0), options.fov or 45.0
    try:
        if options.eye is None:
            if options.target is not None:
                raise UsageError("--target needs --eye: from where should it be looked at?")
            return Camera.framing(shown, up=up, fov_degrees=fov, width=width, height=height)
        lower, upper = shown.bounds()
        target = (lower + upper) / 2 if options.target is None else options.target
        made = Camera.look_at(options.eye, target, up, fov, width, height, near=1e-3, far=1.0)
        return scenes.view.snug_box(made, lower, upper)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _path(options: argparse.Namespace, camera: Camera, shown: Bounded) -> CameraPath | None:
    """Key frames, if there is a file of them."""
    if options.camera is None:
        return None
    size = {"width": camera.width, "height": camera.height} if options.sized else {}
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


def _cameras(
    path: CameraPath | None, options: argparse.Namespace, camera: Camera, shown: Bounded, frames: int
) -> Sequence[Camera]:
    """One a frame: frame k is k / fps seconds after the first key; an orbit ends where its next frame would begin anew."""
    if path is None and options.orbit is None:
        return [camera] * frames
    if path is None:
        path = _orbit(options, camera, shown, frames / options.fps)
    return _OnPath(path, options.fps, frames)


class _OnPath(Sequence[Camera]):
    """The cameras of a path, each made when it is asked for."""

    def __init__(self, path: CameraPath, fps: float, frames: int) -> None:
        self._path, self._fps, self._frames = path, fps, range(frames)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, frame: Any) -> Any:
        if isinstance(frame, slice):
            return [self[one] for one in self._frames[frame]]
        return self._path.at(self._path.start + self._frames[frame] / self._fps)


def _orbit(options: argparse.Namespace, camera: Camera, shown: Bounded, seconds: float) -> CameraPath:
    """Around the middle of all there is, or the target, from where all is in view from every side unless the eye is given."""
    lower, upper = shown.bounds()
    center = (lower + upper) / 2 if options.target is None else np.asarray(options.target, np.float64)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * (upper - lower) + lower
    radius = float(np.linalg.norm(corners - center, axis=1).max()) or 0.5
    up = options.up or (0.0, 1.0, 0.0)
    if options.eye is None:
        camera = _all_round(camera, shown, up)
    try:
        return CameraPath.orbit(camera, options.orbit, center=center, radius=radius, up=up, seconds=seconds)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _all_round(camera: Camera, shown: Bounded, up: Any) -> Camera:
    """A camera with the same line of sight, as far away as the side that needs it most asks for."""
    forward = np.array(camera.axes, np.float64)[2]
    axis = np.asarray(up, np.float64) / np.linalg.norm(up)
    how = {"up": up, "fov_degrees": 2 * math.degrees(math.atan(float(camera.half_height)))}
    how |= {"width": camera.width, "height": camera.height}
    turns = [Rotation.from_rotvec(2 * np.pi * side / DIRECTIONS * axis).apply(forward) for side in range(DIRECTIONS)]
    lower, upper = shown.bounds()
    center = (lower + upper) / 2
    views = [Camera.framing(shown, direction=direction, **how) for direction in turns]
    distance = max(float(np.linalg.norm(view.exact_eye() - center)) for view in views)
    width, height = camera.width, camera.height
    eye = center - distance * forward
    return Camera.look_at(eye, center, up, how["fov_degrees"], width, height, near=0.5 * distance, far=2 * distance)


def _moments(snapshots: Snapshots, frames: int) -> Sequence[Source]:
    """Evenly in time from the first snapshot to the last."""
    return snapshots.moments(np.linspace(snapshots.times[0], snapshots.times[-1], frames).tolist())
