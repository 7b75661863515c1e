"""Frames as they are written, told on the command line: how far it is, how long it will take, and what could not be made.

Flow: render_frames -> [cli_frames] -> files, lines of text -> movie.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

from jaxsph.cli.console import progress, say
from jaxsph.sequence.task import FrameFile, FramesError

EVERY = 5.0
"""Seconds between two lines on what is done, where no bar is shown."""


def written(rendered: Iterator[FrameFile], frames: int, folder: Path, at_once: int = 1) -> tuple[list[Path], FramesError | None]:
    """The files of all frames, of which so many are rendered at once, and what is missing; on the way, said how far it is."""
    files: list[Path] = []
    failed: FramesError | None = None
    made, started = 0, time.perf_counter()
    try:
        with progress("render", " frames") as show:
            pace = _Pace(frames, at_once, show)
            for frame in _until_failure(rendered):
                if isinstance(frame, FramesError):
                    failed = frame
                    continue
                if frame.error is None:
                    files.append(frame.path)
                else:
                    say("failed", f"frame {frame.number}: {frame.error}")
                made += frame.rendered
                pace.tell(frame.number, made)
    except KeyboardInterrupt:
        say("stopped", f"{len(files)} of {frames} frames are in {folder}; the same command goes on from there")
        raise
    there = "" if made == len(files) else f", {len(files) - made} of which were there already"
    say("frames", f"{folder}, {len(files)} files{there}; {time.perf_counter() - started:.2f} s")
    return files, failed


def _until_failure(rendered: Iterator[FrameFile]) -> Iterator[FrameFile | FramesError]:
    """All frames, and at the end what is raised of those that could not be made."""
    try:
        yield from rendered
    except FramesError as error:
        yield error


class _Pace:
    """How long a frame takes, and how long all others will."""

    def __init__(self, frames: int, at_once: int, show: Callable[[int, int], None] | None) -> None:
        self._frames, self._at_once, self._show = frames, at_once, show
        self._since = self._last = time.perf_counter()  # the first of each process compiles programs, and is left out

    def tell(self, done: int, made: int) -> None:
        """Tell a bar, or say it every few seconds."""
        now = time.perf_counter()
        self._since = now if made <= self._at_once else self._since
        if self._show is not None:
            self._show(done, self._frames)
        elif made > self._at_once and (now - self._last > EVERY or done == self._frames):
            self._last, each = now, (now - self._since) / (made - self._at_once)
            say("frame", f"{done} of {self._frames}, {each:.2f} s each, {_clock(each * (self._frames - done))} left")


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}"
