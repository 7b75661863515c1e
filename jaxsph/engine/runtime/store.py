"""Programs that are kept compiled, so that the next process has nothing to trace: beside JAX's own cache, which needs the trace.

JAX's persistent compilation cache knows a program by what tracing and lowering it gives, which takes a second for a cast. So
programs are kept a second time, under all that they are made from: the files of this package, by size and time; the shapes, all
that is static, JAX's settings and versions, the machine. What could change unnoticed is traced anew: where something static is of
another package, as an integrator of the user's may be, and where anything of this one was replaced in this process.
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
QUICKLY = 1  # to a quarter, in a hundredth of a second


def known_by(function: Any, arguments: Any, static: dict[str, Hashable], settings: Any) -> str | None:
    """The name of the file of a program that is kept whole: the same for what is compiled alike, in any process.

    Args:
        function: of which it is made.
        arguments: shapes of its arguments.
        static: keyword arguments that are static.
        settings: what it is compiled under.

    Returns None where none is kept: no folder of this user's own is in use; on accelerators; for devices that were chosen; or
    where something that it is made from is not this package's, or was replaced.
    """
    if not keep() or is_chosen() or jax.default_backend() != "cpu" or getattr(jax.config, DEVICE) is not None or _replaced():
        return None
    try:
        told = _origin() + _told((function.__wrapped__, arguments, static, settings))
    except TypeError:
        return None
    return f"{function.__name__}-{_digest(told.encode())}{WHOLE}"


def found(name: str, arguments: Any) -> tuple[Any, Callable[[], Callable[..., Any] | None]] | None:
    """Of a program that is kept whole: shapes of what it returns, and what loads it, if it can be; or None."""
    path = folder() / name
    try:
        digest, content = path.read_bytes().split(b"\n", 1)
        if _digest(content).encode() != digest:
            raise ValueError(f"{path} is broken")
        result, compiled = pickle.loads(zlib.decompress(content))
        os.utime(path)
    except FileNotFoundError:
        return None
    except Exception:  # whatever the file may hold; it is traced anew
        remove(name)
        return None

    def load() -> Callable[..., Any] | None:
        structure = jax.tree.structure((arguments, {})), jax.tree.structure(result)
        devices = jax.local_devices(backend="cpu")[:1]
        with contextlib.suppress(Exception):  # of whatever kind XLA raises, of what is no program of this machine
            return serialize_executable.deserialize_and_load(compiled, *structure, execution_devices=devices)
        return None

    return result, load


def called(function: Any) -> str:
    """What a program is called that is kept whole, so that JAX takes none of other code, which it could not be kept of."""
    return f"{function.__name__}_{_digest(_origin().encode())[:8]}"


def num_loaded() -> int:
    """How many programs this thread has loaded from JAX's cache."""
    _listen()
    return getattr(_THREAD, "loaded", 0)


def keep_whole(name: str, program: Any, result: Any) -> None:
    """Keep a program whole, for others to find; what cannot be kept is not. Those that were not used for longest go."""
    with contextlib.suppress(Exception):
        content = zlib.compress(pickle.dumps((result, serialize_executable.serialize(program)[0])), QUICKLY)
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
    def heard(event: str, **_: Any) -> None:
        if event == LOADED:
            _THREAD.loaded = getattr(_THREAD, "loaded", 0) + 1

    jax.monitoring.register_event_listener(heard)


def _told(value: Any) -> str:
    """A text that is the same for equal values in any process. Raises `TypeError`: of values that are not of this package."""
    if isinstance(value, PLAIN):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, jax.ShapeDtypeStruct) and value.sharding is None:
        return f"{value.shape} {value.dtype} {value.weak_type}"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_told(key)}: {_told(value[key])}' for key in sorted(value))}}}"
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
    return f"{where}.{name}({', '.join(map(_told, parts))})"


Entry = tuple[Any, str, Any]  # what holds a name, the name, and what it holds
_FIRST: dict[str, list[Entry]] = {}
"""Of each module of this package what it held when it was first seen."""


def _entries(module: Any) -> Iterator[Entry]:
    """Functions, classes and constants of a module, and what its classes hold."""
    for name, value in list(vars(module).items()):
        if name.isupper() or callable(value):
            yield vars(module), name, value
        if isinstance(value, type) and value.__module__ == module.__name__:
            for part, held in list(vars(value).items()):
                if not part.startswith("__"):
                    yield vars(value), part, held


def _replaced() -> bool:
    """Whether a function, a class, a method or a constant of this package is another than it was."""
    for name in [name for name in sys.modules if name.split(".")[0] == "jaxsph" and name not in _FIRST]:
        _FIRST[name] = list(_entries(sys.modules[name]))
    return any(holder.get(name) is not value for entries in _FIRST.values() for holder, name, value in entries)


_replaced()  # what is imported by now is as it is in the files


@functools.cache
def _origin() -> str:
    """What programs of this package are made from besides their arguments. Raises `TypeError`: its code is not to be known."""
    files = sorted(PACKAGE.rglob("*.py"))
    code = [(str(file.relative_to(PACKAGE)), (told := file.stat()).st_size, told.st_mtime_ns) for file in files]
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
