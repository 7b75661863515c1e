"""A view: its newest state, threads that render it, and those who are told of pictures.

Flow: inputs -> [session: state -> stages] -> Picture -> listeners (server, widget).

Inputs are done at once and cost nothing; pictures are made of the newest state only. One thread makes drafts, another what comes
after them once nothing has moved for a moment: it leaves what it does at the next band as soon as something moves.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from jaxsph.engine.request import along_rays, as_asked
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.path import CameraPath
from jaxsph.model.scene import Scene
from jaxsph.model.settings import Settings
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.viewer.inputs import InputError, number, size_of
from jaxsph.viewer.picture import Picture, described, histogram_of
from jaxsph.viewer.pose import Pose
from jaxsph.viewer.stages import DEFAULT, DRAFT, FULL, Abandoned, Stage, default_of, stages_of
from jaxsph.viewer.state import QUIET, Source, State
from jaxsph.viewer.timeline import Timeline

REST_SECONDS = 0.2
"""How long nothing moves before more than drafts are made."""
FIRST_SECONDS = 5.0
"""How long a view that is as large as its page waits for the size of one: programs of another would be compiled for nobody."""
Listener = Callable[[Any], None]


class Snapshot(NamedTuple):
    """A state that stays as it is: everything that a picture is made of."""

    version: int
    scene: Scene
    camera: Camera
    pose: Pose
    stages: tuple[Stage, ...]


class Session:
    """An interactive view of a scene, without anybody who shows it.

    Use it as a context, or call `start` and `close`. Methods may be called from any thread.

    Attributes:
        settings: of the last picture of a state.
        stages: how pictures of the newest size are made, the draft first.
        told: a reason why there is no picture of the settings, for people; empty where there is.
        version: of the newest state.
        histogram: what rays of the last view that stood still met, by place on the axis of the look.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        settings: Settings | None = None,
        source: Source | None = None,
        timeline: Timeline | None = None,
        *,
        fits: bool = False,
    ) -> None:
        """Begin with what `jaxsph.render(scene, camera, settings)` takes; nothing is rendered yet.

        Args:
            scene, camera: what is looked at, and from where.
            settings: of the last picture of a state; None is `stages.default_of(scene)`.
            source: where the scene comes from, for the code that makes it again.
            timeline: the sequence that it is a frame of, if it is.
            fits: whether pictures are as large as a page has room for, instead of as the camera says.

        Raises:
            ValueError: a scene with nothing in it, or a camera that is none; a tolerance of a surface of particles.
        """
        scene, camera = as_asked(scene, camera, DEFAULT if settings is None else settings)
        scene.check()
        self.settings, self.told = default_of(scene) if settings is None else settings, ""
        if scene.surface is not None:
            along_rays(scene, self.settings)
        self.stages, self._source = stages_of(self.settings, camera), source or Source()
        self._timeline, self._fits = timeline, fits
        self._state = State(scene, camera)
        self.version, self._drawn, self._failed, self._changed, self._begins = 1, 0, 0, 0.0, 0.0
        self._lock = threading.Condition()
        self._pictures: dict[str, Picture] = {}
        self.histogram: dict[str, Any] | None = None
        self._listeners: list[Listener] = []
        self._threads: list[threading.Thread] = []
        self._closed, self._wide = False, jax.config.read("jax_enable_x64")

    def __enter__(self) -> Session:
        return self.start()

    def __exit__(self, *_: Any) -> None:
        self.close()

    def start(self) -> Session:
        """Begin to render."""
        self._begins = time.monotonic() + FIRST_SECONDS if self._fits else 0.0
        for work in (self._draft, self._finish):
            thread = threading.Thread(target=self._run, args=(work,), name=f"jaxsph view{work.__name__}", daemon=True)
            self._threads.append(thread)
            thread.start()
        if self._timeline is not None:
            self._timeline.begin(self._frame, self._run)
        return self

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
        read = self._timeline is None or self._timeline.close(seconds)
        return read and not self._threads

    # What is seen.

    @property
    def picture(self) -> Picture | None:
        """The best picture of the newest state that there is any of."""
        with self._lock:
            pictures = sorted(self._pictures.values(), key=lambda one: (one.version, self._names.index(one.stage)))
            return pictures[-1] if pictures else None

    def snapshot(self) -> Snapshot:
        """The newest state."""
        with self._lock:
            state = self._state
            return Snapshot(self.version, state.scene, state.camera, state.pose, self.stages)

    def state(self) -> dict[str, Any]:
        """The newest state for a page, as JSON has it."""
        with self._lock:
            frames = None if self._timeline is None else self._timeline.told()
            return {"is": "state", "version": self.version, "told": self.told, "frames": frames, **self._state.told()}

    @property
    def transfer(self) -> TransferFunction | None:
        """The look that is shown, where there is one."""
        return self._state.transfer

    @property
    def path(self) -> CameraPath | None:
        """Through the key frames that were kept; None where there are fewer than two."""
        return self._state.path

    def code(self) -> dict[str, str]:
        """The Python that makes the newest state again."""
        with self._lock:
            line = self._timeline
            source = self._source if line is None else line.frames[line.number].source
            return {"is": "code", "python": self._state.code(source, self.settings)}

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call somebody with every picture, and every histogram (a dict), from the threads that made them; until undone."""
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
                found = self._pictures.get(stage or self._names[-1])
                if found is not None and found.version == self.version:
                    return found
                if self.told and self._failed == self.version:
                    raise RuntimeError(self.told)
                if not self._lock.wait(max(0.0, end - time.monotonic())) and time.monotonic() >= end:
                    raise TimeoutError(f"no picture of {stage or self._names[-1]!r} within {seconds:g} s")

    def whole(self, seconds: float = 600.0) -> Picture:
        """The best picture of all pixels of the newest state; waits where there is but a draft."""
        picture = self.picture
        if picture is not None and picture.version == self.version and picture.stage != DRAFT:
            return picture
        return self.wait(FULL, seconds)

    # What is done.

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
            return self._run(lambda: others.get(message["do"], self._change)(message))  # type: ignore[no-any-return]
        except InputError:
            raise
        except (ValueError, ArithmeticError) as error:
            raise InputError(str(error)) from error

    def _change(self, message: dict[str, Any]) -> None:
        with self._lock:
            self._state.do(message)
            if message["do"] not in QUIET:
                self._renew()

    def _ask(self, message: dict[str, Any]) -> None:
        """Have another frame shown."""
        if self._timeline is None:
            raise InputError("this view is of no sequence of snapshots")
        self._timeline.ask(int(number(message, "number", 0, len(self._timeline.frames) - 1)))

    def _fit(self, message: dict[str, Any]) -> None:
        """Make pictures of so many pixels from now on, where nobody said of how many."""
        width, height = size_of(message)
        with self._lock:
            if self._fits:
                self._begins = 0.0
                if self._state.resize(width, height):
                    self.stages = stages_of(self.settings, self._state.camera)
                    self._renew()
                self._lock.notify_all()

    def _pick(self, message: dict[str, Any]) -> dict[str, Any]:
        picture, *place = self._pointed(message)
        return {"is": "picked", **picture.told(*place)}

    def _center(self, message: dict[str, Any]) -> None:
        """Have what is seen there in the middle."""
        picture, *place = self._pointed(message)
        if (seen := picture.seen(*place)) is None:
            raise InputError("nothing is seen there: no surface, and less than half of the light is absorbed")
        with self._lock:
            self._state.move(self._state.pose.centred(seen))
            self._renew()

    def _renew(self) -> None:
        """Have pictures of what is now another state."""
        self.version += 1
        self._changed = time.monotonic()
        self._lock.notify_all()

    def _pointed(self, message: dict[str, Any]) -> tuple[Picture, float, float]:
        """The picture, and the place in it that a message says."""
        picture = self.picture
        right, down = (number(message, name, -10, 10) for name in ("right", "down"))
        if picture is None:
            raise InputError("there is no picture yet")
        return picture, right, down

    # Threads.

    @property
    def _names(self) -> list[str]:
        return [stage.name for stage in self.stages]

    def _run(self, work: Callable[[], Any]) -> Any:
        with jax.enable_x64(self._wide):  # which a thread does not inherit
            return work()

    def _draft(self) -> None:
        """A draft of every state that is still the newest when the one before is done."""
        while (state := self._next(self._drawn)) is not None:
            self._show(state.stages[0], state, lambda: False)
            with self._lock:
                self._drawn = state.version
                self._lock.notify_all()

    def _finish(self) -> None:
        """All after the draft, which comes sooner alone, of states that stand still."""
        done = 0
        while (state := self._next(done, rest=True)) is not None:
            moved = self._is_old(state)
            for stage in state.stages[1:]:
                if moved() or not self._show(stage, state, moved):
                    break
            if not moved():
                self._describe(state)
                done = state.version

    def _frame(self, number: int, scene: Scene | None) -> None:
        """Show a frame, or that it cannot be."""
        if scene is not None:
            with self._lock:
                self._timeline.number = number  # type: ignore[union-attr]
                self._state.frame(scene)
                self._renew()
        self._send(self.state())

    def _next(self, done: int, *, rest: bool = False) -> Snapshot | None:
        """The newest state as soon as there is one after `done`, and it rests and is drafted if it has to; None at the end."""
        with self._lock:
            while not self._closed:
                still = max(self._begins, self._changed + REST_SECONDS if rest else 0.0) - time.monotonic()
                ready = self.version > done and (self._drawn == self.version or not rest)
                if ready and still <= 0:
                    return self.snapshot()
                self._lock.wait(still if ready else None)
        return None

    def _is_old(self, state: Snapshot) -> Callable[[], bool]:
        return lambda: self._closed or self.version != state.version

    def _show(self, stage: Stage, state: Snapshot, stop: Callable[[], bool]) -> bool:
        """Make a picture and tell of it; False where it was left, or cannot be made."""
        started = time.perf_counter()
        try:
            if not stage.made:
                size = state.camera.width, state.camera.height
                around = [] if state.scene.media else state.pose.around(*size)  # media do not say how large they are
                stage.prepare(state.scene, [state.camera, *around])
            image = stage.image(state.scene, state.camera, stop)
        except Abandoned:
            return False
        except Exception as error:  # a view goes on: what is wrong is told
            self._tell(stage, state, error)
            return False
        words, facts = described(stage, image, state.scene, state.camera, time.perf_counter() - started)
        final = stage is state.stages[-1]
        made = image, state.scene, stage.camera(state.camera), stage.settings, state.pose
        picture = Picture(state.version, stage.name, words, final, *made, facts)
        with self._lock:
            rank = picture.version, self._names.index(picture.stage)
            is_best = all((other.version, self._names.index(name)) <= rank for name, other in self._pictures.items())
            if is_best:
                self._pictures[stage.name] = picture
            self.told = "" if final else self.told
            self._lock.notify_all()
        if is_best:
            self._send(picture)
        return True

    def _tell(self, stage: Stage, state: Snapshot, error: Exception) -> None:
        with self._lock:
            self._failed = state.version
            kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
            self.told = f"{stage.name}: {kind}{error}"
            self._lock.notify_all()
        self._send({"is": "error", "text": self.told})

    def _describe(self, state: Snapshot) -> None:
        """Tell what rays of a view that stands met."""
        try:
            scale = self._state.scale
            found = None if scale is None else histogram_of(state.scene, state.camera, scale, self.picture)
        except Exception as error:  # a view goes on without it
            self._send({"is": "error", "text": f"histogram: {type(error).__name__}: {error}"})
            return
        if found is not None and not self._is_old(state)():
            self.histogram = {"is": "histogram", "version": state.version, **found}
            self._send(self.histogram)

    def _send(self, what: Any) -> None:
        with self._lock:
            listeners = list(self._listeners)
        for listener in listeners:
            listener(what)
