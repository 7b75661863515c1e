"""The folder in which JAX's compilation cache and `store` keep compiled programs for the next process.

Flow: [kept: keep, folder] -> programs, store.

It is a folder of the user's own, which nobody else can write to, as its files are run later. If the user has told JAX of another,
by `JAX_COMPILATION_CACHE_DIR` or JAX's config, that is used as it is, with all that JAX's own variables say of it; and then
`store` keeps nothing. Nothing at all is kept if that name is empty, or `JAX_ENABLE_COMPILATION_CACHE` is 0.
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
MAX_BYTES = 1 << 27  # of JAX's entries, and as many of those of `store`: a frame's programs take about 1 MB
ROOM = 1 << 20  # bytes that are written for a test of whether the disk is full
BROKEN = re.compile(r"Error reading persistent compilation cache entry for '([\w.-]+)'")


@functools.cache
def keep() -> bool:
    """Have JAX keep in the folder what this process compiles from now on, unless the user has chosen otherwise.

    Returns:
        Whether compiled programs are kept.

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
    """Whether the user has told JAX where to keep programs, or not to keep any."""
    chosen = getattr(jax.config, FOLDER)
    return CHOSEN_BY_USER in os.environ or (bool(chosen) and chosen != str(_own()))


def folder() -> Path:
    """The folder in which compiled programs are kept."""
    return Path(getattr(jax.config, FOLDER) or _own())


def _own() -> Path:
    return platformdirs.user_cache_path("jaxsph") / "compiled"


def _make_own(place: Path) -> None:
    """Make a folder that this user alone can enter, whatever the umask, and remove files that others have put into it.

    Raises `OSError`: the folder cannot be made or written to, or it or its parent belongs to another user.
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
    with tempfile.TemporaryFile(dir=place, buffering=0) as probe:  # on a full disk files can be made, but not written to
        if probe.write(bytes(ROOM)) < ROOM:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def mended(warning: str) -> bool:
    """Remove the entries that a warning of JAX says it cannot read, so that they are written anew; whether it was such a warning.

    JAX names the program, not which of its entries: all of these are removed.
    """
    match = BROKEN.match(warning)
    if match is None:
        return False
    remove(f"{match[1]}-*-cache")
    return True


def remove(pattern: str) -> None:
    """Remove files and empty folders of the folder whose names match a pattern."""
    for path in folder().glob(pattern):
        with contextlib.suppress(OSError):  # another process may have removed it
            path.rmdir() if path.is_dir() else path.unlink()
