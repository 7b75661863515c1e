"""A copy of a snapshot whose rows are ordered in space, so that a view of a part of it reads few of them.

Flow: files -> [sort: count cells, place rows] -> one file, with a table of its cells.

Particles are moved to coarse cells of a box around all; in a cell they keep their order. Positions are read three times and all
else once, run by run, and never more than a run is held. The cells are told as SWIFT tells them. Room for all is taken before
anything is written, as HDF5 that cannot write may end the process.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import math
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsph.io.damage import DataError
from jaxsph.io.disk.rows import Snapshot
from jaxsph.io.libraries import require
from jaxsph.io.readers.hdf5_links import holds, member, members, opened
from jaxsph.io.readers.hdf5_storage import read_dataset, shape_of
from jaxsph.io.replace import written_whole
from jaxsph.numerics.checks import Progress

BITS = 4
CELLS = 1 << BITS  # along each edge of the box
SORTED_FROM = "jaxsph_sorted_from"
"""Attribute of a file that was sorted: the name of the first file of its source."""
PURPOSE = "writing HDF5 files"
PIECE = 1 << 20
SLACK = 1 << 20
"""Bytes of what HDF5 notes beside data: of this tool's own groups and tables."""


class Column(NamedTuple):
    """What is known of a column before it is read: the shape of all its rows, and dtype and attributes of its data set."""

    shape: tuple[int, ...]
    dtype: Any
    attributes: dict[str, Any]


class Grid(NamedTuple):
    """Cells of a box: its lower corner, and cells a length unit along each axis."""

    lower: np.ndarray
    scale: np.ndarray

    def cells_of(self, position: np.ndarray) -> np.ndarray:
        """The number of the cell of each position, in Morton's order: cells of near numbers are near."""
        place = np.clip((position.astype(np.float64) - self.lower) * self.scale, 0, CELLS - 1).astype(np.int64)
        return sum(((place[:, axis] >> bit) & 1) << (3 * bit + 2 - axis) for bit in range(BITS) for axis in range(3))  # type: ignore


def sort_snapshot(
    path: str | Path, output: str | Path, *, part_type: int | None = None, progress: Progress | None = None
) -> None:
    """Write a snapshot's particles of one type to one file, ordered in space.

    Args:
        path: any file of the snapshot, Gadget-like HDF5.
        output: the file to write, whole or not at all; one that is there is replaced if it was sorted from files of that name.
        part_type: kind of particles; default gas, or the first other kind there is.
        progress: called as `progress(done, total)` after every read.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another format, a damaged file, a place that cannot be written to or has no room, where something else is.
    """
    snapshot, output = Snapshot(path, part_type), Path(output)
    if output.suffix.lower() not in (".hdf5", ".h5"):
        raise DataError(f"{output}: a snapshot is written as .hdf5 or .h5")
    if any(output.exists() and output.samefile(file) for file in snapshot.files):
        raise DataError(f"{output}: is the snapshot itself; write the ordered one to another file")
    if output.exists() and not output.is_dir() and _sorted_from(output) != snapshot.files[0].name:
        raise DataError(
            f"{output}: is there, and was not sorted from {snapshot.files[0].name}; remove it, or write to another file"
        )
    runs = snapshot.reads()
    told = itertools.count(1)

    def positions() -> Iterator[np.ndarray]:
        for file, begin, end in runs:
            yield snapshot.read(file, slice(begin, end), ()).position
            step()

    def step() -> None:
        if progress is not None:
            progress(next(told), 3 * len(runs))

    grid = _grid(positions())
    counts = np.zeros(CELLS**3, np.int64)
    for position in positions():
        counts += np.bincount(grid.cells_of(position), minlength=CELLS**3)
    with written_whole(output) as temporary:
        _write(snapshot, runs, grid, counts, temporary, step)


def _grid(positions: Iterator[np.ndarray]) -> Grid:
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    for stored in positions:
        position = stored.astype(np.float64)
        lower, upper = np.minimum(lower, position.min(0)), np.maximum(upper, position.max(0))
    extent = np.where(upper > lower, upper - lower, 1)
    return Grid(np.where(np.isfinite(lower), lower, 0), CELLS / np.where(np.isfinite(extent), extent, 1))


def _sorted_from(path: Path) -> str | None:
    """Of a sorted snapshot, the name of the first file of its source; None of any other file."""
    h5py = require("h5py", PURPOSE)
    try:
        with h5py.File(path if path.is_file() else "", "r") as file:
            return str(file.attrs.get(SORTED_FROM))
    except OSError:
        return None


def _write(
    snapshot: Snapshot, runs: list[tuple[int, int, int]], grid: Grid, counts: np.ndarray, path: Path, step: Callable[[], None]
) -> None:
    h5py = require("h5py", PURPOSE)
    name, begins = f"PartType{snapshot.part_type}", np.cumsum(counts) - counts
    columns = _columns(snapshot, name, int(counts.sum()))
    _make_room(snapshot.files[0], columns, path)
    with h5py.File(path, "r+") as made:
        made.attrs[SORTED_FROM] = snapshot.files[0].name
        _copy_others(snapshot.files[0], made)
        header = made.require_group("Header").attrs
        header["NumFilesPerSnapshot"], header["ThisFile"] = 1, 0  # this is all of it
        for key in ("NumPart_ThisFile", "NumPart_Total"):
            numbers = np.zeros(max(snapshot.part_type + 1, len(np.ravel(header.get(key, ())))), np.int64)
            numbers[snapshot.part_type] = counts.sum()
            header[key] = numbers
        made.create_group(name)
        targets = {}
        for column, known in columns.items():
            targets[column] = made[name].create_dataset(column, known.shape, known.dtype)
            targets[column].attrs.update(known.attributes)
        cells = made.create_group("Cells")
        for part, numbers in (("Counts", counts), ("OffsetsInFile", begins)):
            cells.create_group(part)[name] = numbers
        free = begins.copy()
        for file, begin, end in runs:
            cell, rows = _rows(snapshot.files[file], name, slice(begin, end), grid, columns)
            which, first, number = np.unique(cell, return_index=True, return_counts=True)
            for column, target in targets.items():
                for at, start, many in zip(free[which], first, number, strict=True):
                    target[at : at + many] = rows[column][start : start + many]
            free[which] += number
            step()


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[Any]:
    """An open file; what the system says of it is no trouble of the file that is written."""
    try:
        with opened(path) as file:
            yield file
    except OSError as error:
        raise DataError(f"{path}: {error.strerror or error}; it is needed until all of it is sorted") from error


def _rows(path: Path, name: str, rows: slice, grid: Grid, columns: dict[str, Column]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The cells of some rows, ascending, and the rows of all columns in that order."""
    with _reading(path) as file:
        group = file[name]
        cell = grid.cells_of(read_dataset(group["Coordinates"], rows))
        order = np.argsort(cell, kind="stable")
        found = {}
        for column in columns:
            if not holds(group, column):
                raise DataError(f"has no {name}/{column}, which other files of the snapshot have; write it again")
            values = read_dataset(member(group, column), rows)
            if len(values) != len(cell):
                raise DataError(f"{name}/{column} has other numbers of rows than there are particles; write it again")
            found[column] = values[order]
    return cell[order], found


def _make_room(source: Path, columns: dict[str, Column], path: Path) -> None:
    """An HDF5 file with nothing in it, as large as what will be written: HDF5 cuts off what it did not need."""
    h5py = require("h5py", PURPOSE)
    with h5py.File("empty", "w", driver="core", backing_store=False) as empty:
        empty.flush()
        path.write_bytes(empty.id.get_file_image())
    with _reading(source) as file:
        particles = sum(_stored(file[group]) for group in file if _is_written_anew(group))
        linked = sum(_stored(file[group]) for group in file if _is_of(file, group, "ExternalLink"))
    others = max(source.stat().st_size - particles, 0) + linked
    data = sum(math.prod(column.shape) * column.dtype.itemsize for column in columns.values())
    reserve(path, data + others + others // 4 + SLACK)


def _is_written_anew(group: str) -> bool:
    return group.startswith("PartType") or group == "Cells"


def _is_of(file: Any, name: str, kind: str) -> bool:
    return isinstance(file.get(name, getlink=True), getattr(require("h5py", PURPOSE), kind))


def _stored(thing: Any) -> int:
    """Bytes of all data sets of a group, as they are stored; views have none."""
    found = [thing]
    if hasattr(thing, "visititems"):
        thing.visititems(lambda _, each: found.append(each))
    return sum(each.id.get_storage_size() for each in found if hasattr(each, "is_virtual") and not each.is_virtual)


def _copy_others(path: Path, made: Any) -> None:
    """All that is not of particles; soft links stay what they are."""
    with _reading(path) as source:
        for name in source:
            if _is_written_anew(name):
                continue
            if _is_of(source, name, "SoftLink"):
                made[name] = source.get(name, getlink=True)
            else:
                source.copy(name, made)


def _columns(snapshot: Snapshot, name: str, count: int) -> dict[str, Column]:
    """Columns to be filled, as the first file that has this type has them."""
    for path in snapshot.files:
        with _reading(path) as file:
            if name in file and holds(file[name], "Coordinates"):
                found = {column: (dataset, shape_of(dataset)) for column, dataset in members(file[name]).items()}
                return {
                    column: Column((count, *shape[1:]), dataset.dtype, dict(dataset.attrs))
                    for column, (dataset, shape) in found.items()
                    if shape
                }
    return {}


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
        if hasattr(os, "posix_fallocate"):  # some systems know no such call, some disks neither
            try:
                return os.posix_fallocate(file.fileno(), 0, num_bytes)
            except OSError as error:
                if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS):
                    raise
        left = num_bytes - os.lseek(file.fileno(), 0, os.SEEK_END)
        while left > 0:
            left -= os.write(file.fileno(), bytes(min(left, PIECE)))
