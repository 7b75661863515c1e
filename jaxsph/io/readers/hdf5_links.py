"""HDF5 files, opened once it is known where their links lead.

Flow: path -> [hdf5_links: opened, members] -> groups and data sets -> the reader of a code -> ParticleTable.

A link may name another file, and HDF5 opens whatever lies there: a pipe that never ends, a file of somebody else. So files that
a file names must be regular ones in its folder or below it. A link that leads nowhere is an error: what it stands for would
else be missing without a word.
"""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxsph.io.damage import DataError, explained
from jaxsph.io.libraries import require

PURPOSE = "reading HDF5 files"


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Any]:
    """An `h5py.File` to read, none of whose links leads astray; what fails inside the block names `path`.

    Raises `ValueError`: no regular file, damaged; a link to another folder or to no regular file, or at the top to nothing.
    """
    h5py = require("h5py", PURPOSE)
    with explained(path, "HDF5"):
        if path.exists() and not path.is_file():
            raise DataError("is no regular file; write what it gives to one, and read that")
        with h5py.File(path, "r") as file:
            check_links(path)
            yield file


def members(group: Any) -> dict[str, Any]:
    """All that a group holds, by name. Raises `ValueError`: a link that cannot be followed."""
    return {name: member(group, name) for name in group}


def member(group: Any, name: str) -> Any:
    """What a group holds by a name that is there; `ValueError` where it is a link that cannot be followed."""
    found = None
    with contextlib.suppress(KeyError, RuntimeError, OSError):  # a link to itself, a file that is none of HDF5
        found = group.get(name)
    if found is None:
        link = group.get(name, getlink=True)
        path, file = getattr(link, "path", None), getattr(link, "filename", None)
        target = "is damaged" if path is None else f"is a link to `{path}`" + (f" in `{file}`" if file is not None else "")
        where = f"{group.name.rstrip('/')}/{name}"
        raise DataError(f"`{where}` {target}, which cannot be followed; put back what it leads to, or remove the link")
    return found


def holds(group: Any, name: str) -> bool:
    """Whether a group has something of this name, be it a link that leads nowhere."""
    return hasattr(group, "id") and hasattr(group.id, "links") and bool(group.id.links.exists(name.encode()))


def check_links(path: Path) -> None:
    """Refuse a file with links that lead astray, or at its top nowhere; asked once of a file that does not change."""
    known = path.stat()
    _check_links(path, known.st_mtime_ns, known.st_size, known.st_ino)


def file_of(file: Any, name: str, what: str) -> Path | None:
    """The file that HDF5 opens for a name that stands in an open `file`; None where there is none. `what` names it in errors.

    Raises `ValueError`: it lies in another folder, or is no regular file.
    """
    path = Path(os.path.abspath(file.filename))
    folders = path.parent, Path.cwd(), path.resolve().parent  # in this order HDF5 looks
    names = (name, Path(name).name) if os.path.isabs(name) else (name,)
    places = [folder / each for each in names for folder in folders]
    place = next((place for place in places if os.path.lexists(place)), None)
    return None if place is None else inside(place, (folders[0], folders[2]), what)


def inside(place: Path, folders: tuple[Path, ...], what: str) -> Path:
    """`place`, if it is a regular file in one of the folders or below. Raises `ValueError`: it is not."""
    plain = Path(os.path.normpath(place))
    if not any(plain.is_relative_to(folder) for folder in folders):
        raise DataError(f"{what}, which lies outside of the folder of this file and is not opened; copy it beside this file")
    if not plain.is_file():
        raise DataError(f"{what}, which is no regular file and is not opened; put a file there")
    return plain


@functools.lru_cache(maxsize=4096)
def _check_links(path: Path, *_: int) -> None:
    h5py = require("h5py", PURPOSE)
    seen, left = {path.resolve()}, [path]
    while left:
        with h5py.File(left.pop(), "r") as file:
            for group, name in _external_links(file):
                named = os.fsdecode(group.links.get_val(name)[0])
                other = file_of(file, named, f"`{name.decode(errors='replace')}` is a link to `{named}`")
                if other is not None and other.resolve() not in seen and h5py.is_hdf5(other):
                    seen.add(other.resolve())
                    left.append(other)
    with h5py.File(path, "r") as file:
        members(file)


def _external_links(file: Any) -> Iterator[tuple[Any, bytes]]:
    """Each with the group that holds it, over all groups: a group may hold itself, so each is met once."""
    h5py = require("h5py", PURPOSE)
    seen, left = set(), [file["/"].id]
    while left:
        group = left.pop()
        for name in list(group):
            kind = group.links.get_info(name).type
            if kind == h5py.h5l.TYPE_EXTERNAL:
                yield group, name
            if kind != h5py.h5l.TYPE_HARD:
                continue
            known = h5py.h5o.get_info(group, name)
            if known.type == h5py.h5o.TYPE_GROUP and known.addr not in seen:
                seen.add(known.addr)
                left.append(h5py.h5g.open(group, name))
