"""Frames on the workers of a cluster of Dask's: each is read, rendered and written there, and told of here.

Flow: FrameTask -> [frames_on_cluster: bytes -> worker -> outcome] -> images or files, in order.

One worker makes the plan of the first frame, and all compile for that; where a frame outgrows it, the plan that its worker made
goes with later frames. Room changes no bit of an image, and all else in a plan is the first frame's: so images are the same bits
as those that are rendered without a cluster.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import pickle
import threading
import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax

from jaxsph.engine.planning.plan import Plan
from jaxsph.io.libraries import require
from jaxsph.model import Camera, Image
from jaxsph.numerics.version import __version__
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.sequence.task import (
    FrameFile,
    FramesError,
    FrameTask,
    GrowingPlan,
    Still,
    UnwritableError,
    fingerprint_of,
    rendered,
    unmade,
    written,
)

AHEAD = 2
"""Frames a worker that are on the way: one that is rendered, one that waits."""
RETRIES = 2
"""How often a frame is tried again that failed by anything but its data, such as a file system that was away."""
SHARED = 4
"""Scenes and sequences that are kept by the cluster, the latest: frames come from few."""
GONE = "the scheduler of the cluster is gone ({}); frames that are written stay"
LARGE = "distributed.admin.large-graph-warning-threshold"


@dataclasses.dataclass(frozen=True)
class Lead:
    """What frames have in common: a plan, or as long as there is none the frame and the cameras that it is made for."""

    first: FrameTask | None
    ahead: Sequence[Camera]
    plan: Plan | None


class Outcome(NamedTuple):
    """What became of a frame.

    Attributes:
        frame: its file, or its image as bytes; None of one that was planned for alone.
        plan: that the worker had after it.
        error: what is wrong with its data.
    """

    frame: FrameFile | bytes | None = None
    plan: Plan | None = None
    error: Exception | None = None


def files_on(client: Any, tasks: Iterator[FrameTask], ahead: Sequence[Camera]) -> Iterator[FrameFile]:
    """Files of all frames, in order; see `jaxsph.render_frames`."""
    failed: list[FrameFile] = []
    last = 0
    for task, outcome in _Sequence(client, ahead).outcomes(tasks):
        frame, last = outcome.frame, task.number
        if outcome.error is not None:
            frame = unmade(task, outcome.error)
            failed.append(frame)
        assert isinstance(frame, FrameFile) and task.output is not None
        yield dataclasses.replace(frame, path=task.output)
    if failed:
        raise FramesError(failed, last)


def images_on(client: Any, tasks: Iterator[FrameTask], ahead: Sequence[Camera]) -> Iterator[Image]:
    """Images of all frames, in order; see `jaxsph.render_frames`."""
    x64 = jax.config.read("jax_enable_x64")
    for _, outcome in _Sequence(client, ahead).outcomes(tasks):
        if outcome.error is not None:
            raise outcome.error
        assert isinstance(outcome.frame, bytes)
        with jax.enable_x64(x64):
            image = pickle.loads(outcome.frame)
        yield image


class _Sequence:
    """Frames on their way to workers and back."""

    def __init__(self, client: Any, ahead: Sequence[Camera]) -> None:
        self._client, self._lead = client, Lead(None, ahead, None)
        self._name = f"jaxsph-{uuid.uuid4().hex[:12]}"
        self._shared: dict[int, tuple[Any, Any]] = {}  # by identity: what frames share, and where it is; the latest
        self._sent = itertools.count()
        self._x64 = jax.config.read("jax_enable_x64")

    def outcomes(self, tasks: Iterator[FrameTask]) -> Iterator[tuple[FrameTask, Outcome]]:
        """Of all frames in order, no more of which are on the way than keeps workers busy."""
        finished = require("distributed", "frames on a cluster", "cluster").as_completed(loop=self._client.loop)
        running: dict[str, tuple[Any, FrameTask]] = {}
        ready: dict[int, tuple[FrameTask, Outcome]] = {}
        trouble: Exception | None = None
        more = True
        try:
            for number in itertools.count(1):
                while number not in ready and (more or running):
                    while more and len(running) + _held(ready) < self._room():
                        try:
                            task = next(tasks, None)
                        except Exception as error:  # told of after the frames before it
                            task, trouble = None, error
                        more = task is not None
                        if task is not None:
                            self._begin_or_send(task, running, ready, finished)
                    if number not in ready and running:
                        future = next(finished)
                        task = running.pop(future.key)[1]
                        ready[task.number] = task, self._received(future)
                if number not in ready:
                    break
                yield ready.pop(number)
        except OSError as error:  # what is wrong with a frame is in its outcome
            raise RuntimeError(GONE.format(type(error).__name__)) from error
        finally:
            with contextlib.suppress(Exception):  # of a cluster that is gone nothing is on the way
                self._client.cancel([future for future, _ in running.values()])
        if trouble is not None:
            raise trouble

    def _begin_or_send(self, task: FrameTask, running: dict[str, Any], ready: dict[int, Any], finished: Any) -> None:
        if self._lead.first is None:
            outcome = self._received(self._send(task, "plan"))
            if outcome.error is None:
                self._lead = dataclasses.replace(self._lead, first=task)
            if outcome.error is not None or outcome.frame is not None:
                ready[task.number] = task, outcome
                return
        future = self._send(task, "frame")
        running[future.key] = future, task
        finished.add(future)

    def _room(self) -> int:
        if self._client.status != "running":
            raise RuntimeError(GONE.format(self._client.status))
        return AHEAD * max(len(self._client.nthreads()), 1)

    def _send(self, task: FrameTask, what: str) -> Any:
        """Have a frame planned for or made by some worker."""
        lead = self._lead if self._lead.plan is None else Lead(None, (), self._lead.plan)
        payload, shared = self._packed((_found_anywhere(task), lead))
        how = {"key": f"{self._name}-{what}-{task.number}", "pure": False, "retries": RETRIES}
        with _silent():
            return self._client.submit(_do, what, __version__, self._x64, payload, shared, **how)

    def _received(self, future: Any) -> Outcome:
        """What became of a frame, once it is known; what no other frame would escape is raised."""
        error = future.exception()
        if future.status not in ("finished", "error"):
            raise RuntimeError(GONE.format(future.status))
        outcome: Outcome = Outcome(error=error) if error is not None else future.result()
        if isinstance(outcome.error, UnwritableError | ImportError):
            raise outcome.error
        if outcome.plan is not None:
            plan = outcome.plan if self._lead.plan is None else self._lead.plan.grown(outcome.plan)
            self._lead = dataclasses.replace(self._lead, plan=plan)
        return outcome

    def _packed(self, of_frame: Any) -> tuple[bytes, dict[str, Any]]:
        """A frame as bytes, in which what frames share stands by name; and what those names stand for, by name."""
        names: dict[str, Any] = {}

        def shared(thing: Any) -> str | None:
            if not isinstance(thing, Still | Snapshots):
                return None
            if id(thing) not in self._shared:
                while len(self._shared) >= SHARED:
                    del self._shared[next(iter(self._shared))]
                self._shared[id(thing)] = thing, self._kept(thing)
            future = self._shared[id(thing)][1]
            names[future.key] = future
            return str(future.key)

        return _pickled(of_frame, shared), names

    def _kept(self, thing: Any) -> Any:
        """What frames share, kept by the cluster as the result of a task: made again where the workers that had it are gone."""
        with _silent():
            return self._client.submit(_same, _pickled(thing), key=f"{self._name}-shared-{next(self._sent)}")


def _held(ready: dict[int, tuple[FrameTask, Outcome]]) -> int:
    """Images that wait for those before them; what is told of files takes no room."""
    return sum(isinstance(outcome.frame, bytes) for _, outcome in ready.values())


def _found_anywhere(task: FrameTask) -> FrameTask:
    """A worker may stand in another folder."""
    return task if task.output is None else dataclasses.replace(task, output=task.output.absolute())


def _silent() -> Any:
    """Without Dask's advice on tasks of many bytes: a scene is sent once, and kept by the scheduler for workers to come."""
    dask: Any = require("dask", "frames on a cluster", "cluster")
    return dask.config.set({LARGE: "1 PB"})


def _pickled(thing: Any, shared: Callable[[Any], str | None] = lambda _: None) -> bytes:
    """As bytes, functions of the user's script included; what is `shared` by its name."""
    cloudpickle: Any = require("cloudpickle", "frames on a cluster", "cluster")

    class Packer(cloudpickle.Pickler):  # type: ignore[misc]
        def persistent_id(self, inner: Any) -> str | None:
            return shared(inner)

    file = io.BytesIO()
    Packer(file).dump(thing)
    return file.getvalue()


class _Opener(pickle.Unpickler):
    """What was packed, with what is shared at hand."""

    def persistent_load(self, name: str) -> Any:
        return _OPENED[name]


def _same(data: bytes) -> bytes:
    return data


_ONE = threading.Lock()
_OPENED: dict[str, Any] = {}
"""Of this worker: what the frames at hand share, by name."""


def _do(what: str, version: str, x64: bool, payload: bytes, shared: dict[str, bytes]) -> Outcome:
    """Plan for a frame or make it, on a worker: one at a time, as a frame takes all that its process has."""
    if version != __version__:
        raise ImportError(f"a worker has jaxsph {__version__}, but {version} is asked for; install the same on all")
    with _ONE, jax.enable_x64(x64):
        for name in _OPENED.keys() - shared.keys():
            del _OPENED[name]
        for name in shared.keys() - _OPENED.keys():
            _OPENED[name] = pickle.loads(shared[name])
        task, lead = _Opener(io.BytesIO(payload)).load()
        try:
            return _planned(task, lead) if what == "plan" else _made(task, lead)
        except ValueError as error:
            return Outcome(error=error)


def _planned(task: FrameTask, lead: Lead) -> Outcome:
    """The plan that begins with a frame, unless that is there."""
    scene = None if hasattr(task.source, "fingerprint") else task.scene()
    if task.output is not None and fingerprint_of(task.output) == task.fingerprint(scene):
        return Outcome(FrameFile(task.number, task.output, False, {}))
    plan = GrowingPlan(lead.ahead)
    plan.begin(task if scene is None else dataclasses.replace(task, source=scene))
    return Outcome(plan=plan.made)


def _made(task: FrameTask, lead: Lead) -> Outcome:
    plan = GrowingPlan(lead.ahead, lead.plan)
    first = lead.first or task
    if task.output is not None:
        return Outcome(written(task, plan, first), plan.made)
    if first.number != task.number:
        plan.begin(first)
    return Outcome(pickle.dumps(rendered(task, task.scene(), plan)), plan.made)
