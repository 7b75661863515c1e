"""Memory of this process: how many maps of it there are, and what was freed given back to the system.

Every compiled kernel takes some three memory maps. On Linux a process that maps more areas than `vm.max_map_count` gets no more,
and the compiler then ends it without an exception. So who compiles asks beforehand whether there is room. Elsewhere there is no
such limit, and nothing is asked.

glibc keeps what each thread has freed for that thread's next use. XLA compiles on many threads: of the 800 MiB that a process
holds after its first frames 570 are of that kind. And each thread's part of the heap keeps up to 64 MiB at its end, however often
it is asked for all.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

IN_USE = Path("/proc/self/maps")
LIMIT = Path("/proc/sys/vm/max_map_count")
CROWDED = 0.5  # share of the limit beyond which compiled programs are to be let go: a frame with gradients takes 0.05
TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3
"""Numbers by which `mallopt` knows the free bytes at the end of a heap, and the bytes of an array, from which on both are given
back as soon as they are freed."""
LARGE = 1 << 20
GROWN = {TRIM_THRESHOLD: 64 << 20, MMAP_THRESHOLD: 32 << 20}
"""What glibc comes to by itself in a process that frees large arrays."""


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
    _of_libc("malloc_trim")(0)


@contextlib.contextmanager
def given_back_at_once() -> Iterator[None]:
    """Have arrays of 1 MiB or more given back as soon as they are freed, by all threads; each then costs its first touch."""
    for option in GROWN:
        _of_libc("mallopt")(option, LARGE)
    try:
        yield
    finally:
        for option, bytes_ in GROWN.items():
            _of_libc("mallopt")(option, bytes_)


@functools.cache
def _of_libc(name: str) -> Callable[..., Any]:
    try:
        function: Callable[..., Any] = getattr(ctypes.CDLL(None), name)
    except (AttributeError, OSError, TypeError):  # another C library than glibc
        return lambda *_: None
    return function
