"""Compiled programs: made once for the shapes that they are given, several at a time, kept while they are used, truly let go.

A program is traced where it is asked for and compiled beside that, on threads of its own; who calls it waits for it. JAX keeps
what it compiled for as long as the compiled function lives: so each program is a function of its own, and goes with it.

Every compiled kernel takes some three memory maps. On Linux a process that maps more areas than `vm.max_map_count` gets no more,
and the compiler then ends it without an exception. So who compiles asks beforehand whether there is room. Elsewhere there is no
such limit, and nothing is asked.

glibc keeps what each thread has freed for that thread's next use. XLA compiles on many threads: of the 800 MiB that a process
holds after its first frames 570 are of that kind. And each thread's part of the heap keeps up to 64 MiB at its end, however often
it is asked for all.
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
"""What makes XLA compile for CPUs in 0.6 of the time, into a third of the memory maps: all kernels in one module, by the older
of its two emitters. Of the stages so compiled none runs for longer; the march would take four times as long."""
WIDELY: dict[str, Any] = {"xla_cpu_prefer_vector_width": 512}
"""What makes it fill the widest registers: sums over many windows side by side take 0.6 of the time where these are 512 bits."""
OF_ALL: dict[str, Any] = {}
"""Options that all programs are compiled with, part of what they are kept by: none but where somebody sets them."""
MAX_PROGRAMS = 128  # those of about fourteen frames of different shapes: some 20,000 memory maps of 65,530, and 600 MB

FLAGS = (
    "jax_enable_x64",
    "jax_default_device",
    "jax_default_matmul_precision",
    "jax_debug_nans",
    "jax_debug_infs",
    "jax_numpy_dtype_promotion",
)
"""Settings of JAX's that a program is compiled under."""

Cached = TypeVar("Cached")
IN_USE = Path("/proc/self/maps")
LIMIT = Path("/proc/sys/vm/max_map_count")
CROWDED = 0.5  # share of the limit beyond which compiled programs are to be let go: a frame with gradients takes 0.05


@dataclasses.dataclass(frozen=True)
class Program:
    """A function of fixed shapes, compiled or on the way.

    Attributes:
        result: shapes of what it returns.
        compiled: where it is to be found.
    """

    result: Any
    compiled: Future[Callable[..., Any]]

    def __call__(self, *arguments: Any) -> Any:
        """Run it, once it is compiled."""
        return self.compiled.result()(*arguments)


class Programs:
    """The programs of a process, the least recently used of which goes when there are too many."""

    def __init__(self, most: int = MAX_PROGRAMS) -> None:
        self._most = most
        self._kept: collections.OrderedDict[Hashable, Program] = collections.OrderedDict()
        self._lock = threading.RLock()
        self._counting = threading.Lock()  # of its own, as who has compiled a program is not to wait for who traces the next
        self._compiling = 0
        self._let_go = False
        self._warned = False
        self.on_compile: Callable[[], None] | None = None  # is called whenever a program begins to be compiled

    def __len__(self) -> int:
        return len(self._kept)

    def has(self, function: Any, shapes: tuple[Any, ...], static: dict[str, Hashable]) -> bool:
        """Whether the program of a jitted `function` for arguments of such shapes is at hand."""
        return _key(function, shapes, static) in self._kept

    def get(self, function: Any, shapes: tuple[Any, ...], static: dict[str, Hashable]) -> Program:
        """The program of a jitted `function` for arguments of such shapes (`shapes_of`); its compilation has begun at least."""
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
            found = None if name is None else store.found(name, shapes)
            lowered, result = None, found and found[0]
            if found is None:
                if self.on_compile is not None:
                    self.on_compile()
                traced = jax.jit(program).trace(*shapes)
                result = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), traced.out_info)
                lowered = traced.lower()
            made = self._kept[key] = Program(result, Future())
            with self._counting:
                self._compiling += 1
        made.compiled.add_done_callback(functools.partial(self._compiled, key))

        def work() -> None:
            try:
                loaded, loads = found and found[1](), store.num_loaded()
                compiled = loaded or _compile(lowered or jax.jit(program).lower(*shapes), options)
                made.compiled.set_result(compiled)
            except BaseException as error:
                made.compiled.set_exception(error)
            else:  # who waits goes on meanwhile
                if name is not None and not loaded and store.num_loaded() == loads:  # what JAX has loaded is not whole
                    store.keep_whole(name, compiled, result)

        _threads().submit(work)
        return made

    def make_room(self) -> None:
        """Let go of programs as long as the process holds too many memory maps; never of those that are not jaxsph's."""
        with self._lock:
            keep()  # for other processes, as of the first that is compiled
            while self._kept and crowded():
                for _ in range(-(-len(self._kept) // 2)):
                    self._kept.popitem(last=False)
                gc.collect()
            if not crowded():
                return
            for let_go in _LET_GO:
                let_go()
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
        """Let go of all."""
        with self._lock:
            self._kept.clear()
        gc.collect()

    def _compiled(self, key: Hashable, compiled: Future[Any]) -> None:
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
    """What a program is looked up by; last the options that it is compiled with."""
    leaves, structure = jax.tree.flatten(shapes)
    place = next((leaf.sharding for leaf in leaves if leaf.sharding is not None), None)
    default = getattr(jax.config, store.DEVICE) or jax.default_backend()
    chosen = default if place is None else next(iter(place.device_set))
    platform = getattr(chosen, "platform", chosen)  # "cpu" beside an accelerator, too
    options = _OPTIONS.get(function, {}) | OF_ALL if platform == "cpu" else {}
    flags = tuple(getattr(jax.config, name) for name in FLAGS)
    return function, tuple(sorted(static.items())), structure, tuple(leaves), flags, tuple(sorted(options.items()))


def place_of(arguments: Any) -> jax.sharding.Sharding | None:
    """Where arrays are, if that was chosen for any of them."""
    known = (leaf for leaf in jax.tree.leaves(arguments) if isinstance(leaf, jax.Array) and not is_traced(leaf))
    return next((leaf.sharding for leaf in known if leaf.committed), None)


def shapes_of(arguments: Any, place: jax.sharding.Sharding | None = None) -> Any:
    """Arrays as shapes and dtypes, all in one place."""
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(np.shape(leaf), leaf.dtype, sharding=place), arguments)


_OPTIONS: dict[Any, dict[str, Any]] = {}
_LET_GO: list[Callable[[], None]] = []


def kept_while_there_is_room(cached: Cached) -> Cached:
    """Mark a cache of functions that hold programs of their own as one to empty where memory maps are short."""
    _LET_GO.append(cached.cache_clear)  # type: ignore[attr-defined]
    return cached


def stage(*static: str, quickly: bool = False, widely: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Jit a function as a stage of a frame, tuned by its keyword `tuning` if it has that; see `QUICKLY` and `WIDELY`."""

    def made(function: Callable[..., Any]) -> Any:
        tuned = ("tuning",) if "tuning" in inspect.signature(function).parameters else ()
        jitted = jax.jit(function, static_argnames=(*static, *tuned))
        if quickly or widely:
            _OPTIONS[jitted] = QUICKLY if quickly else WIDELY
        return jitted

    return made


def barriers_of(static: dict[str, Any]) -> contextlib.AbstractContextManager[None]:
    """While the function of a stage is traced: with barriers against fusion where its tuning says so, or it has none."""
    return barriers("tuning" not in static or static["tuning"].fusion_barriers)


def _compile(lowered: jax.stages.Lowered, options: dict[str, Any]) -> Callable[..., Any]:
    try:
        return lowered.compile(compiler_options=options)
    except jax.errors.JaxRuntimeError as error:  # options are XLA's own affair, and come and go with its versions
        known = {name: value for name, value in options.items() if name not in str(error)}
        return _compile(lowered, known) if len(known) < len(options) else lowered.compile()


@functools.cache
def _threads() -> ThreadPoolExecutor:
    """Threads that compile: XLA holds no lock of Python's meanwhile, and uses little more than one core for a program."""
    return ThreadPoolExecutor(min(max(cores_at_hand(), 2), 8), "jaxsph-compile")


def in_use() -> int | None:
    """Memory maps that this process holds; None where that cannot be known."""
    try:
        return IN_USE.read_bytes().count(b"\n")
    except OSError:
        return None


def limit() -> int | None:
    """Memory maps that a process may hold; None where there is no limit, or none known."""
    try:
        return int(LIMIT.read_text())
    except (OSError, ValueError):
        return None


def crowded() -> bool:
    """Whether more is in use than `CROWDED` of what there may be."""
    most = limit()
    return most is not None and (in_use() or 0) > CROWDED * most


def give_back() -> None:
    """Ask the C library to return to the system what is free; where it cannot be asked, nothing happens."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # another C library than glibc
        ctypes.CDLL(None).malloc_trim(0)
