"""A store of compiled programs on disk, from which the next process loads them without tracing.

Flow: Programs.get -> [store: known_by -> found] -> a loaded program; a newly compiled one -> [store: keep_whole] -> file.

JAX's persistent compilation cache names an entry by the lowered program, so it needs the trace, which takes a second for a cast.
This store names a file by all that a program is made from: the files of this package, by size and time; shapes and static
arguments; JAX's settings and versions; the machine. So it cannot name programs with parts whose code may change unnoticed: static
arguments of another package, such as a user's integrator, or anything of this package that was replaced in this process. Those
are traced each time.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
import pickle
import platform
import sys
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Hashable, Iterator
from pathlib import Path
from typing import Any

import jax
import jaxlib
import numpy as np
from jax.experimental import serialize_executable

from jaxsph.engine.runtime.kept import MAX_BYTES, folder, is_chosen, keep, remove
from jaxsph.engine.runtime.tuning import cores_at_hand

DEVICE = "jax_default_device"
LOADED = "/jax/compilation_cache/cache_hits"
WHOLE = ".program"
PACKAGE = Path(__file__).parents[2]
PLAIN = (type(None), bool, int, float, complex, str, bytes, np.dtype, np.generic)
DIGEST = 16
STARTED = time.time()
COMPRESSION = 1  # level of zlib: to a quarter of the size, in a hundredth of a second


def known_by(function: Any, arguments: Any, static: dict[str, Hashable], settings: Any) -> str | None:
    """The name of a program's file, which is the same in any process that would compile the same program.

    Args:
        function: the stage.
        arguments: shapes of its arguments.
        static: its static arguments.
        settings: JAX's settings and the options that it is compiled with.

    Returns:
        None if the program is not stored: no folder of this user's own is in use; it is for an accelerator, or for a device that
        was chosen; or it is made from anything that is not this package's, or that was replaced.
    """
    if not keep() or is_chosen() or jax.default_backend() != "cpu" or getattr(jax.config, DEVICE) is not None or _replaced():
        return None
    try:
        text = _origin() + _text_of((function.__wrapped__, arguments, static, settings))
    except TypeError:
        return None
    return f"{function.__name__}-{_digest(text.encode())}{WHOLE}"


def found(name: str, arguments: Any) -> tuple[Any, Callable[[], Callable[..., Any] | None]] | None:
    """Read the file of a program: shapes of what it returns, and a function that loads it, or returns None if it cannot.

    None where there is no such file, or a broken one, which is removed.
    """
    path = folder() / name
    try:
        digest, content = path.read_bytes().split(b"\n", 1)
        if _digest(content).encode() != digest:
            raise ValueError(f"{path} is broken")
        result, compiled = pickle.loads(zlib.decompress(content))
        os.utime(path)
    except FileNotFoundError:
        return None
    except Exception:  # the file may hold anything
        remove(name)
        return None

    def load() -> Callable[..., Any] | None:
        structure = jax.tree.structure((arguments, {})), jax.tree.structure(result)
        devices = jax.local_devices(backend="cpu")[:1]
        with contextlib.suppress(Exception):  # XLA raises various kinds for a program of another machine
            return serialize_executable.deserialize_and_load(compiled, *structure, execution_devices=devices)
        return None

    return result, load


def called(function: Any) -> str:
    """The name that JAX knows a stored program by, with a digest of the code.

    So JAX's own cache has no entry for it of other code; a program that JAX has loaded from there could not be serialized.
    """
    return f"{function.__name__}_{_digest(_origin().encode())[:8]}"


def num_loaded() -> int:
    """How many programs this thread has loaded from JAX's own cache so far."""
    _listen()
    return getattr(_THREAD, "loaded", 0)


def keep_whole(name: str, program: Any, result: Any) -> None:
    """Write a program to its file, and remove the least recently used files beyond `MAX_BYTES`; do nothing where that fails."""
    with contextlib.suppress(Exception):
        content = zlib.compress(pickle.dumps((result, serialize_executable.serialize(program)[0])), COMPRESSION)
        descriptor, temporary = tempfile.mkstemp(dir=folder(), suffix=WHOLE)
        with open(descriptor, "wb") as file:
            file.write(_digest(content).encode() + b"\n" + content)
        os.replace(temporary, folder() / name)
        used = sorted(((entry.stat().st_mtime, entry) for entry in folder().glob(f"*{WHOLE}")), reverse=True)
        sizes = np.cumsum([entry.stat().st_size for _, entry in used])
        for _, entry in used[int((sizes <= MAX_BYTES).sum()) :]:
            entry.unlink(missing_ok=True)


_THREAD = threading.local()


@functools.cache
def _listen() -> None:
    """Have JAX tell of programs that it loads from its own cache, once for all."""

    def count(event: str, **_: Any) -> None:
        if event == LOADED:
            _THREAD.loaded = getattr(_THREAD, "loaded", 0) + 1

    jax.monitoring.register_event_listener(count)


def _text_of(value: Any) -> str:
    """A text that is the same for equal values in any process; `TypeError` for values of classes that are not this package's."""
    if isinstance(value, PLAIN):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, jax.ShapeDtypeStruct) and value.sharding is None:
        return f"{value.shape} {value.dtype} {value.weak_type}"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_text_of(key)}: {_text_of(value[key])}' for key in sorted(value))}}}"
    named = value if hasattr(value, "__qualname__") else type(value)  # functions and classes by name, all else by its parts
    where, name = named.__module__, named.__qualname__
    if "<" in name or (where.split(".")[0] != "jaxsph" and named not in (tuple, list)):
        raise TypeError(f"{value!r} is not of this package")
    if named is value:
        return f"{where}.{name}"
    if dataclasses.is_dataclass(value):
        parts = [getattr(value, field.name) for field in dataclasses.fields(value)]
    else:
        parts = list(value) if isinstance(value, tuple | list) else list(vars(value).items())
    return f"{where}.{name}({', '.join(map(_text_of, parts))})"


Entry = tuple[Any, str, Any]
"""The names of a module or a class as a dictionary, one of these names, and the value that it had at first."""
_FIRST: dict[str, list[Entry]] = {}
"""Entries of each module of this package, when this module first looked at it."""


def _entries(module: Any) -> Iterator[Entry]:
    """Functions, classes and constants of a module, and attributes of its classes."""
    for name, value in list(vars(module).items()):
        if name.isupper() or callable(value):
            yield vars(module), name, value
        if isinstance(value, type) and value.__module__ == module.__name__:
            for part, held in list(vars(value).items()):
                if not part.startswith("__"):
                    yield vars(value), part, held


def _replaced() -> bool:
    """Whether any function, class, method or constant of this package has been replaced in this process."""
    for name in [name for name in sys.modules if name.split(".")[0] == "jaxsph" and name not in _FIRST]:
        _FIRST[name] = list(_entries(sys.modules[name]))
    return any(holder.get(name) is not value for entries in _FIRST.values() for holder, name, value in entries)


_replaced()  # modules that are imported by now are as their files say


@functools.cache
def _origin() -> str:
    """A text of what all programs depend on: code, versions and machine; `TypeError` if the code is not what was imported."""
    files = sorted(PACKAGE.rglob("*.py"))
    code = [(str(file.relative_to(PACKAGE)), (status := file.stat()).st_size, status.st_mtime_ns) for file in files]
    if max((changed for *_, changed in code), default=np.inf) > STARTED * 1e9:
        raise TypeError(f"the code in {PACKAGE} is not there, or was changed since it was imported")
    try:
        features = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags"))
    except (OSError, StopIteration):
        features = platform.processor()
    of_machine = platform.machine(), features, cores_at_hand(), os.environ.get("XLA_FLAGS", "")
    return repr((code, sys.version, jax.__version__, jaxlib.__version__, np.__version__, of_machine))


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=DIGEST).hexdigest()
