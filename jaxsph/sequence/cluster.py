"""Frames on workers of Dask's, of a cluster or processes of this machine: read, rendered and written there, told of here.

Flow: FrameTask -> [workers: bytes -> worker -> outcome] -> images or files, in order.

One worker makes the plan of the first frame, and all compile for that; where a frame outgrows it, the plan that its worker made
goes with later frames. Room changes no bit of an image, and all else in a plan is the first frame's: so images are the same bits
as those that are rendered without a cluster.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import logging
import os
import pickle
import signal
import threading
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jaxsph.engine.planning.plan import Plan
from jaxsph.io.damage import require
from jaxsph.model import Camera, Image
from jaxsph.numerics import __version__
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.sequence.task import (
    FrameFile,
    FrameTask,
    GrowingPlan,
    Still,
    UnwritableError,
    fingerprint_of,
    rendered,
    unmade,
    written,
)

distributed = require("distributed", "frames on several processes", "cluster")
dask: Any = require("dask", "frames on several processes", "cluster")
cloudpickle: Any = require("cloudpickle", "frames on several processes", "cluster")
WorkerPlugin: Any = distributed.WorkerPlugin
AHEAD = 2
"""Frames a worker that are on the way: one that is rendered, one that waits."""
RETRIES = 2
"""How often a frame is tried again that failed by anything but its data, such as a file system that was away."""
SHARED = 4
"""Scenes and sequences that are kept by the cluster, the latest: frames come from few."""
GONE = "the scheduler of the cluster is gone ({}); frames that are written stay"
LARGE = "distributed.admin.large-graph-warning-threshold"
CLOSING = 10.0
"""Seconds that workers have to end by themselves; those that compile do not hear, and are killed."""
PROFILE = "distributed.worker.profile.enabled"
"""Whether Dask looks at what its workers are at, 100 times a second: half of what idle ones use, and nobody reads it here."""
CACHE = (
    "jax_enable_compilation_cache",
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)
"""What JAX is told of compiled programs that are kept: workers share them with the process that starts them."""


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
    for task, outcome in _Sequence(client, ahead).outcomes(tasks):
        frame = outcome.frame if outcome.error is None else unmade(task, outcome.error)
        assert isinstance(frame, FrameFile) and task.output is not None
        yield dataclasses.replace(frame, path=task.output)


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
        self._client, self._plan = client, GrowingPlan(ahead)
        self._name = f"jaxsph-{uuid.uuid4().hex[:12]}"
        self._shared: dict[int, tuple[Any, Any]] = {}  # by identity: what frames share, and where it is; the latest
        self._sent = itertools.count()
        self._x64 = jax.config.read("jax_enable_x64")

    def outcomes(self, tasks: Iterator[FrameTask]) -> Iterator[tuple[FrameTask, Outcome]]:
        """Of all frames in order, no more of which are on the way than keeps workers busy."""
        finished = distributed.as_completed(loop=self._client.loop)
        frames: dict[str, tuple[FrameTask, Any]] = {}  # by the name of what was sent: outcomes, or futures of them
        trouble: Exception | None = None
        more = True
        try:
            while True:
                while more and self._has_room(found for _, found in frames.values()):
                    try:
                        task = next(tasks, None)
                    except Exception as error:  # told of after the frames before it
                        task, trouble = None, error
                    more = task is not None
                    if task is not None:
                        found = self._begun(task)
                        if isinstance(found, Outcome):
                            frames[f"frame {task.number}"] = task, found
                        else:
                            frames[found.key] = task, found
                            finished.add(found)
                if not frames:
                    break
                first = next(iter(frames))
                if isinstance(frames[first][1], Outcome):
                    yield frames.pop(first)
                else:
                    future = next(finished)
                    frames[future.key] = frames[future.key][0], self._received(future)
        except OSError as error:  # what is wrong with a frame is in its outcome
            raise RuntimeError(GONE.format(type(error).__name__)) from error
        finally:
            with contextlib.suppress(Exception):  # of a cluster that is gone nothing is on the way
                self._client.cancel([found for _, found in frames.values() if not isinstance(found, Outcome)])
        if trouble is not None:
            raise trouble

    def _has_room(self, frames: Iterable[Any]) -> bool:
        """For one more frame, beside those on the way and the images that wait; what is told of files takes no room."""
        if self._client.status != "running":
            raise RuntimeError(GONE.format(self._client.status))
        held = sum(not isinstance(found, Outcome) or isinstance(found.frame, bytes) for found in frames)
        return held < AHEAD * max(len(self._client.nthreads()), 1)

    def _begun(self, task: FrameTask) -> Any:
        """The future of a frame's outcome, sent once there is a plan; its outcome, where planning tells that."""
        if self._plan.first is None:
            outcome = self._received(self._send(task, "plan"))
            if outcome.error is None:
                self._plan.first = task
            if outcome.error is not None or outcome.frame is not None:
                return outcome
        return self._send(task, "frame")

    def _send(self, task: FrameTask, what: str) -> Any:
        """Have a frame planned for or made by some worker, which may stand in another folder."""
        plan = self._plan if self._plan.made is None else GrowingPlan(made=self._plan.made)
        there = task if task.output is None else dataclasses.replace(task, output=task.output.absolute())
        payload, shared = self._packed((there, plan))
        how = {"key": f"{self._name}-{what}-{task.number}", "pure": False, "retries": RETRIES}
        return self._submit(_do, what, __version__, self._x64, payload, shared, **how)

    def _submit(self, *what: Any, **how: Any) -> Any:
        """Without Dask's advice on tasks of many bytes: a scene is sent once, and kept by the scheduler for workers to come."""
        with dask.config.set({LARGE: "1 PB"}):
            return self._client.submit(*what, **how)

    def _received(self, future: Any) -> Outcome:
        """What became of a frame, once it is known; what no other frame would escape is raised."""
        error = future.exception()
        if future.status not in ("finished", "error"):
            raise RuntimeError(GONE.format(future.status))
        outcome: Outcome = Outcome(error=error) if error is not None else future.result()
        if isinstance(outcome.error, UnwritableError | ImportError):
            raise outcome.error
        if outcome.plan is not None:
            self._plan.made = outcome.plan if self._plan.made is None else self._plan.made.grown(outcome.plan)
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
        return self._submit(_same, _pickled(thing), key=f"{self._name}-shared-{next(self._sent)}")


def _pickled(thing: Any, shared: Callable[[Any], str | None] = lambda _: None) -> bytes:
    """As bytes, functions of the user's script included; what is `shared` by its name."""

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
        task, plan = _Opener(io.BytesIO(payload)).load()
        try:
            return _planned(task, plan) if what == "plan" else _made(task, plan)
        except ValueError as error:
            return Outcome(error=error)


def _planned(task: FrameTask, plan: GrowingPlan) -> Outcome:
    """The plan that begins with a frame, unless that is there."""
    scene = None if hasattr(task.source, "fingerprint") else task.scene()
    if task.output is not None and fingerprint_of(task.output) == task.fingerprint(scene):
        return Outcome(FrameFile(task.number, task.output, False, {}))
    plan.first = task if scene is None else dataclasses.replace(task, source=scene)
    plan.begin()
    return Outcome(plan=plan.made)


def _made(task: FrameTask, plan: GrowingPlan) -> Outcome:
    if task.output is not None:
        return Outcome(written(task, plan), plan.made)
    if plan.first is not None and plan.first.number != task.number:
        plan.begin()
    return Outcome(pickle.dumps(rendered(task, task.scene(), plan)), plan.made)


@contextlib.contextmanager
def local_client(workers: int, *, cores: Sequence[int] | None = None) -> Iterator[Any]:
    """A client of so many processes of this machine, which end with the block.

    Cores are dealt out: each worker keeps to its own, as frames are independent, and programs of one frame that run side by side
    lose some of what two cores give. Accelerators are dealt out in turns. Processes are spawned, as forked ones would share JAX's
    threads and stop; so a script that calls this needs `if __name__ == "__main__":`.

    Args:
        workers: how many.
        cores: numbers of the cores that are dealt out; all that this process may use.

    Raises:
        ImportError: distributed is not installed.
        ValueError: less than one worker.
    """
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise ValueError(f"`workers` must be an integer of at least 1, got {workers!r}")
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # several processes may share an accelerator
    config = {name: getattr(jax.config, name) for name in CACHE}
    share = Share(workers, _cores() if cores is None else cores, _accelerators(), config)
    how = {"threads_per_worker": 1, "processes": True, "memory_limit": 0, "silence_logs": logging.CRITICAL}
    no_pages = {"dashboard": False, "dashboard_address": "127.0.0.1:0"}  # at any free port, as several may run
    with dask.config.set({PROFILE: False}), _held_back() as came:
        cluster = distributed.LocalCluster(n_workers=workers, scheduler_kwargs=no_pages, dashboard_address=None, **how)
    try:
        for late in came[:1]:
            signal.raise_signal(late)
        with distributed.Client(cluster) as client:
            client.register_plugin(share)
            yield client
    finally:
        cluster.close(timeout=CLOSING)


@contextlib.contextmanager
def _held_back() -> Iterator[list[int]]:
    """Note signals that come in the block, for later: processes that are half started cannot be closed."""
    came: list[int] = []
    before: dict[signal.Signals, Any] = {}
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if callable(handler) and threading.current_thread() is threading.main_thread():
                before[number] = handler
                signal.signal(number, lambda late, _: came.append(late))
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclasses.dataclass(eq=False)
class Share(WorkerPlugin):  # type: ignore[misc]
    """What a worker has of the machine; also of one that stands in for another that died, as it has the same name."""

    workers: int
    cores: Sequence[int]
    accelerators: Sequence[str]
    config: dict[str, Any]
    name = "jaxsph-share"

    def setup(self, worker: Any) -> None:
        """Keep to some cores; leave it to the process that started this one, which closes it, to hear of signals."""
        place = int(worker.name)
        with contextlib.suppress(ValueError):  # only the main thread may
            for number in (signal.SIGINT, signal.SIGTERM):  # those of a job get both at once, to all of its processes
                signal.signal(number, signal.SIG_IGN)
        for name, value in self.config.items():
            jax.config.update(name, value)
        if self.accelerators:
            os.environ["CUDA_VISIBLE_DEVICES"] = self.accelerators[place % len(self.accelerators)]
        if self.cores:
            keep_to(share_of(self.cores, place, self.workers))


def share_of(cores: Sequence[int], place: int, workers: int) -> list[int]:
    """Every n-th core, or where there are fewer cores than workers one that others have, too."""
    return list(cores[place::workers]) or [cores[place % len(cores)]]


def keep_to(cores: Sequence[int]) -> None:
    """Have all threads that this process has, and those that they start, run on some cores alone."""
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(OSError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread.name), cores)


def _cores() -> list[int]:
    """Cores that this process may use; none where the system deals them out itself."""
    known = hasattr(os, "sched_getaffinity") and Path("/proc/self/task").is_dir()
    return sorted(os.sched_getaffinity(0)) if known else []


def _accelerators() -> list[str]:
    """Names of the CUDA devices that this process may use."""
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return [name for name in chosen.split(",") if name]
    return sorted(path.name.removeprefix("nvidia") for path in Path("/dev").glob("nvidia[0-9]*"))
