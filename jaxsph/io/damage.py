"""What cannot be read is refused by one `ValueError` that names the file, the trouble and the remedy; so are missing libraries.

Flow: path -> [damage: regular_file] -> [damage: explained] around every reader -> ParticleTable.

Only regular files and folders are opened: pipes, sockets and devices wait for ever, or never end.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

KINDS = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFSOCK: "a socket",
    stat.S_IFCHR: "a character device",
    stat.S_IFBLK: "a block device",
}
MAX_TEXT = 1 << 26  # bytes of a file of settings, control points or cameras: a million of numbers have less
UNENDED_NOTE = "its last line has no end: check that the file is complete"
"""Said of text whose last number may have lost digits, which nothing else would show."""


class DataError(ValueError):
    """A refusal whose message is already a sentence for the user: what is wrong, and what to do."""


class NoParticlesError(DataError):
    """A file, of several of a snapshot perhaps, has no particles of the type that is asked for."""


def require(module: str, purpose: str, extra: str = "io") -> Any:
    """The module called `module`, else `ImportError`: what needs it, and which extra brings it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        library = module.partition(".")[0]
        raise ImportError(f'the library `{library}` is needed for {purpose}: pip install "jaxsph[{extra}]"') from error


@contextlib.contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Have every `ValueError` inside the block begin with `path`, where that is not empty; what is no `DataError` becomes one."""
    try:
        yield
    except ValueError as error:
        kind = type(error) if isinstance(error, DataError) else DataError
        raise kind(f"{path}: {error}" if path else str(error)) from error


@contextlib.contextmanager
def explained(path: str | Path, source: str) -> Iterator[None]:
    """Re-raise every failure inside the block as a `ValueError` that begins with `path`.

    A `DataError` keeps its own words. What a library raises on bytes it did not expect (`struct.error`, `KeyError`, `OSError` of
    HDF5, ...) is quoted after the name of the format. Memory that runs out stays a `MemoryError`, with the name of the file.
    Files that are missing or may not be opened, and libraries that are missing, say so themselves and pass through.
    """
    try:
        yield
    except (FileNotFoundError, PermissionError, ImportError):
        raise
    except MemoryError as error:
        raise MemoryError(f"{path}: needs more memory than there is ({error})") from error
    except DataError as error:
        raise type(error)(f"{path}: {error}") from error
    except Exception as error:
        reason = " ".join(str(error).split()) or "no further reason given"
        wrong = f"{path}: cannot be read as {source} ({type(error).__name__}: {reason}); the file is probably cut short,"
        raise ValueError(f"{wrong} damaged or of another format: copy it again, or write it again from its source") from error


def regular_file(path: str | os.PathLike[str], *, or_folder: bool = False) -> Path:
    """`path`, if it names a regular file, or a folder where that may be, links followed."""
    if not isinstance(path, str | os.PathLike):
        raise DataError(f"`path` must be the name of a file, got {path!r:.60} of type {type(path).__name__}")
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"{path}: there is no such file")
    kind = stat.S_IFMT(file.stat().st_mode)
    if kind == stat.S_IFDIR and not or_folder:
        raise DataError(f"{path}: is a folder; give the name of a file in it")
    if kind not in (stat.S_IFREG, stat.S_IFDIR):
        what = KINDS.get(kind, "no regular file")
        raise DataError(f"{path}: is {what}, which may never end; write its content to a file first")
    return file


def short_text(path: str | os.PathLike[str]) -> str:
    """The text of a regular file that is not large; `DataError` of another, `OSError` of one that may not be read."""
    with regular_file(path).open("rb") as stream:
        content = stream.read(MAX_TEXT + 1)
    if len(content) > MAX_TEXT:
        raise DataError(f"{path}: has more than {MAX_TEXT:,} bytes, as no file of this kind has; give another")
    return content.decode("utf-8")


def inside(name: str | Path, path: Path, what: str) -> Path:
    """What the file at `path` names, if it is a regular file in the folder of that or below, else `ValueError`."""
    own = Path(os.path.abspath(path)).parent
    plain = Path(os.path.normpath(own / name))
    if not any(plain.is_relative_to(folder) for folder in (own, path.resolve().parent)):
        raise DataError(f"{what}, which lies outside of the folder of this file and is not opened; copy it beside this file")
    if not plain.is_file():
        raise DataError(f"{what}, which is no regular file and is not opened; put a file there")
    return plain
