"""The folder that JAX keeps compiled programs in for the next process: the user's own, unless somebody has chosen another.

What is kept is run later, so the folder is this user's alone. Where JAX is told of a folder, by `JAX_COMPILATION_CACHE_DIR` or
its config, that is taken as it is, with all that JAX's own variables say of it; and nothing is kept where that is empty, or
`JAX_ENABLE_COMPILATION_CACHE` is 0.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import tempfile
import warnings
from pathlib import Path

import jax
import platformdirs

CHOSEN_BY_USER = "JAX_COMPILATION_CACHE_DIR"
ENABLED, FOLDER = "jax_enable_compilation_cache", "jax_compilation_cache_dir"
MAX_BYTES = 1 << 27  # a frame's programs take about 1 MB; the least recently used go first; and as many bytes of those kept whole
ROOM = 1 << 20  # bytes that can be written where there is room for any
BROKEN = re.compile(r"Error reading persistent compilation cache entry for '([\w.-]+)'")


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
    remove(f"{said[1]}-*-cache")
    return True


def remove(pattern: str) -> None:
    """Files of the folder, and folders in it."""
    for path in folder().glob(pattern):
        with contextlib.suppress(OSError):  # another process may have removed it
            path.rmdir() if path.is_dir() else path.unlink()
