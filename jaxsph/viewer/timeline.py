"""Frames of a sequence: that which is asked for is read, then the two beside it, on one thread; the others are let go.

Flow: Snapshots -> [timeline] -> Scene of a frame -> session.
"""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

from jaxsph.model.scene import Scene
from jaxsph.sequence.snapshots import Moment, Snapshots
from jaxsph.viewer.state import Source


class Frame(NamedTuple):
    """One frame: its name and time for people, what reads its scene, and where that comes from."""

    name: str
    time: float | None
    scene: Callable[[], Scene]
    source: Source


class Timeline:
    """Which frame of a sequence is shown, and which is to be.

    Attributes:
        frames: in the order of time.
        number: of that which is shown, from 0 on.
        asked: of that which is to be shown; the same, unless it is being read or cannot be.
        why: it cannot be read, for people; empty where it can.
    """

    def __init__(self, frames: tuple[Frame, ...], number: int = 0) -> None:
        self.frames, self.number, self.asked, self.why = frames, number, number, ""
        self._reads: dict[int, Future[Scene]] = {}
        self._last: Future[int] | None = None
        self._reader, self._lock = ThreadPoolExecutor(1, "jaxsph view reads"), threading.RLock()

    def begin(self, show: Callable[[int, Scene | None], None], run: Callable[[Callable[[], Scene]], Scene]) -> None:
        """Read from now on, by `run`; `show` is told of frames that were asked for, without a scene where they cannot be read."""
        self._show, self._run = show, run
        self.ask(self.asked)

    def ask(self, number: int) -> None:
        """Have a frame shown as soon as it is read, before others; one that could not be read is tried again."""
        with self._lock:
            ahead, self.asked, self.why = 1 if number >= self.number else -1, number, ""
            wanted = [one for one in (number, number + ahead, number - ahead) if 0 <= one < len(self.frames)]
            begun = {one: read for one, read in self._reads.items() if not read.cancel() and one in wanted}
            self._reads = {one: read for one, read in begun.items() if not (read.done() and read.exception())}
            for one in wanted:
                if one not in self._reads and not one == number == self.number:
                    self._reads[one] = self._reader.submit(self._run, self.frames[one].scene)
            if number in self._reads:
                self._reads[number].add_done_callback(functools.partial(self._found, number))

    def _found(self, number: int, read: Future[Scene]) -> None:
        with self._lock:
            if not read.cancelled() and number == self.asked != self.number:
                error = read.exception()
                self.why = "" if error is None else f"{self.frames[number].name}: {error}"
                self._show(number, read.result() if error is None else None)

    def close(self, seconds: float | None = None) -> bool:
        """Read no more, after the file that is read; wait for that no longer than so many seconds, if given: whether it is."""
        for read in self._reads.values():
            read.cancel()
        if self._last is None:
            self._last = self._reader.submit(int)
            self._reader.shutdown(wait=False)
        return bool(wait([self._last], seconds).done)

    def told(self) -> dict[str, Any]:
        """For a page, as JSON has it."""
        frame = self.frames[self.asked]
        where = {"number": self.number, "asked": self.asked, "of": len(self.frames)}
        return {**where, "name": frame.name, "time": frame.time, "why": self.why}


def timeline_of(snapshots: Snapshots, source: Callable[[float], Source] = lambda _: Source()) -> tuple[Scene, Timeline]:
    """The first frame of a sequence that can be read, and all of them; `source` of a time."""
    frames = tuple(_frames(snapshots, source))
    first = next(number for number, frame in enumerate(frames) if frame.time is not None)
    return frames[first].scene(), Timeline(frames, first)


def _frames(snapshots: Snapshots, source: Callable[[float], Source]) -> Iterator[Frame]:
    files, unread = iter(snapshots.survey.files), {file.why: file.path for file in snapshots.survey.unread}
    for one in snapshots.each():
        if isinstance(one, Moment):
            yield Frame(next(files).path.name, one.time, one, source(one.time))
        else:
            yield Frame(unread[one.why].name, None, one, Source())
