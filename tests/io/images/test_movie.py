"""Movies: what a decoder finds in them, and what cannot be one."""

import subprocess

import numpy as np
import pytest
from refusals import refused

import jaxsph as js
from jaxsph.io.images import movie


def frames(count, height=32, width=48):
    for number in range(count):
        pixels = np.zeros((height, width, 3), np.uint8)
        pixels[:, : 2 + 2 * number] = 200, 40, 90
        yield pixels


def decoded(path, width, height):
    command = [movie.encoder(), "-v", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    found = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(found, np.uint8).reshape(-1, height, width, 3)


@pytest.mark.parametrize(("fps", "count"), [(24, 12), (10, 30), (29.97, 15)])
def test_a_decoder_finds_the_frames_the_duration_and_the_size(tmp_path, fps, count):
    js.io.write_movie(tmp_path / "m.mp4", frames(count), fps)
    found = js.io.movie_info(tmp_path / "m.mp4")
    assert (found.frames, found.width, found.height, found.codec, found.pixels) == (count, 48, 32, "h264", "yuv420p")
    assert found.seconds == pytest.approx(count / fps, abs=0.02) and found.fps == pytest.approx(fps, abs=0.01)


def test_colours_come_back(tmp_path):
    js.io.write_movie(tmp_path / "m.mp4", frames(10))
    back = decoded(tmp_path / "m.mp4", 48, 32)
    for number, (one, other) in enumerate(zip(back, frames(10), strict=True)):
        inside = np.abs(one.astype(int) - other)[4:-4, : max(2 * number - 4, 0)]
        assert inside.max(initial=0) < 12, number


def test_odd_sizes_are_made_even_by_black(tmp_path):
    js.io.write_movie(tmp_path / "m.mp4", [np.full((31, 47, 3), 128, np.uint8)] * 3)
    found = js.io.movie_info(tmp_path / "m.mp4")
    assert (found.width, found.height) == (48, 32)
    assert np.abs(decoded(tmp_path / "m.mp4", 48, 32)[1][8:24, 8:40].astype(int) - 128).max() < 8


@pytest.mark.parametrize(
    ("given", "fps", "said"),
    [
        ([], 24, "at least one"),
        (list(frames(1)), 0, "fps"),
        (list(frames(1)), np.inf, "fps"),
        ([*frames(1), *frames(1, 34, 48)], 24, "frame 2 is 48 x 34 and the first 48 x 32"),
        ([np.zeros((4, 4))], 24, "uint8"),
    ],
)
def test_what_is_no_movie_is_refused_and_leaves_nothing(tmp_path, given, fps, said):
    refused(said, js.io.write_movie, tmp_path / "m.mp4", given, fps)
    assert list(tmp_path.iterdir()) == []


def test_other_suffixes_and_what_is_no_movie_are_refused(tmp_path):
    refused(r"\.mp4", js.io.write_movie, tmp_path / "m.avi", frames(1))
    (tmp_path / "m.mp4").write_text("no movie")
    refused("cannot be decoded", js.io.movie_info, tmp_path / "m.mp4")
    with pytest.raises(FileNotFoundError):
        js.io.movie_info(tmp_path / "n.mp4")


def test_without_the_library_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"jaxsph\[movie\]"):
        js.io.write_movie(tmp_path / "m.mp4", frames(1))
