"""What is compiled is kept for the next process, in the user's cache folder: by JAX, and programs whole, so as not to be traced.

JAX's persistent compilation cache knows a program by what tracing and lowering it gives, which takes a second for a cast. So
programs are kept a second time, compiled, under all that they are made from: the code of this package, the shapes, all that is
static, JAX's settings and versions, the machine. What could change unnoticed is traced anew: where something static is of another
package, as an integrator of the user's may be, and where anything of this one was replaced in this process.

What is kept is run later, so the folder is this user's alone. Where JAX is told of a folder, by `JAX_COMPILATION_CACHE_DIR` or
its config, that is taken as it is, with all that JAX's own variables say of it, and by JAX alone; and nothing is kept where that
is empty, or `JAX_ENABLE_COMPILATION_CACHE` is 0.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import functools
import hashlib
import os
import pickle
import platform
import re
import sys
import tempfile
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import jax
import jaxlib
import numpy as np
import platformdirs
from jax.experimental import serialize_executable

from jaxsph.engine.runtime.tuning import cores_at_hand

CHOSEN_BY_USER = "JAX_COMPILATION_CACHE_DIR"
ENABLED, FOLDER = "jax_enable_compilation_cache", "jax_compilation_cache_dir"
MAX_BYTES = 1 << 27  # a frame's programs take about 1 MB; the least recently used go first; and as many bytes of those kept whole
ROOM = 1 << 20  # bytes that can be written where there is room for any
BROKEN = re.compile(r"Error reading persistent compilation cache entry for '([\w.-]+)'")
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
        _remove(name)
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


_FIRST: dict[str, dict[Any, Any]] = {}
"""Of each module of this package what it held when it was first seen."""


def _replaced() -> bool:
    """Whether a function, a class, a method or a constant of this package is another than it was."""
    replaced = False
    for module in [module for name, module in list(sys.modules.items()) if name.split(".")[0] == "jaxsph"]:
        held: dict[Any, Any] = {name: value for name, value in dict(vars(module)).items() if name.isupper() or callable(value)}
        for one in [one for one in held.values() if isinstance(one, type) and one.__module__ == module.__name__]:
            held |= {(one, name): value for name, value in vars(one).items() if not name.startswith("__")}
        first = _FIRST.setdefault(module.__name__, held)
        replaced |= any(held.get(name) is not value for name, value in first.items())
    return replaced


_replaced()  # what is imported by now is as it is in the files


@functools.cache
def _origin() -> str:
    """What programs of this package are made from besides their arguments. Raises `TypeError`: its code is not to be known."""
    code, files = hashlib.blake2b(digest_size=DIGEST), sorted(PACKAGE.rglob("*.py"))
    if max((file.stat().st_mtime for file in files), default=np.inf) > STARTED:
        raise TypeError(f"the code in {PACKAGE} is not there, or was changed since it was imported")
    for file in files:
        code.update(str(file.relative_to(PACKAGE)).encode() + file.read_bytes())
    features = platform.processor()
    with contextlib.suppress(OSError):
        features = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags")), features)
    of_machine = platform.machine(), features, cores_at_hand(), os.environ.get("XLA_FLAGS", "")
    return repr((code.hexdigest(), sys.version, jax.__version__, jaxlib.__version__, np.__version__, of_machine))


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=DIGEST).hexdigest()


@functools.cache
def keep() -> bool:
    """Have JAX keep what this process compiles from now on, unless somebody has chosen otherwise; whether it does.

    Warns:
        UserWarning: the folder cannot be used.
    """
    if not getattr(jax.config, ENABLED):
        return False
    if is_chosen():
        return bool(getattr(jax.config, FOLDER))
    place = _own()
    try:
        _make_own(place)
    except OSError as error:
        why = f"compiled programs are not kept, as {place} cannot be used: {error.strerror}; name another by {CHOSEN_BY_USER}"
        warnings.warn(why, UserWarning, stacklevel=2)
        return False
    jax.config.update(FOLDER, str(place))
    jax.config.update("jax_compilation_cache_max_size", MAX_BYTES)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    return True


def is_chosen() -> bool:
    """Whether somebody has told JAX where to keep programs, or that it is nowhere."""
    told = getattr(jax.config, FOLDER)
    return CHOSEN_BY_USER in os.environ or (bool(told) and told != str(_own()))


def folder() -> Path:
    """Where compiled programs are kept."""
    return Path(getattr(jax.config, FOLDER) or _own())


def _own() -> Path:
    return platformdirs.user_cache_path("jaxsph") / "compiled"


def _make_own(place: Path) -> None:
    """Make a folder that this user alone can enter, whatever the umask; what others have put into it goes.

    Raises `OSError`: it cannot be made or written to, or it or the one that it is in is another user's.
    """
    if not place.is_absolute():
        raise FileNotFoundError(errno.ENOENT, "no home folder is known")
    before = os.umask(0o077)
    try:
        place.mkdir(parents=True, exist_ok=True)
    finally:
        os.umask(before)
    for path in (place.parent, place) if os.name == "posix" else ():
        if {path.lstat().st_uid, path.stat().st_uid} != {os.geteuid()}:
            raise PermissionError(errno.EPERM, f"{path} belongs to another user; remove it")
        if path.stat().st_mode & 0o077:
            path.chmod(0o700)
            for entry in path.iterdir():
                if path == place and entry.lstat().st_uid != os.geteuid():
                    entry.unlink()
    with tempfile.TemporaryFile(dir=place, buffering=0) as probe:  # a full disk takes names, and no more
        if probe.write(bytes(ROOM)) < ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def mended(warning: str) -> bool:
    """Whether a warning of JAX is of an entry that cannot be read; such ones are removed, so that they are written anew.

    JAX says of which program it is, not of which of its entries: all of them go.
    """
    said = BROKEN.match(warning)
    if said is None:
        return False
    _remove(f"{said[1]}-*-cache")
    return True


def _remove(pattern: str) -> None:
    for path in folder().glob(pattern):
        with contextlib.suppress(OSError):  # another process may have removed it
            path.rmdir() if path.is_dir() else path.unlink()
