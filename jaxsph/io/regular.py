"""Only regular files and folders are opened: pipes, sockets and devices wait for ever, or never end.

Flow: path -> [regular] -> reader.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from .damage import DataError

KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
}


def regular_file(path: str | os.PathLike[str]) -> Path:
    """`path`, if it names a regular file, links followed.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a folder, a pipe, a socket or a device.
    """
    file = regular_file_or_folder(path)
    if file.is_dir():
        raise DataError(f"{path}: is a folder; give the name of a file in it")
    return file


def regular_file_or_folder(path: str | os.PathLike[str]) -> Path:
    """`path`, if it names a regular file or a folder, links followed. Raises as `regular_file`."""
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    kind = stat.S_IFMT(file.stat().st_mode)
    if kind not in (stat.S_IFREG, stat.S_IFDIR):
        raise DataError(
            f"{path}: is {KINDS.get(kind, 'no regular file')}, which may never end; write its content to a file first"
        )
    return file
