"""Compiled programs that the command line keeps for the next command, in the user's cache folder.

Flow: cli -> [cache] -> JAX's persistent compilation cache.

Programs that are kept are run later, so the folder is this user's alone. Where `JAX_COMPILATION_CACHE_DIR` names one, that is
taken as it is, with all that JAX's own variables say of it.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import jax.monitoring

from jaxsph.cli.voice import notice, say
from jaxsph.engine.runtime.programs import PROGRAMS

CHOSEN_BY_USER = "JAX_COMPILATION_CACHE_DIR"
MAX_BYTES = 1 << 28  # a frame's programs take about 1 MB; the least recently used go first
MISS = "/jax/compilation_cache/cache_misses"


def begin(*, keep: bool) -> None:
    """Keep what is compiled from now on, if that is wanted and the folder can be written; and say once that it is compiled."""
    if not keep:
        jax.config.update("jax_enable_compilation_cache", False)
        PROGRAMS.on_compile(_told_once("--no-cache: the next command will compile it again"))
        return
    if CHOSEN_BY_USER not in os.environ:
        try:
            _make_own(folder())
        except OSError as error:
            print(f"jaxsph: compiled programs are not kept, as {folder()} cannot be used: {error.strerror}", file=sys.stderr)
            PROGRAMS.on_compile(_told_once("the next command will compile it again"))
            return
        jax.config.update("jax_compilation_cache_dir", str(folder()))
        jax.config.update("jax_compilation_cache_max_size", MAX_BYTES)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    told = _told_once("once, as it is kept for the next command")
    jax.monitoring.register_event_listener(lambda event, **_: told() if event == MISS else None)


def folder() -> Path:
    """Where compiled programs are kept."""
    import platformdirs

    chosen = os.environ.get(CHOSEN_BY_USER)
    return Path(chosen) if chosen else Path(platformdirs.user_cache_path("jaxsph")) / "compiled"


def _make_own(place: Path) -> None:
    """Make a folder that this user alone can enter, whatever the umask; what others have put into it goes.

    Raises `OSError`: it cannot be made, or it or the one that it is in is another user's.
    """
    before = os.umask(0o077)
    try:
        place.mkdir(parents=True, exist_ok=True)
    finally:
        os.umask(before)
    for path in (place.parent, place) if os.name == "posix" else ():
        if {path.lstat().st_uid, path.stat().st_uid} != {os.geteuid()}:
            raise PermissionError(errno.EPERM, f"{path} belongs to another user; remove it, or take --no-cache")
        if path.stat().st_mode & 0o077:
            path.chmod(0o700)
            for entry in path.iterdir():
                if path == place and entry.lstat().st_uid != os.geteuid():
                    entry.unlink()


def say_kept() -> None:
    """Say where the cache is, what it holds, and how large it may become."""
    place = folder()
    files = list(place.glob("*-cache")) if place.is_dir() else []
    size = sum(path.stat().st_size for path in files)
    chosen = CHOSEN_BY_USER in os.environ
    bound = f"as {CHOSEN_BY_USER} names it, JAX's variables bound it" if chosen else f"at most {MAX_BYTES / 1e6:.0f} MB"
    say("cache", str(place))
    say("", f"{len(files)} compiled programs, {size / 1e6:.1f} MB; {bound}")


BROKEN = re.compile(r"Error reading persistent compilation cache entry for '([\w.-]+)'")


def mended(warning: str) -> bool:
    """Whether a warning of JAX is of an entry that cannot be read; such ones are removed, so that they are written anew.

    JAX says of which program it is, not of which of its entries: all of them go.
    """
    found = BROKEN.match(warning)
    if found is None:
        return False
    for path in folder().glob(f"{found[1]}-*-cache"):
        with contextlib.suppress(OSError):  # another process may have removed it
            path.rmdir() if path.is_dir() else path.unlink()
    return True


def _told_once(more: str) -> Callable[[], None]:
    """Says on stderr, the first time that it is called, that programs are being compiled."""
    return functools.cache(lambda: notice(f"compiling for frames of this kind: {more}"))
