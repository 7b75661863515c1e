"""How many memory maps this process holds: every compiled kernel takes some three, and there is a limit that kills.

On Linux a process that maps more areas of memory than `vm.max_map_count` gets no more, and the compiler then ends it without
an exception. So who compiles asks beforehand whether there is room. Elsewhere there is no such limit, and nothing is asked.
"""

from __future__ import annotations

from pathlib import Path

IN_USE = Path("/proc/self/maps")
LIMIT = Path("/proc/sys/vm/max_map_count")
CROWDED = 0.5  # share of the limit beyond which compiled programs are to be let go: a frame with gradients takes 0.05


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
