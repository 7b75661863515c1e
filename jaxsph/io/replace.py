"""Write a file whole or not at all: fill a temporary sibling, then rename it over the target (of a link, what it points to).

A process that is killed leaves its sibling, `.NAME-jaxsph-RANDOM.SUFFIX`. The next that writes the same name removes those that
nobody has written to for a day.

What a command reads it does not replace, by whatever name (`keeping`). What was made of arrays is known again by their digest.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import re
import secrets
import stat
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxsph.numerics.checks import require_kinds

STALE_SECONDS = 24 * 3600.0  # since the last write to a temporary file: a process that is at work writes more often
MAX_STEM = 40  # letters of a name that are kept in that of its temporary file, of at most 255 bytes
HEX_DIGITS = 24  # of a fingerprint: 96 bits, so that no two of a billion pictures share one but with a chance of 1e-11
MARK = "-jaxsph-[0-9a-f]{16}"
_KEPT: dict[tuple[int, int], Path] = {}


@contextlib.contextmanager
def keeping(inputs: Iterable[Path]) -> Iterator[None]:
    """Files, and folders with all in them, that nothing in the block replaces, even by links to them."""
    _KEPT.update((_identity(path), path) for path in inputs)
    try:
        yield
    finally:
        _KEPT.clear()


def refuse_input(path: Path) -> None:
    """Raise `ValueError` where `path` is kept, or is in a folder that is."""
    for place in (path, *Path(os.path.realpath(path)).parents) if path.exists() and _KEPT else ():
        if (kept := _KEPT.get(_identity(place))) is not None:
            raise ValueError(f"cannot write {path}: {kept} is read, and would be lost; choose another name with -o")


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino


@contextlib.contextmanager
def written_whole(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give the block a temporary path beside `path`, of the same suffix; rename it to `path` when the block succeeds.

    When the block fails, the temporary file is removed and what stood at `path` before still stands there. So it is when the
    process is asked to end, if it hears (`jaxsph.cli.main`).

    Raises `ValueError`: the folder of `path` does not exist or may not be written to, or `path` is a folder.
    """
    path = Path(os.path.realpath(path)) if os.path.islink(path) else Path(path)
    if path.is_dir():
        raise ValueError(f"cannot write {path}: it is a folder; give the name of a file in it")
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: the folder {path.parent} does not exist; make it first")
    refuse_input(path)
    _sweep(path)
    temporary = path.with_name(f"{_before(path)}-jaxsph-{secrets.token_hex(8)}{path.suffix}")
    try:
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        yield temporary
        mask = os.umask(0)  # the mask can only be read by setting it
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        os.replace(temporary, path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"cannot write {path}: {reason}; choose another place, that can be written to") from error
    finally:
        temporary.unlink(missing_ok=True)


def known_suffix(path: str | os.PathLike[str], suffixes: Sequence[str], must_be: str) -> str:
    """The suffix of a name in lower case, if it is one of these, else `ValueError`."""
    require_kinds(known_suffix, {"path": path})
    suffix = Path(path).suffix.lower()
    if suffix not in suffixes:
        raise ValueError(f"{os.fspath(path)}: {must_be} {' or '.join(suffixes)}, not as {suffix!r}")
    return suffix


def write_figure(figure: Any, path: str | Path, **options: Any) -> None:
    """Write a figure of matplotlib's, by the suffix of the name; `options` are those of its `savefig`."""
    with written_whole(path) as temporary:
        figure.savefig(temporary, **options)


def _before(path: Path) -> str:
    return f".{path.stem[:MAX_STEM]}"


def _sweep(path: Path) -> None:
    """Remove what killed processes have left of this name."""
    pattern, now = re.compile(re.escape(_before(path)) + MARK + re.escape(path.suffix)), time.time()
    for name in filter(pattern.fullmatch, _left_in(os.path.abspath(path.parent))):
        left = path.with_name(name)
        with contextlib.suppress(OSError):
            known = left.lstat()
            if stat.S_ISREG(known.st_mode) and now - known.st_mtime > STALE_SECONDS:
                left.unlink()


@functools.lru_cache(maxsize=256)
def _left_in(folder: str) -> tuple[str, ...]:
    """Names of temporary files in a folder, listed once: thousands of frames are written to one."""
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        return tuple(entry.name for entry in entries if entry.name.startswith(".") and re.search(MARK, entry.name))
    return ()


def digest_of(tree: Any) -> str:
    """A digest of a tree of arrays: structure, types, shapes and numbers."""
    leaves, structure = jax.tree.flatten(tree)
    digest = hashlib.sha256(repr(structure).encode())
    for leaf in map(np.asarray, leaves):
        digest.update(f"{leaf.dtype} {leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()


def fingerprint(kind: str, *parts: Any) -> str:
    """A letter, and a digest of what can be written down exactly."""
    return kind + hashlib.sha256(repr(parts).encode()).hexdigest()[:HEX_DIGITS]
