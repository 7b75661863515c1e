"""Movies: H.264 in an MP4 file that any player shows, of frames that are images or files of images.

Flow: frames -> [movie] -> MP4 file.

Colours are display-referred, as in PNG files, and become Y'CbCr by ITU-R BT.709 at a quarter of the resolution in colour
(yuv420p), said in the file. That needs even sizes: an odd one is made even by a black row below or column to the right.
"""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import tempfile
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxsph.io.damage import DataError, regular_file, require
from jaxsph.io.images.image_files import read_image
from jaxsph.io.replace import known_suffix, written_whole
from jaxsph.model.image import Image

SUFFIX = ".mp4"
PURPOSE, EXTRA = "writing movies", "movie"
MAX_FPS = 1000.0
CODING = ("-c:v", "libx264", "-crf", "17", "-preset", "medium")  # at this rate factor differences to the frames are hard to see
CONVERSION = ("-vf", "scale=in_range=full:out_range=limited:out_color_matrix=bt709,format=yuv420p")
TAGS = ("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv")
PLAYABLE = ("-movflags", "+faststart")
MAX_DENOMINATOR = 10_000  # of a rate: 24000/1001 is one


class MovieInfo(NamedTuple):
    """What a decoder finds in a movie: frames, seconds, frames a second, size in pixels, codec, and format of pixels."""

    frames: int
    seconds: float
    fps: float
    width: int
    height: int
    codec: str
    pixels: str


def encoder() -> str:
    """The program that encodes and decodes, of `imageio-ffmpeg`; `ImportError` says how to install it."""
    return str(require("imageio_ffmpeg", PURPOSE, EXTRA).get_ffmpeg_exe())


def write_movie(path: str | os.PathLike[str], frames: Iterable[Any], fps: float = 24.0) -> None:
    """Write frames to `path`, an `.mp4`, whole or not at all.

    Args:
        path: the file.
        frames: images, (H, W, 3) arrays of uint8, or paths of `.png` and `.exr` files, all of one size; each is asked for when
            it is its turn.
        fps: frames a second.

    Raises:
        ValueError: another suffix, no frames, frames of different sizes, a rate that is not in (0, 1000], a place that cannot
            be written to.
        ImportError: `imageio-ffmpeg` is not installed.
    """
    file = Path(path)
    encoder()
    known_suffix(file, [SUFFIX], "movies are written as")
    if not 0 < fps <= MAX_FPS:
        raise ValueError(f"`fps` must lie in (0, {MAX_FPS:g}], got {fps}")
    pixels = map(_pixels, frames)
    first = next(pixels, None)
    if first is None:
        raise ValueError("`frames` must be at least one, got none")
    with written_whole(file) as temporary:
        _encode(temporary, _even(first), map(_even, pixels), fps)


def movie_info(path: str | os.PathLike[str]) -> MovieInfo:
    """What a decoder finds in a movie, all of which is decoded.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no movie.
        ImportError: `imageio-ffmpeg` is not installed.
    """
    program, file = encoder(), regular_file(path)
    command = [program, "-nostdin", "-i", str(file), "-map", "0:v:0", "-progress", "pipe:1", "-f", "null", "-"]
    found = subprocess.run(command, capture_output=True, text=True, errors="replace")
    counts = re.findall(r"^frame=(\d+)", found.stdout, re.MULTILINE)
    times = re.findall(r"Duration: (\d+):(\d+):([\d.]+)", found.stderr)
    streams = re.findall(r"Video: (\w+).*?, (\w+)[(,].*?, (\d+)x(\d+).*?, ([\d.]+) fps", found.stderr)
    if found.returncode or not (counts and times and streams):
        raise DataError(f"{file}: cannot be decoded as a movie; it is damaged or of another kind")
    (hours, minutes, seconds), (codec, pixels, width, height, fps) = times[0], streams[0]
    duration = 3600 * int(hours) + 60 * int(minutes) + float(seconds)
    return MovieInfo(int(counts[-1]), duration, float(fps), int(width), int(height), codec, pixels)


def _encode(path: Path, first: np.ndarray, others: Iterable[np.ndarray], fps: float) -> None:
    height, width, _ = first.shape
    rate = str(Fraction(fps).limit_denominator(MAX_DENOMINATOR))
    given = ("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", rate, "-i", "-")
    command = [encoder(), "-y", "-v", "error", *given, "-an", *CODING, *CONVERSION, *TAGS, *PLAYABLE, str(path)]
    with tempfile.TemporaryFile() as said:
        group = 0 if os.name == "posix" else None  # one of its own, so that an interrupt is ours to handle
        pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": said}
        process = subprocess.Popen(command, **pipes, process_group=group)
        assert process.stdin is not None
        try:
            for number, frame in enumerate(itertools.chain([first], others), 1):
                if frame.shape != first.shape:
                    sizes = [f"{shape[1]} x {shape[0]}" for shape in (frame.shape, first.shape)]
                    what = f"frame {number} is {sizes[0]} and the first {sizes[1]}"
                    raise ValueError(f"frames of a movie must be of one size, but {what}")
                process.stdin.write(np.ascontiguousarray(frame).data)
            process.stdin.close()
        except BrokenPipeError:  # why is in what it said
            pass
        except BaseException:
            process.kill()
            raise
        finally:
            code = process.wait()
        if code:
            said.seek(0)
            reason = " ".join(said.read().decode(errors="replace").split())
            raise ValueError(f"the movie could not be encoded: {reason or f'the encoder ended with {code}'}")


def _pixels(frame: Any) -> UInt8[np.ndarray, "height width 3"]:
    if isinstance(frame, str | os.PathLike):
        frame = read_image(frame)
    if isinstance(frame, Image):
        return frame.to_uint8()
    array = np.asarray(frame)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
        raise ValueError(f"a frame must be an image, a path, or (H, W, 3) uint8, got {array.dtype} of shape {array.shape}")
    return array


def _even(pixels: np.ndarray) -> np.ndarray:
    return np.pad(pixels, [(0, pixels.shape[0] % 2), (0, pixels.shape[1] % 2), (0, 0)])
