"""Room on a disk, taken before a file is written: a library that finds the disk full in the middle may take the process with it.

Flow: size of what will be written -> [reserved] -> a file of that size -> snapshot_sort, which fills it.
"""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

PIECE = 1 << 20


def reserve(path: Path, num_bytes: int) -> None:
    """Have a file that is there hold so many bytes, all of them on its disk.

    Systems that write elsewhere what is written over (copy on write) may still run out of room later.

    Raises:
        OSError: there is no room, or a limit on the size of files.
    """
    free = shutil.disk_usage(path.parent).free + path.stat().st_size
    if free < num_bytes:
        raise OSError(errno.ENOSPC, f"about {num_bytes / 1e6:,.1f} MB are needed, and its disk has room for {free / 1e6:,.1f} MB")
    with open(path, "r+b") as file:
        if not _allocated(file.fileno(), num_bytes):
            _fill(file.fileno(), num_bytes)


def _allocated(file: int, num_bytes: int) -> bool:
    """Whether the system has taken the room; some know no such call, some disks neither."""
    if not hasattr(os, "posix_fallocate"):
        return False
    try:
        os.posix_fallocate(file, 0, num_bytes)
    except OSError as error:
        if error.errno in (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS):
            return False
        raise
    return True


def _fill(file: int, num_bytes: int) -> None:
    left = num_bytes - os.lseek(file, 0, os.SEEK_END)
    while left > 0:
        left -= os.write(file, bytes(min(left, PIECE)))
