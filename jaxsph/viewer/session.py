"""A view: its newest state, threads that render it, and those who are told of pictures.

Flow: inputs -> [session: state -> stages] -> Picture -> listeners (server, widget).

Inputs are done at once and cost nothing; pictures are made of the newest state only. One thread makes drafts, another what comes
after them once nothing has moved for a moment: it leaves what it does at the next band as soon as something moves. A
third reads frames of a sequence: that which is asked for, then the two beside it; others are let go.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax

from jaxsph.engine.request import along_rays, as_asked
from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.viewer.inputs import InputError, number, size_of
from jaxsph.viewer.stages import DEFAULT, DRAFT, FULL, Abandoned, Picture, Stage, described, histogram_of, stages_of
from jaxsph.viewer.state import Frame, Source, State

REST_SECONDS = 0.2
"""How long nothing moves before more than drafts are made."""
FIRST_SECONDS = 5.0
"""How long a view that is as large as its page waits for the size of one: programs of another would be compiled for nobody."""
Listener = Callable[[Any], None]


class Session:
    """An interactive view of a scene, without anybody who shows it.

    Use it as a context, or call `start` and `close`. Methods may be called from any thread.

    Attributes:
        settings: of the last picture of a state.
        stages: how pictures of the newest size are made, the draft first.
        told: a reason why there is no picture of the settings, for people; empty where there is.
        frames: of the sequence that is looked at, if it is one: which of them is shown is `number`, which is to be `asked`.
        histogram: what rays of the last view that stood still met, by place on the axis of the look.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        settings: Settings | None = None,
        source: Source | None = None,
        frames: Sequence[Frame] = (),
        *,
        fits: bool = False,
    ) -> None:
        """Begin with what `jaxsph.render(scene, camera, settings)` takes; nothing is rendered yet.

        Args:
            scene, camera: what is looked at, and from where.
            settings: of the last picture of a state; None is `stages.DEFAULT`, of a surface of particles without a tolerance.
            source: where the scene comes from, for the code that makes it again.
            frames: those of a sequence, whose first that can be read is the scene.
            fits: whether pictures are as large as a page has room for, instead of as the camera says.

        Raises:
            ValueError: a scene with nothing in it, or a camera that is none; a tolerance of a surface of particles.
        """
        scene, camera = as_asked(scene, camera, DEFAULT if settings is None else settings)
        scene.check()
        self.settings, self.told = settings or (DEFAULT if scene.surface is None else Settings()), ""
        if scene.surface is not None:
            along_rays(scene, self.settings)
        self.stages, self._source = stages_of(self.settings, camera), source or Source()
        self.frames, self._fits = frames, fits
        self.number = self.asked = next((number for number, frame in enumerate(frames) if frame.time is not None), 0)
        self._ahead, self._why = 1, ""  # the way through the frames; why that which is asked for cannot be read
        self._read: dict[int, Scene | str] = {}  # frames by number, or why they cannot be read
        self._state = State.of(scene, camera)
        self._drawn, self._failed, self._changed, self._begins = 0, 0, 0.0, 0.0
        self._lock = threading.Condition()
        self._pictures: dict[str, Picture] = {}
        self.histogram: dict[str, Any] | None = None
        self._listeners: list[Listener] = []
        self._threads: list[threading.Thread] = []
        self._closed, self._wide = False, jax.config.read("jax_enable_x64")

    def __exit__(self, *_: Any) -> None:
        self.close()

    def start(self) -> Session:
        """Begin to render."""
        self._begins = time.monotonic() + FIRST_SECONDS if self._fits else 0.0
        for work in (self._draft, self._finish, *([self._reads] if self.frames else [])):
            thread = threading.Thread(target=self._run, args=(work,), name=f"jaxsph view{work.__name__}", daemon=True)
            self._threads.append(thread)
            thread.start()
        return self

    __enter__ = start

    def close(self, seconds: float | None = None) -> bool:
        """End the threads, after what they cannot leave; wait for them no longer than so many seconds, if given.

        Returns:
            Whether they have ended: a compiler may take longer.
        """
        with self._lock:
            self._closed = True
            self._lock.notify_all()
        for thread in self._threads:
            thread.join(seconds)
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        return not self._threads

    # What is seen.

    @property
    def picture(self) -> Picture | None:
        """The best picture of the newest state that there is any of."""
        with self._lock:
            return max(self._pictures.values(), key=lambda one: one.rank, default=None)

    def snapshot(self) -> State:
        """The newest state, which stays as it is: everything that a picture is made of, such as its `scene` and `camera`."""
        return self._state

    @property
    def version(self) -> int:
        """Of the newest state."""
        return self._state.version

    def state(self) -> dict[str, Any]:
        """The newest state for a page, as JSON has it."""
        with self._lock:
            frames: dict[str, Any] | None = None
            if self.frames:
                frame = self.frames[self.asked]
                frames = {"number": self.number, "asked": self.asked, "of": len(self.frames)}
                frames |= {"name": frame.name, "time": frame.time, "why": self._why}
            return {"is": "state", "told": self.told, "frames": frames, **self._state.told()}

    def shown(self) -> list[Any]:
        """What somebody who comes now is to be told: the state, a histogram and a picture, as listeners are."""
        return [self.state(), *(what for what in (self.histogram, self.picture) if what is not None)]

    def code(self) -> dict[str, str]:
        """The Python that makes the newest state again."""
        with self._lock:
            source = self.frames[self.number].source if self.frames else self._source
            return {"is": "code", "python": self._state.code(source, self.settings)}

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call somebody with every picture, and all else (a dict, as JSON has it), from threads of the view; until undone."""
        with self._lock:
            self._listeners.append(listener)

        def undo() -> None:
            with self._lock:
                if listener in self._listeners:
                    self._listeners.remove(listener)

        return undo

    def wait(self, stage: str | None = None, seconds: float = 600.0) -> Picture:
        """The picture of the newest state from a stage, by default the last, as soon as there is one.

        Raises:
            TimeoutError: there is none after so long.
            RuntimeError: it cannot be made.
        """
        end = time.monotonic() + seconds
        with self._lock:
            while True:
                found = self._pictures.get(stage or self.stages[-1].name)
                if found is not None and found.version == self.version:
                    return found
                if self.told and self._failed == self.version:
                    raise RuntimeError(self.told)
                if not self._lock.wait(max(0.0, end - time.monotonic())) and time.monotonic() >= end:
                    raise TimeoutError(f"no picture of {stage or self.stages[-1].name!r} within {seconds:g} s")

    def whole(self, seconds: float = 600.0) -> Picture:
        """The best picture of all pixels of the newest state; waits where there is but a draft."""
        if (picture := self.picture) is not None and picture.version == self.version and picture.stage != DRAFT:
            return picture
        return self.wait(FULL, seconds)

    # What is done.

    def answer(self, message: Any, read: Callable[[Any], Any] = lambda message: message) -> dict[str, Any] | None:
        """What is to be told to who asked for something: an answer, or why there is none; listeners are told what it changes."""
        try:
            answer = self.do(read(message))
        except InputError as error:
            return {"is": "error", "text": str(error)}
        if answer is None:
            self._send_state()
        return answer

    def do(self, message: Any) -> dict[str, Any] | None:
        """Do what a message asks for.

        Args:
            message: `{"do": NAME, ...}`: one of `state.INPUTS`; `pick` and `center`, at a place of the picture; `code`; `frame`
                with a `number` from 0 on, of a sequence; or `size` with the `width` and `height` that a page has room for,
                pixels: it is done where the view fits its page.

        Returns:
            An answer for who asked, where there is one.

        Raises:
            InputError: what cannot be understood or done; nothing has changed.
        """
        if not isinstance(message, dict) or not isinstance(message.get("do"), str):
            raise InputError('a message must be an object such as {"do": "orbit", "right": 0.1, "down": 0}')
        others: dict[str, Callable[[dict[str, Any]], dict[str, Any] | None]] = {
            "pick": self._pick,
            "center": self._center,
            "code": lambda _: self.code(),
            "frame": self._ask,
            "size": self._fit,
        }
        try:
            with jax.enable_x64(self._wide):  # which a thread does not inherit
                return others.get(message["do"], lambda said: self._renew(lambda state: state.done(said)))(message)
        except InputError:
            raise
        except (ValueError, ArithmeticError) as error:
            raise InputError(str(error)) from error

    def _ask(self, message: dict[str, Any]) -> None:
        """Have a frame shown as soon as it is read, before others; one that could not be read is tried again."""
        if not self.frames:
            raise InputError("this view is of no sequence of snapshots")
        asked = int(number(message, "number", 0, len(self.frames) - 1))
        with self._lock:
            self._ahead, self.asked, self._why = 1 if asked >= self.number else -1, asked, ""
            self._read = {one: found for one, found in self._read.items() if isinstance(found, Scene)}
            self._reach()
            self._lock.notify_all()

    def _fit(self, message: dict[str, Any]) -> None:
        """Make pictures of so many pixels from now on, where nobody said of how many."""
        width, height = size_of(message)
        with self._lock:
            if self._fits:
                self._begins, before = 0.0, self._state
                self._renew(lambda state: state.resized(width, height))
                if self._state is not before:
                    self.stages = stages_of(self.settings, self._state.camera)

    def _pick(self, message: dict[str, Any]) -> dict[str, Any]:
        picture, *place = self._pointed(message)
        return {"is": "picked", **picture.told(*place)}

    def _center(self, message: dict[str, Any]) -> None:
        """Have what is seen there in the middle."""
        picture, *place = self._pointed(message)
        if (seen := picture.seen(*place)) is None:
            raise InputError("nothing is seen there: no surface, and less than half of the light is absorbed")
        self._renew(lambda state: state.seen_from(state.pose.centred(seen)))

    def _renew(self, change: Callable[[State], State]) -> None:
        """Have another state, and pictures of it where it differs in them."""
        with self._lock:
            before, state = self._state, change(self._state)
            _ = state.camera, state.scene  # made now, so that what is wrong with them changes nothing
            self._state = state
            if state.version != before.version:
                self._changed = time.monotonic()
            self._lock.notify_all()

    def _pointed(self, message: dict[str, Any]) -> tuple[Picture, float, float]:
        """The picture, and the place in it that a message says."""
        right, down = (number(message, name, -10, 10) for name in ("right", "down"))
        if (picture := self.picture) is None:
            raise InputError("there is no picture yet")
        return picture, right, down

    # Threads.

    def _run(self, work: Callable[[], None]) -> None:
        with jax.enable_x64(self._wide):
            work()

    def _draft(self) -> None:
        """A draft of every state that is still the newest when the one before is done."""
        while (found := self._next(self._drawn)) is not None:
            state, stages = found
            self._show(stages[0], state, lambda: False)
            with self._lock:
                self._drawn = state.version
                self._lock.notify_all()

    def _finish(self) -> None:
        """All after the draft, which comes sooner alone, of states that stand still."""
        done = 0
        while (found := self._next(done, rest=True)) is not None:
            state, stages = found
            moved = self._is_old(state)
            for stage in stages[1:]:
                if moved() or not self._show(stage, state, moved):
                    break
            if not moved():
                self._describe(state)
                done = state.version

    def _reads(self) -> None:
        """Read the frame that is asked for, then those beside it, the next on the way first."""
        while True:
            with self._lock:
                while (number := self._unread()) is None and not self._closed:
                    self._lock.wait()
            if self._closed or number is None:
                return
            try:
                found: Scene | str = self.frames[number].scene()
            except Exception as error:  # a view goes on: what is wrong is told once it is asked for
                found = f"{self.frames[number].name}: {error}"
            with self._lock:
                self._read[number] = found
                self._reach()
            if number == self.asked:
                self._send_state()

    def _unread(self) -> int | None:
        """Which frame is to be read next; others than it and its neighbours are let go."""
        near = (self.asked, self.asked + self._ahead, self.asked - self._ahead)
        self._read = {one: found for one, found in self._read.items() if one in near}
        known = {*self._read, *([self.number] if self.number == self.asked else [])}
        return next((one for one in near if 0 <= one < len(self.frames) and one not in known), None)

    def _reach(self) -> None:
        """Show the frame that is asked for, if it is read."""
        found = self._read.get(self.asked)
        if isinstance(found, str):
            self._why = found
        elif found is not None and self.asked != self.number:
            self.number = self.asked
            self._renew(lambda state: state.to(base=found))

    def _next(self, done: int, *, rest: bool = False) -> tuple[State, tuple[Stage, ...]] | None:
        """The newest state as soon as there is one after `done`, and it rests and is drafted if it has to; None at the end."""
        with self._lock:
            while not self._closed:
                still = max(self._begins, self._changed + REST_SECONDS if rest else 0.0) - time.monotonic()
                ready = self.version > done and (self._drawn == self.version or not rest)
                if ready and still <= 0:
                    return self._state, self.stages
                self._lock.wait(still if ready else None)
        return None

    def _is_old(self, state: State) -> Callable[[], bool]:
        return lambda: self._closed or self.version != state.version

    def _show(self, stage: Stage, state: State, stop: Callable[[], bool]) -> bool:
        """Make a picture and tell of it; False where it was left, or cannot be made."""
        started = time.perf_counter()
        try:
            image = stage.image(state, stop)
        except Abandoned:
            return False
        except Exception as error:  # a view goes on: what is wrong is told
            with self._lock:
                kind, self._failed = "" if isinstance(error, ValueError) else f"{type(error).__name__}: ", state.version
                self.told = f"{stage.name}: {kind}{error}"
                self._lock.notify_all()
            self._send({"is": "error", "text": self.told})
            return False
        words, facts = described(stage, image, state.scene, state.camera, time.perf_counter() - started)
        final = stage is self.stages[-1]
        made = image, state.scene, stage.camera(state.camera), stage.settings, state.pose
        picture = Picture(state.version, stage.name, words, final, *made, facts)
        with self._lock:
            is_best = all(other.rank <= picture.rank for other in self._pictures.values())
            if is_best:
                self._pictures[stage.name] = picture
            self.told = "" if final else self.told
            self._lock.notify_all()
        if is_best:
            self._send(picture)
        return True

    def _describe(self, state: State) -> None:
        """Tell what rays of a view that stands met."""
        try:
            found = None if state.look is None else histogram_of(state.scene, state.camera, state.look.scale, self.picture)
        except Exception as error:  # a view goes on without it
            self._send({"is": "error", "text": f"histogram: {type(error).__name__}: {error}"})
            return
        if found is not None and not self._is_old(state)():
            self.histogram = {"is": "histogram", "version": state.version, **found}
            self._send(self.histogram)

    def _send_state(self) -> None:
        with self._lock:  # so that the newest is the last that is told
            self._send(self.state())

    def _send(self, what: Any) -> None:
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            listener(what)
