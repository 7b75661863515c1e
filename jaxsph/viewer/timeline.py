"""Frames of a sequence: that which is asked for is read, then the two beside it, on one thread; the others are let go.

Flow: Snapshots -> [timeline] -> Scene of a frame -> session.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from jaxsph.model.scene import Scene
from jaxsph.sequence.snapshots import Moment, Snapshots
from jaxsph.viewer.code import Source


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
        self._ready: dict[int, Scene] = {}
        self._failed: set[int] = set()
        self._lock = threading.Condition()
        self._closed = False

    def ask(self, number: int) -> None:
        """Have a frame shown as soon as it is read; one that could not be read is tried again."""
        with self._lock:
            self.asked, self.why = number, ""
            self._failed.clear()
            self._lock.notify_all()

    def close(self) -> None:
        """End `read`, after the file that it reads."""
        with self._lock:
            self._closed = True
            self._lock.notify_all()

    def told(self) -> dict[str, Any]:
        """For a page, as JSON has it."""
        frame = self.frames[self.asked]
        where = {"number": self.number, "asked": self.asked, "of": len(self.frames)}
        return {**where, "name": frame.name, "time": frame.time, "why": self.why}

    def read(self, show: Callable[[int, Scene | None], None]) -> None:
        """Read what is asked for, and what is beside it, until it is closed.

        Args:
            show: called with a frame that was asked for; without a scene where it cannot be read.
        """
        while (number := self._next()) is not None:
            scene = self._ready.get(number)
            why = ""
            if scene is None:
                try:
                    scene = self.frames[number].scene()
                except Exception as error:  # a view goes on: what is wrong is told
                    why = f"{self.frames[number].name}: {error}"
            with self._lock:
                if scene is None:
                    self._failed.add(number)
                else:
                    self._ready[number] = scene
                self._ready = {other: one for other, one in self._ready.items() if abs(other - self.asked) <= 1}
                if number != self.asked or number == self.number:
                    continue
                self.why = why
            show(number, scene)

    def _next(self) -> int | None:
        """The frame to read now; None at the end."""
        with self._lock:
            while not self._closed:
                if self.asked != self.number and self.asked not in self._failed:
                    return self.asked
                ahead = 1 if self.asked >= self.number else -1
                for number in (self.asked + ahead, self.asked - ahead):
                    if 0 <= number < len(self.frames) and number not in self._ready and number not in self._failed:
                        return number
                self._lock.wait()
        return None


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
