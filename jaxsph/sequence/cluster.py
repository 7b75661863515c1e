"""Frames on workers of Dask's, of a cluster or processes of this machine: read, rendered and written there, told of here.

Flow: FrameTask -> [an executor: bytes -> worker -> outcome] -> images or files, in order.

One worker makes the plan of the first frame, and all compile for that; where a frame outgrows it, the plan that its worker made
goes with later frames. Room changes no bit of an image, and all else in a plan is the first frame's: so images are the same bits
as those that are rendered without a cluster.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import pickle
import signal
import threading
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from pathlib import Path
from typing import Any

import jax

from jaxsph.engine.planning.plan import Plan
from jaxsph.io.damage import require
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics import __version__
from jaxsph.sequence.snapshots import Moment
from jaxsph.sequence.task import FrameFile, FrameTask, GrowingPlan, UnwritableError, fingerprint_of, rendered, unmade, written

distributed = require("distributed", "frames on several processes", "cluster")
dask: Any = require("dask", "frames on several processes", "cluster")
cloudpickle: Any = require("cloudpickle", "frames on several processes", "cluster")
WorkerPlugin: Any = distributed.WorkerPlugin
AHEAD = 2  # frames a worker that are on the way: one that is rendered, one that waits
RETRIES = 2  # how often a frame is tried again that failed by anything but its data, such as a file system that was away
SHARED = 4  # scenes and sequences that are kept by the cluster, the latest: frames come from few
GONE = "the scheduler of the cluster is gone ({}); frames that are written stay"
EVERY = 1.0  # seconds from one look at whether the scheduler is there to the next
LARGE = "distributed.admin.large-graph-warning-threshold"
CLOSING = 10.0  # seconds that workers have to end by themselves; those that compile do not hear, and are killed
PROFILE = "distributed.worker.profile.enabled"
"""Whether Dask looks at what its workers are at, 100 times a second: half of what idle ones use, and nobody reads it here."""
CACHE = (
    "jax_enable_compilation_cache",
    "jax_compilation_cache_dir",
    "jax_compilation_cache_max_size",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)  # what JAX is told of compiled programs that are kept: workers share them with the process that starts them
Outcome = tuple[FrameFile | bytes | None, Plan | None, Exception | None]
"""What became of a frame: its file, or its image as bytes; the plan that the worker had after it; what is wrong with its data."""


def frames_on(client: Any, tasks: Iterator[FrameTask], ahead: Sequence[Camera]) -> Iterator[Any]:
    """Images of all frames, or their files, in order, of which no more are on the way than keeps workers busy."""
    workers, way, trouble, more = _Workers(client, ahead), list[tuple[FrameTask, Future[Outcome]]](), None, True
    try:
        while more or way:
            while more and workers.have_room(way):
                try:
                    task = next(tasks, None)
                except Exception as error:  # told of after the frames before it
                    task, trouble = None, error
                more = task is not None
                if task is not None:
                    way.append((task, workers.begun(task)))
            if way and way[0][1].done():
                yield workers.made(*way.pop(0))
            elif way:
                workers.wait([found for _, found in way])
    except OSError as error:  # what is wrong with a frame is in its outcome
        raise RuntimeError(GONE.format(type(error).__name__)) from error
    finally:
        for _, found in way if client.status == "running" else ():
            found.cancel()
    if trouble is not None:
        raise trouble


class _Workers:
    """The workers of a client, the plan that they share, and what they are sent once."""

    def __init__(self, client: Any, ahead: Sequence[Camera]) -> None:
        self._client, self._executor = client, client.get_executor(pure=False, retries=RETRIES)
        self._plan, self._x64 = GrowingPlan(ahead), jax.config.read("jax_enable_x64")
        self._kept: dict[int, tuple[Any, Any]] = {}  # by identity: what frames share, and where it is; the latest

    def have_room(self, way: Collection[tuple[FrameTask, Future[Outcome]]]) -> bool:
        """For one more frame, beside those on the way and the images that wait; what is told of files takes no room."""
        self._require_running()
        held = sum(task.output is None or not found.done() for task, found in way)
        return held < AHEAD * max(len(self._client.nthreads()), 1)

    def wait(self, futures: Collection[Future[Outcome]]) -> None:
        """Until something more becomes of one of some frames; plans that have grown go with those to come."""
        ahead = [found for found in futures if not found.done()]
        while ahead and not wait(ahead, EVERY, FIRST_COMPLETED).done:
            self._require_running()
        for found in futures:
            if found.done():
                self._outcome(found)

    def begun(self, task: FrameTask) -> Future[Outcome]:
        """What will become of a frame, sent once there is a plan; or what planning told of it."""
        if self._plan.first is None:
            planned = self._sent(task, alone=True)
            self.wait([planned])
            frame, _, error = self._outcome(planned)
            self._plan.first = task if error is None else None
            if frame is not None or error is not None:
                return planned
        return self._sent(task)

    def made(self, task: FrameTask, future: Future[Outcome]) -> Any:
        """The image of a frame, or its file; what no other frame would escape is raised."""
        frame, _, error = self._outcome(future)
        if error is not None and (task.output is None or isinstance(error, UnwritableError | ImportError)):
            raise error
        if isinstance(frame, bytes):
            with jax.enable_x64(self._x64):
                return pickle.loads(frame)
        assert task.output is not None
        return unmade(task, error) if frame is None else dataclasses.replace(frame, path=task.output)

    def _outcome(self, future: Future[Outcome]) -> Outcome:
        try:
            frame, plan, error = future.result()
            if plan is not None:  # the same one may be told of again
                self._plan.made = plan if self._plan.made is None else self._plan.made.grown(plan)
            return frame, plan, error
        except CancelledError:
            raise RuntimeError(GONE.format("cancelled")) from None
        except Exception as error:
            return None, None, error

    def _require_running(self) -> None:
        if self._client.status != "running":
            raise RuntimeError(GONE.format(self._client.status))

    def _sent(self, task: FrameTask, *, alone: bool = False) -> Future[Outcome]:
        """Have a frame made by some worker, which may stand in another folder; or planned for `alone`."""
        self._require_running()
        plan = self._plan if self._plan.made is None else GrowingPlan(made=self._plan.made)
        there = task if task.output is None else dataclasses.replace(task, output=task.output.absolute())
        shared: dict[str, Any] = {}
        sent, first = (self._apart(one, shared) for one in (there, plan.first))
        payload = cloudpickle.dumps((sent, dataclasses.replace(plan, first=first), alone))  # with functions of the user's script
        return self._submitted(self._executor, _do, __version__, self._x64, payload, shared)

    def _submitted(self, to: Any, *what: Any) -> Any:
        """Without Dask's advice on tasks of many bytes: a scene is sent once, and kept by the scheduler for workers to come."""
        with dask.config.set({LARGE: "1 PB"}):
            return to.submit(*what)

    def _apart(self, task: FrameTask | None, shared: dict[str, Any]) -> FrameTask | None:
        """A frame with the name of what it shares with others in its place, which is put by that name into `shared`."""
        if task is None or not isinstance(task.source, Moment):
            return task
        thing = task.source.snapshots
        if id(thing) not in self._kept:
            while len(self._kept) >= SHARED:
                del self._kept[next(iter(self._kept))]
            # as the result of a task it is made again where the workers that had it are gone
            self._kept[id(thing)] = thing, self._submitted(self._client, bytes, cloudpickle.dumps(thing))
        future = self._kept[id(thing)][1]
        shared[future.key] = future
        return dataclasses.replace(task, source=Moment(future.key, task.source.time))


_ONE = threading.Lock()
_OPENED: dict[str, Any] = {}  # of this worker: what the frames at hand share, by name


def _do(version: str, x64: bool, payload: bytes, shared: dict[str, bytes]) -> Outcome:
    """Make a frame or plan for it, on a worker: one at a time, as a frame takes all that its process has."""
    if version != __version__:
        raise ImportError(f"a worker has jaxsph {__version__}, but {version} is asked for; install the same on all")
    with _ONE, jax.enable_x64(x64):
        for name in _OPENED.keys() - shared.keys():
            del _OPENED[name]
        for name in shared.keys() - _OPENED.keys():
            _OPENED[name] = pickle.loads(shared[name])
        task, plan, alone = pickle.loads(payload)
        task, plan.first = (_whole(one) for one in (task, plan.first))
        try:
            return *(_planned if alone else _made)(task, plan), None
        except ValueError as error:
            return None, None, error


def _whole(task: FrameTask | None) -> Any:
    if task is None or not isinstance(task.source, Moment):
        return task
    return dataclasses.replace(task, source=Moment(_OPENED[str(task.source.snapshots)], task.source.time))


def _planned(task: FrameTask, plan: GrowingPlan) -> tuple[FrameFile | None, Plan | None]:
    """The plan that begins with a frame, unless that is there."""
    scene = None if hasattr(task.source, "fingerprint") else task.scene()
    if task.output is not None and fingerprint_of(task.output) == task.fingerprint(scene):
        return FrameFile(task.number, task.output, False, {}), None
    plan.first = task if scene is None else dataclasses.replace(task, source=scene)
    plan.begin()
    return None, plan.made


def _made(task: FrameTask, plan: GrowingPlan) -> tuple[FrameFile | bytes, Plan | None]:
    made = pickle.dumps(rendered(task, task.scene(), plan)) if task.output is None else written(task, plan)
    return made, plan.made


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
