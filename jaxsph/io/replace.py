"""Write a file whole or not at all: fill a temporary sibling, then rename it over the target (of a link, what it points to)."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

MAX_STEM = 40
"""Characters that the temporary file's name takes of the target's: a name as long as a disk takes has no room for more."""


@contextlib.contextmanager
def written_whole(path: str | Path) -> Iterator[Path]:
    """Give the block a temporary path beside `path`, of the same suffix; rename it to `path` when the block succeeds.

    When the block fails, the temporary file is removed and what stood at `path` before still stands there.

    Raises:
        ValueError: the folder of `path` does not exist or may not be written to, or `path` is a folder.
    """
    path = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    if path.is_dir():
        raise ValueError(f"cannot write {path}: it is a folder; give the name of a file in it")
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: the folder {path.parent} does not exist; make it first")
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.stem[:MAX_STEM]}.", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"cannot write {path}: {reason}; choose a folder that can be written to") from error
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"cannot write {path}: {reason}; choose another place") from error
    finally:
        temporary.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)  # the mask can only be read by setting it
    os.umask(mask)
    return mask
