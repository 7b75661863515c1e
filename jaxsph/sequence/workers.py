"""Processes of this machine that render frames: workers of Dask's, each with its share of the cores, or a device of its own.

Flow: number of workers -> [workers] -> distributed.Client -> frames_on_cluster.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax

from jaxsph.io.libraries import require

distributed = require("distributed", "frames on several processes", "cluster")
dask: Any = require("dask", "frames on several processes", "cluster")
WorkerPlugin: Any = distributed.WorkerPlugin
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
    share = Share(
        workers, _cores() if cores is None else cores, _accelerators(), {name: getattr(jax.config, name) for name in CACHE}
    )
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


class Share(WorkerPlugin):  # type: ignore[misc]
    """What a worker has of the machine; also of one that stands in for another that died, as it has the same name."""

    name = "jaxsph-share"

    def __init__(self, workers: int, cores: Sequence[int], accelerators: Sequence[str], config: dict[str, Any]) -> None:
        self._workers, self._cores, self._accelerators, self._config = workers, cores, accelerators, config

    def setup(self, worker: Any) -> None:
        """Keep to some cores; leave it to the process that started this one, which closes it, to hear of signals."""
        place = int(worker.name)
        with contextlib.suppress(ValueError):  # only the main thread may
            for number in (signal.SIGINT, signal.SIGTERM):  # those of a job get both at once, to all of its processes
                signal.signal(number, signal.SIG_IGN)
        for name, value in self._config.items():
            jax.config.update(name, value)
        if self._accelerators:
            os.environ["CUDA_VISIBLE_DEVICES"] = self._accelerators[place % len(self._accelerators)]
        if self._cores:
            keep_to(share_of(self._cores, place, self._workers))


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
