"""The command `movie`: one file or a sequence of snapshots, seen by a camera that may move, as frames and an MP4 file.

Flow: files, options -> Snapshots, CameraPath, client -> render_frames -> [movie] -> frames, movie, lines of text.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import itertools
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxsph import io
from jaxsph.cli import console, figures, groups, scene as cli_scene, voice
from jaxsph.cli.console import UsageError, wrong_usage
from jaxsph.cli.groups import MEANS, OUTPUT, OWN, as_medium, offered, output
from jaxsph.cli.voice import say
from jaxsph.io import Labels
from jaxsph.io.damage import require
from jaxsph.io.images.movie import MAX_FPS, encoder
from jaxsph.io.opening import values
from jaxsph.io.opening.opened import Opened
from jaxsph.io.opening.options import CAMERA, Look, Source, View, choice, flag, option
from jaxsph.io.opening.views import left_by
from jaxsph.io.replace import refuse_input
from jaxsph.model.camera.camera import Bounded, BoundingBox, Camera
from jaxsph.model.camera.directions import corners_of
from jaxsph.model.camera.path import CameraPath, middle
from jaxsph.model.preview.frame import bulk_of_period
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.plot.image_figure import image_figure
from jaxsph.sequence.frames import render_frames
from jaxsph.sequence.task import FrameFile, FramesError

SECONDS, FPS = 10.0, 24.0  # how long a movie of one source is where nothing says so, and its frames a second
SLOW = 4.0  # seconds that a movie with a frame a file lasts at least, unless asked for
MAX_FRAMES, MOST_DEGREES = 1_000_000, 360_000
"""What a typing error goes beyond, and no movie: 11 hours at 24 frames a second, and a thousand turns."""
FRAMES_A_SECOND = values.read_as(f"a number in (0, {MAX_FPS:g}]", float, lambda fps: 0 < fps <= MAX_FPS)
TURN = values.read_as(f"degrees other than 0, at most {MOST_DEGREES:g}", float, lambda turn: 0 < abs(turn) <= MOST_DEGREES)
DIRECTIONS = 36  # sides that a camera that goes around is to see all from
MARGIN = 1.05  # of a picture in parallel rays over what is in it
ANSWER = 30.0  # seconds within which a scheduler must answer
EVERY = 5.0  # seconds between two lines on what is done, where no bar is shown


@offered(without="draft panels difference contours")
class Movie(groups.Options, groups.Quality, groups.Key, Look, View, groups.Beside, Source):
    """Options of the command."""

    size: Any = option(None, "WxH", values.size, CAMERA, "pixels (default: those of KEYS, else 512x512)")
    output: Path | None = output("(default: named after the first source, here); frames are in OUT_frames", "OUT.mp4")
    camera: Any = option(None, "KEYS.json", Path, OWN, "key frames of the camera; times are seconds of the movie")
    orbit: float | None = option(None, "DEGREES", TURN, OWN, "go around, counterclockwise as seen from above")
    fps: float | None = option(None, "F", FRAMES_A_SECOND, OWN, f"frames a second (default {FPS:g}; fewer of a few files)")
    frames: int | None = option(None, "N", values.count(1), OWN, "(default: as long as KEYS; else one a file, of one file 10 s)")
    frame_format: str | None = choice(None, ("png", "exr"), OUTPUT, "of the frames", " (default png; exr for --background)")
    gaps: bool = flag(OWN, "go on where numbers are missing in the names of a sequence")
    strict: bool = flag(OWN, "end where a file cannot be read (default: render the others)")
    workers: int | None = option(None, "N", values.count(1), MEANS, "render frames by N processes of this machine")
    client: str | None = option(None, "ADDRESS", str, MEANS, "by the workers of a Dask scheduler, such as tcp://HOST:8786")

    def timing(self, path: CameraPath | None, files: int) -> tuple[int, float]:
        """How many frames, and how many a second: those that are asked for, or as the path or files of a sequence have."""
        fps = self.fps or FPS
        if self.frames is not None:
            return self.frames, fps
        if path is not None and path.end > path.start:
            seconds = path.end - path.start
            if seconds * fps >= MAX_FRAMES:
                long = f"lasts {seconds:g} s, from {path.start:g} to {path.end:g}, and times are seconds of the movie"
                most = f"at --fps {fps:g} that is more than {MAX_FRAMES:,} frames"
                raise ValueError(f"{self.camera}: {long}: {most}; correct the times, or give --frames")
            return round(seconds * fps) + 1, fps
        if not files:
            return round(SECONDS * fps), fps
        fps = self.fps or min(max(files / SLOW, 1.0), FPS)
        say("frames", f"{files}, one a file, {fps:g} a second; --frames N has others between them, --fps F is faster or slower")
        return files, fps


def movie(*files: Annotated[str, groups.FRAMES], asked: Movie = Movie()) -> None:
    """Say what is shown, render the frames that are not there, and write the movie.

    Frames are kept beside it, and what is there is not rendered again: the same command goes on where it was stopped.
    """
    if not files:
        raise UsageError("a file, a sequence of files or scene:NAME is needed as FILE")
    options = dataclasses.replace(asked, source=list(files))
    settings, output = groups.settings_of(options), _checked(options)
    options = as_medium(options, settings)
    encoder()
    with _client_of(options) as client:
        unread, failed = _produced(options, settings, client, output)
    if failed is not None:
        raise failed
    if unread:
        raise ValueError(f"{len(unread)} of the snapshots cannot be read: {'; '.join(file.why for file in unread)}")


def _produced(options: Any, settings: Settings, client: Any, output: Path) -> tuple[Sequence[Any], FramesError | None]:
    """Make the movie; which snapshots could not be read, and which frames could not be made."""
    sized, options = options.size is not None, dataclasses.replace(options, size=options.size or (512, 512))
    each: Sequence[Any] = ()
    unread: Sequence[Any] = ()
    if len(options.source) > 1:
        sources, opened, shown = cli_scene.snapshots_of(options, gaps=options.gaps, strict=options.strict)
        each, unread, told = sources.each(), sources.survey.unread, cli_scene.labels_of_sequence(sources, options)
    else:
        opened, shown = _still(options)
    cameras, fps = _cameras(options, opened, shown, len(each), sized)
    moments: Any = opened.scene
    labels: Iterable[Labels] = itertools.repeat(opened.labels)
    if each:
        if options.frames is not None or options.camera is not None:  # evenly in time from the first to the last
            each = sources.moments(np.linspace(sources.times[0], sources.times[-1], len(cameras)).tolist())
        moments, labels = each, [told(getattr(one, "time", None)) for one in each]
    opened, failed = dataclasses.replace(opened, camera=cameras[0]), []

    def make() -> figures.Made:
        voice.release()
        folder = output.with_name(f"{output.stem}_frames")
        suffix = options.frame_format or ("png" if options.background is None else "exr")
        for frame in folder.glob(f"*.{suffix}"):
            refuse_input(frame)
        at_once = 1 if client is None else max(len(client.nthreads()), 1)
        rendered = render_frames(moments, cameras, settings, client, output=folder / f"{{:05d}}.{suffix}")
        files, error, is_told = _written(rendered, len(cameras), folder, at_once, options)
        if not files and error is not None:
            raise error
        failed.append(error)
        placed = list(zip(cameras, labels, strict=False)) if figures.has_key(options) else []
        pictures = (_pictured(frame, opened.scene, placed, figures.style_of(options)) for frame in files)
        first = next(pictures)
        tall, wide = first.shape[:2]
        padded = " and a row or column to make both even" if wide % 2 or tall % 2 else ""
        count = f"{len(files)} of " * (len(files) < len(cameras)) + f"{len(cameras)} frames"
        about = "movie", f"{count}, {len(files) / fps:.4g} s at {fps:g} a second, {wide} x {tall}{padded}"
        some = [] if is_told else [io.read_image(frame.path).color for frame in (files[0], files[len(files) // 2], files[-1])]
        results = {"frames": len(files), "of": len(cameras), "fps": fps}
        frames = itertools.chain([first], pictures)
        return figures.Made(frames, about, results=results, colors=some, save=lambda one, path: io.write_movie(path, one, fps))

    figures.produce(options, output, opened, make)
    return unread, failed[0]


def _pictured(frame: FrameFile, scene: Scene, placed: Sequence[tuple[Camera, Labels]], style: dict[str, Any]) -> np.ndarray:
    """What the movie has of a frame: as it is on disk, over the background; or, where cameras and labels are known, a figure."""
    image = io.read_image(frame.path)
    if not placed:
        background = style.get("background")
        return image.to_uint8() if background is None else (image.over(background) * 255 + 0.5).astype(np.uint8)
    camera, labels = placed[frame.number - 1]
    figure = image_figure(image, scene, camera, labels=labels, **style)
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    return np.pad(picture, [(0, picture.shape[0] % 2), (0, picture.shape[1] % 2), (0, 0)], "edge")


def _cameras(options: Any, seen: Opened, shown: Bounded, files: int, sized: bool) -> tuple[Sequence[Camera], float]:
    """One a frame, and frames a second."""
    camera, path = seen.camera, None
    if options.camera is not None:
        size = {"width": camera.width, "height": camera.height} if sized else {}  # else that of the file
        path = io.read_camera_path(options.camera, shown=shown, **size)
    frames, fps = options.timing(path, files)
    if options.orbit is not None:
        path = _orbit(options, seen, shown, frames / fps)
    return [camera if path is None else path.at(path.start + frame / fps) for frame in range(frames)], fps


def _checked(options: Any) -> Path:
    """The output, once options make sense."""
    output: Path = options.output or Path(f"{Path(console.stem_of(options.source[0])).stem}.mp4")
    console.require_writable(output, "frames may be EXR by --frame-format exr, a movie must be", (".mp4",))
    if (options.frames or 0) > MAX_FRAMES:
        fps = options.fps or FPS
        lasting = f"that is {options.frames / fps / 3600:,.4g} hours at --fps {fps:g}"
        raise UsageError(f"--frames must be at most {MAX_FRAMES:,}, got {options.frames:,}: {lasting}")
    if options.background == "transparent":
        raise UsageError("--background transparent is for pictures, and a movie holds no transparency: give a colour")
    if figures.has_key(options):
        figures.require_figure(output, (".mp4",))
    if len(options.source) == 1 and options.camera is None and options.orbit is None:
        raise UsageError("a movie of one source needs a camera that moves: --orbit 360 or --camera KEYS.json")
    return output


@contextlib.contextmanager
def _client_of(options: Any) -> Iterator[Any]:
    """The client that is asked for, until the block ends; None where frames are rendered by this process."""
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


def _still(options: Any) -> tuple[Opened, Bounded]:
    """One source, how it is seen, and what there is to see."""
    options = dataclasses.replace(options, source=options.source[0])
    cli_scene.require_something(options)
    opened = cli_scene.opened_of(options)
    scene, camera = opened.scene, opened.camera
    shown: Bounded = bulk_of_period(scene) or scene
    if not scene.parts or scene.media:  # media do not say how large they are: what the camera sees of depth
        near, far = float(camera.near), float(camera.far)
        wide = float(camera.half_height) * (far + near) / 2 * max(camera.width / camera.height, 1)
        center, reach = np.array(middle(camera)), max(wide, (far - near) / 2)
        shown = BoundingBox(center - reach, center + reach)
    return opened, left_by(scene.within, shown)


def _orbit(options: Any, seen: Opened, shown: Bounded, seconds: float) -> CameraPath:
    """Around all there is, from where all of it is in view from every side; around a given middle as near as its picture is."""
    camera, up = seen.camera, seen.up
    around = np.mean(shown.bounds(), 0) if seen.center is None else np.asarray(seen.center, np.float64)
    radius = float(np.linalg.norm(corners_of(*shown.bounds()) - around, axis=1).max()) or 0.5
    if (clip := seen.scene.within) is not None:  # a ball in its box
        depths = [np.subtract(clip.ends(turn, *shown.bounds()), turn @ around) for turn in _turns(camera, up)]
        radius = min(radius, float(np.abs(depths).max()))
    if seen.center is None:
        camera = _all_round(camera, shown, up)
    with wrong_usage():
        return CameraPath.orbit(camera, options.orbit, center=around, radius=radius, up=up, seconds=seconds)


def _all_round(camera: Camera, shown: Bounded, up: Any) -> Camera:
    """A camera with the same line of sight, as far away as the side that needs it most asks for."""
    forward = np.array(camera.axes, np.float64)[2]
    how: dict[str, Any] = {"up": up, "width": camera.width, "height": camera.height}
    center = np.mean(shown.bounds(), 0)
    if not camera.is_perspective:
        tall = MARGIN * float(np.linalg.norm(np.ptp(shown.bounds(), 0))) * max(1, camera.height / camera.width)
        return Camera.orthographic(center - tall * forward, center, view_height=tall, near=0.5 * tall, far=1.5 * tall, **how)
    how["fov_degrees"] = 2 * math.degrees(math.atan(float(camera.half_height)))
    views = [Camera.framing(shown, direction=direction, **how) for direction in _turns(camera, up)]
    distance = max(float(np.linalg.norm(view.exact_eye() - center)) for view in views)
    return Camera.look_at(center - distance * forward, center, **how, near=0.5 * distance, far=2 * distance)


def _turns(camera: Camera, up: Any) -> list[np.ndarray]:
    """Lines of sight of a camera that goes around."""
    forward, axis = np.array(camera.axes, np.float64)[2], np.asarray(up, np.float64) / np.linalg.norm(up)
    return [Rotation.from_rotvec(2 * np.pi * side / DIRECTIONS * axis).apply(forward) for side in range(DIRECTIONS)]


def _written(
    rendered: Iterator[FrameFile], frames: int, folder: Path, at_once: int, options: Any
) -> tuple[list[FrameFile], FramesError | None, bool]:
    """All frames, what is missing, and whether the first shows next to nothing, told at once; how far it is, said on the way."""
    files: list[FrameFile] = []
    failed: FramesError | None = None
    made, told, started = 0, False, time.perf_counter()
    since = last = started  # the first of each process compiles programs, and is left out of what a frame takes
    try:
        with console.progress("render", " frames") as show:
            for frame in rendered:
                if frame.error is None:
                    files.append(frame)
                else:
                    say("failed", f"frame {frame.number}: {frame.error}")
                if len(files) == 1 and frame.rendered:
                    told = console.tell_if_unseen(options.command, frame.path, [io.read_image(frame.path).color])
                made += frame.rendered
                now = time.perf_counter()
                since = now if made <= at_once else since
                if show is not None:
                    show(frame.number, frames)
                elif made > at_once and (now - last > EVERY or frame.number == frames):
                    last, each = now, (now - since) / (made - at_once)
                    left = datetime.timedelta(seconds=round(each * (frames - frame.number)))
                    say("frame", f"{frame.number} of {frames}, {each:.2f} s each, {left} left")
    except FramesError as error:  # at the end, of those that could not be made
        failed = error
    except KeyboardInterrupt:
        say("stopped", f"{len(files)} of {frames} frames are in {folder}; the same command goes on from there")
        raise
    there = "" if made == len(files) else f", {len(files) - made} of which were there already"
    say("frames", f"{folder}, {len(files)} files{there}; {time.perf_counter() - started:.2f} s")
    return files, failed, told
