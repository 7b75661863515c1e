"""Movies: H.264 in an MP4 file that any player shows, of frames that are images or files of images.

Flow: frames -> [movie] -> MP4 file.

Colours are display-referred, as in PNG files, and become Y'CbCr by ITU-R BT.709 at a quarter of the resolution in colour
(yuv420p), said in the file. That needs even sizes: an odd one is made even by a black row below or column to the right.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from jaxsph.model.image import Image

from .damage import DataError
from .optional import require
from .replace import written_whole

SUFFIX = ".mp4"
PURPOSE, EXTRA = "writing movies", "movie"
MAX_FPS = 1000.0
QUALITY = 6.5  # of ten: a rate factor of 17 of x264, at which differences to the frames are hard to see
TAGS = ("-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709", "-color_range", "tv")
CONVERSION = ("-vf", "scale=in_range=full:out_range=limited:out_color_matrix=bt709,format=yuv420p")
PLAYABLE = ("-movflags", "+faststart")


class MovieInfo(NamedTuple):
    """What a decoder finds in a movie: frames, seconds, frames a second, and pixels a row and a column."""

    frames: int
    seconds: float
    fps: float
    width: int
    height: int


def require_movie_library() -> Any:
    """`imageio_ffmpeg`, which brings an encoder; `ImportError` says how to install it."""
    return require("imageio_ffmpeg", PURPOSE, EXTRA)


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
    file, library = Path(path), require_movie_library()
    if file.suffix.lower() != SUFFIX:
        raise ValueError(f"{file}: movies are written as {SUFFIX}, not as {file.suffix!r}")
    if not 0 < fps <= MAX_FPS:
        raise ValueError(f"`fps` must lie in (0, {MAX_FPS:g}], got {fps}")
    pixels = map(_pixels, frames)
    first = next(pixels, None)
    if first is None:
        raise ValueError("`frames` must be at least one, got none")
    with written_whole(file) as temporary:
        size = _even(first).shape[1::-1]
        options = {"pix_fmt_in": "rgb24", "pix_fmt_out": "yuv420p", "fps": fps, "quality": QUALITY, "macro_block_size": 1}
        more = [*CONVERSION, *TAGS, *PLAYABLE]
        writer = library.write_frames(str(temporary), size, **options, ffmpeg_log_level="error", output_params=more)
        try:
            writer.send(None)
            _send(writer, first, pixels)
        finally:
            writer.close()
        if not temporary.stat().st_size:
            raise ValueError(f"{file}: the encoder has written nothing; is there room on the disk?")


def movie_info(path: str | os.PathLike[str]) -> MovieInfo:
    """What a decoder finds in a movie, all of which is decoded.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no movie.
        ImportError: `imageio-ffmpeg` is not installed.
    """
    file, library = Path(path), require_movie_library()
    if not file.exists():
        raise FileNotFoundError(f"{file}: there is no such file")
    try:
        reader = library.read_frames(str(file))
        known = next(reader)
        frames = sum(1 for _ in reader)
    except (OSError, RuntimeError, StopIteration) as error:
        raise DataError(f"{file}: cannot be decoded as a movie") from error
    width, height = known["size"]
    return MovieInfo(frames, float(known["duration"]), float(known["fps"]), int(width), int(height))


def _send(writer: Any, first: np.ndarray, others: Iterable[np.ndarray]) -> None:
    writer.send(np.ascontiguousarray(_even(first)))
    for number, frame in enumerate(others, 2):
        if frame.shape != first.shape:
            sizes = (f"{shape[1]} x {shape[0]}" for shape in (frame.shape, first.shape))
            raise ValueError("frames of a movie must be of one size, but frame {} is {} and the first {}".format(number, *sizes))
        writer.send(np.ascontiguousarray(_even(frame)))


def _pixels(frame: Any) -> UInt8[np.ndarray, "height width 3"]:
    if isinstance(frame, str | os.PathLike):
        from jaxsph import io

        frame = io.read_image(frame)
    if isinstance(frame, Image):
        return frame.to_uint8()
    array = np.asarray(frame)
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] != 3:
        raise ValueError(f"a frame must be an image, a path, or (H, W, 3) uint8, got {array.dtype} of shape {array.shape}")
    return array


def _even(pixels: np.ndarray) -> np.ndarray:
    return np.pad(pixels, [(0, pixels.shape[0] % 2), (0, pixels.shape[1] % 2), (0, 0)])
