"""Compiled programs of stages: one for each combination of shapes and static arguments, cached while they are used.

Flow: Clock -> [programs: Programs.get] -> Program -> Clock; beside it `store` keeps programs for other processes.

`Programs.get` traces a stage on the thread that asks for it, and compiles it on a thread of a pool; whoever calls the program
waits until it is compiled. JAX keeps what it compiled for as long as the jitted function lives. So each program is a jitted
function of its own: when the cache drops it, its memory is free.

Every compiled kernel takes about three memory maps. On Linux a process may hold at most `vm.max_map_count` of them, and the
compiler ends the process without an exception when it gets no more. So `make_room` drops programs before another is compiled.
Other systems have no such limit, and there nothing is dropped for it.

glibc keeps what each thread has freed for that thread's next use, and XLA compiles on many threads: of the 800 MiB that a process
holds after its first frames 570 are such memory. `give_back` returns it; up to 64 MiB a thread stay, however often it is called.
"""

from __future__ import annotations

import collections
import contextlib
import ctypes
import dataclasses
import functools
import gc
import inspect
import threading
import warnings
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np

from jaxsph.engine.runtime import store
from jaxsph.engine.runtime.kept import keep
from jaxsph.engine.runtime.tuning import cores_at_hand
from jaxsph.numerics.checks import is_traced
from jaxsph.numerics.compiled import barriers

QUICKLY: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False, "xla_cpu_parallel_codegen_split_count": 1}
"""XLA options with which it compiles for CPUs in 0.6 of the time and into a third of the memory maps: all kernels in one module,
by the older of its two emitters. The stages marked `quickly` run no longer with them; the march would take four times as long."""
WIDELY: dict[str, Any] = {"xla_cpu_prefer_vector_width": 512}
"""XLA options with which it uses the widest registers: sums over many windows take 0.6 of the time if these have 512 bits."""
OF_ALL: dict[str, Any] = {}
"""XLA options for all programs, part of their keys: empty unless a test or a benchmark sets some."""
MAX_PROGRAMS = 128  # of about fourteen frames of different shapes: some 20,000 memory maps of 65,530, and 600 MB

FLAGS = (
    "jax_enable_x64",
    "jax_default_device",
    "jax_default_matmul_precision",
    "jax_debug_nans",
    "jax_debug_infs",
    "jax_numpy_dtype_promotion",
)
"""JAX's own settings that change what is compiled, part of the keys of programs."""

Cached = TypeVar("Cached")
IN_USE = Path("/proc/self/maps")
LIMIT = Path("/proc/sys/vm/max_map_count")
CROWDED = 0.5  # share of the limit beyond which `make_room` drops programs: a frame with gradients takes 0.05


@dataclasses.dataclass(frozen=True)
class Program:
    """A stage for fixed shapes and static arguments, compiled or being compiled.

    Attributes:
        result: shapes of what it returns, known before it is compiled.
        compiled: the future of the compiled function.
    """

    result: Any
    compiled: Future[Callable[..., Any]]

    def __call__(self, *arguments: Any) -> Any:
        """Wait until it is compiled, and run it."""
        return self.compiled.result()(*arguments)


class Programs:
    """A cache of programs, one for a process, which drops the least recently used when it is full."""

    def __init__(self, most: int = MAX_PROGRAMS) -> None:
        self._most = most
        self._kept: collections.OrderedDict[Hashable, Program] = collections.OrderedDict()
        self._lock = threading.RLock()
        self._counting = threading.Lock()  # apart from `_lock`, which is held while the next program is traced
        self._compiling = 0  # programs that are being compiled
        self._let_go = False  # whether programs were dropped since `give_back` last ran
        self._warned = False
        self.on_compile: Callable[[], None] | None = None  # called whenever a program is to be traced and compiled

    def __len__(self) -> int:
        return len(self._kept)

    def has(self, function: Any, shapes: tuple[Any, ...], static: dict[str, Hashable]) -> bool:
        """Whether the program of a stage for arguments of such shapes (`shapes_of`) is in the cache."""
        return _key(function, shapes, static) in self._kept

    def get(self, function: Any, shapes: tuple[Any, ...], static: dict[str, Hashable]) -> Program:
        """The program of a stage for arguments of such shapes (`shapes_of`): cached, loaded from the store, or newly traced.

        It may still be loading or compiling when this returns.
        """
        key = _key(function, shapes, static)
        options = dict(key[-1])

        def program(*arguments: Any) -> Any:
            with barriers_of(static):
                return function.__wrapped__(*arguments, **static)

        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
            while len(self._kept) >= self._most:
                self._kept.popitem(last=False)
                self._let_go = True
            self.make_room()
            name = store.known_by(function, shapes, static, key[4:])
            program.__name__ = function.__name__ if name is None else store.called(function)
            stored = None if name is None else store.found(name, shapes)
            lowered, result = None, stored and stored[0]
            if stored is None:
                if self.on_compile is not None:
                    self.on_compile()
                traced = jax.jit(program).trace(*shapes)
                result = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), traced.out_info)
                lowered = traced.lower()
            entry = self._kept[key] = Program(result, Future())
            with self._counting:
                self._compiling += 1
        entry.compiled.add_done_callback(functools.partial(self._when_compiled, key))

        def work() -> None:
            try:
                loaded, loads = stored and stored[1](), store.num_loaded()
                compiled = loaded or _compile(lowered or jax.jit(program).lower(*shapes), options)
                entry.compiled.set_result(compiled)
            except BaseException as error:
                entry.compiled.set_exception(error)
            else:  # whoever waits for the program goes on while it is written
                if name is not None and not loaded and store.num_loaded() == loads:  # what JAX loaded cannot be serialized
                    store.keep_whole(name, compiled, result)

        _threads().submit(work)
        return entry

    def make_room(self) -> None:
        """Drop programs of jaxsph's, half of the cache at a time, while the process holds too many memory maps.

        Warns:
            UserWarning: once, if they are still too many, in programs that are not jaxsph's.
        """
        with self._lock:
            keep()  # before the first program is compiled
            while self._kept and crowded():
                for _ in range(-(-len(self._kept) // 2)):
                    self._kept.popitem(last=False)
                gc.collect()
            if not crowded():
                return
            for clear_cache in _LET_GO:
                clear_cache()
            gc.collect()
            if crowded() and not self._warned:
                self._warned = True
                warnings.warn(
                    f"this process holds over {CROWDED:.0%} of the {limit()} memory maps that it may "
                    "have, in programs that are not jaxsph's own, and ends without a word when it needs more: call "
                    "`jax.clear_caches()`, and jit functions once instead of anew",
                    stacklevel=3,
                )

    def clear(self) -> None:
        """Drop all programs."""
        with self._lock:
            self._kept.clear()
        gc.collect()

    def _when_compiled(self, key: Hashable, compiled: Future[Any]) -> None:
        """Forget a program that failed to compile; after the last one of several, return memory if any were dropped."""
        if compiled.cancelled() or compiled.exception() is not None:
            with self._lock:
                self._kept.pop(key, None)
        with self._counting:
            self._compiling -= 1
            tidy = self._let_go and self._compiling == 0
            self._let_go &= not tidy
        if tidy:  # it takes a tenth of a second, which the first frames of a process need not wait for
            give_back()


PROGRAMS = Programs()


def _key(function: Any, shapes: tuple[Any, ...], static: dict[str, Hashable]) -> tuple[Any, ...]:
    """The key of a program in the cache; its last entry holds the options that it is compiled with."""
    leaves, structure = jax.tree.flatten(shapes)
    place = next((leaf.sharding for leaf in leaves if leaf.sharding is not None), None)
    default = getattr(jax.config, store.DEVICE) or jax.default_backend()
    chosen = default if place is None else next(iter(place.device_set))
    platform = getattr(chosen, "platform", chosen)  # "cpu" beside an accelerator, too
    options = _OPTIONS.get(function, {}) | OF_ALL if platform == "cpu" else {}
    flags = tuple(getattr(jax.config, name) for name in FLAGS)
    return function, tuple(sorted(static.items())), structure, tuple(leaves), flags, tuple(sorted(options.items()))


def place_of(arguments: Any) -> jax.sharding.Sharding | None:
    """The sharding of the first array that was put on a device by choice; None if all are where JAX puts arrays by default."""
    known = (leaf for leaf in jax.tree.leaves(arguments) if isinstance(leaf, jax.Array) and not is_traced(leaf))
    return next((leaf.sharding for leaf in known if leaf.committed), None)


def shapes_of(arguments: Any, place: jax.sharding.Sharding | None = None) -> Any:
    """Shapes and dtypes of arrays, all with the sharding `place`: what a program is traced by."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), leaf.dtype, sharding=place), arguments)


_OPTIONS: dict[Any, dict[str, Any]] = {}
"""Options of the stages that were marked `quickly` or `widely`, by their jitted function."""
_LET_GO: list[Callable[[], None]] = []
"""Functions that empty other caches of programs, see `clear_when_crowded`."""


def clear_when_crowded(cached: Cached) -> Cached:
    """Mark a `functools` cache of jitted functions as one that `Programs.make_room` empties where memory maps are short."""
    _LET_GO.append(cached.cache_clear)  # type: ignore[attr-defined]
    return cached


def stage(*static: str, quickly: bool = False, widely: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Mark a function as a stage of a frame: jit it, with the arguments named `static`, and `tuning` if it has that, static.

    `quickly` and `widely` choose options of XLA's for CPUs, see `QUICKLY` and `WIDELY`. A stage is called through a `Clock`.
    """

    def jit_stage(function: Callable[..., Any]) -> Any:
        tuning = ("tuning",) if "tuning" in inspect.signature(function).parameters else ()
        jitted = jax.jit(function, static_argnames=(*static, *tuning))
        if quickly or widely:
            _OPTIONS[jitted] = QUICKLY if quickly else WIDELY
        return jitted

    return jit_stage


def barriers_of(static: dict[str, Any]) -> contextlib.AbstractContextManager[None]:
    """The context to trace a stage in: with fusion barriers if its tuning says so, or if it has no tuning."""
    return barriers("tuning" not in static or static["tuning"].fusion_barriers)


def _compile(lowered: jax.stages.Lowered, options: dict[str, Any]) -> Callable[..., Any]:
    """Compile with XLA options; without those that this version of XLA does not know."""
    try:
        return lowered.compile(compiler_options=options)
    except jax.errors.JaxRuntimeError as error:
        known = {name: value for name, value in options.items() if name not in str(error)}
        return _compile(lowered, known) if len(known) < len(options) else lowered.compile()


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Threads that compile: XLA releases Python's lock meanwhile, and uses little more than one core for a program."""
    return ThreadPoolExecutor(min(max(cores_at_hand(), 2), 8), "jaxsph-compile")


def in_use() -> int | None:
    """How many memory maps this process holds; None where that cannot be known."""
    try:
        return IN_USE.read_bytes().count(b"\n")
    except OSError:
        return None


def limit() -> int | None:
    """How many memory maps a process may hold; None where there is no limit, or none known."""
    try:
        return int(LIMIT.read_text())
    except (OSError, ValueError):
        return None


def crowded() -> bool:
    """Whether the process holds more memory maps than the share `CROWDED` of its limit."""
    most = limit()
    return most is not None and (in_use() or 0) > CROWDED * most


def give_back() -> None:
    """Ask glibc to return free memory to the system; with another C library nothing happens."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library than glibc
        ctypes.CDLL(None).malloc_trim(0)
