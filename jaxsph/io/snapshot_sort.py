"""A copy of a snapshot whose rows are ordered in space, so that a view of a part of it reads few of them.

Flow: files -> [snapshot_sort: count cells, place rows] -> one file, with a table of its cells.

Particles are moved to coarse cells of a box around all; in a cell they keep their order. Positions are read three times and all
else once, run by run, and never more than a run is held. The cells are told as SWIFT tells them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .damage import DataError, explained
from .optional import require
from .replace import written_whole
from .snapshot_index import Progress
from .snapshot_rows import Snapshot

BITS = 4
CELLS = 1 << BITS  # along each edge of the box


class Grid(NamedTuple):
    """Cells of a box.

    Attributes:
        lower: its corner.
        scale: cells a length unit, along each axis.
    """

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
        output: the file to write, whole or not at all.
        part_type: kind of particles; default gas, or the first other kind there is.
        progress: called as `progress(done, total)` after every read.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another format, a damaged file, a place that cannot be written to.
    """
    snapshot, output = Snapshot(path, part_type), Path(output)
    if output.suffix.lower() not in (".hdf5", ".h5"):
        raise DataError(f"{output}: a snapshot is written as .hdf5 or .h5")
    if any(output.exists() and output.samefile(file) for file in snapshot.files):
        raise DataError(f"{output}: is the snapshot itself; write the ordered one to another file")
    runs = snapshot.reads()
    steps = _Steps(progress, 3 * len(runs))
    grid = _grid(snapshot, runs, steps)
    counts = np.zeros(CELLS**3, np.int64)
    for file, begin, end in runs:
        counts += np.bincount(grid.cells_of(snapshot.read(file, slice(begin, end), ()).position), minlength=CELLS**3)
        steps.done()
    with written_whole(output) as temporary:
        _write(snapshot, runs, grid, counts, temporary, steps)


class _Steps:
    def __init__(self, progress: Progress | None, total: int):
        self._progress, self._total, self._now = progress, total, 0

    def done(self) -> None:
        """One more."""
        self._now += 1
        if self._progress is not None:
            self._progress(self._now, self._total)


def _grid(snapshot: Snapshot, runs: list[tuple[int, int, int]], steps: _Steps) -> Grid:
    lower, upper = np.full(3, np.inf), np.full(3, -np.inf)
    for file, begin, end in runs:
        position = snapshot.read(file, slice(begin, end), ()).position.astype(np.float64)
        lower, upper = np.minimum(lower, position.min(0)), np.maximum(upper, position.max(0))
        steps.done()
    extent = np.where(upper > lower, upper - lower, 1)
    return Grid(np.where(np.isfinite(lower), lower, 0), CELLS / np.where(np.isfinite(extent), extent, 1))


def _write(
    snapshot: Snapshot, runs: list[tuple[int, int, int]], grid: Grid, counts: np.ndarray, path: Path, steps: _Steps
) -> None:
    h5py = require("h5py", "writing HDF5 files")
    name, begins = f"PartType{snapshot.part_type}", np.cumsum(counts) - counts
    with explained(snapshot.files[0], "HDF5"), h5py.File(snapshot.files[0], "r") as source, h5py.File(path, "w") as made:
        for group in source:
            if not group.startswith("PartType") and group != "Cells":
                source.copy(group, made)
        _one_file(made, name, int(counts.sum()), snapshot.part_type)
        columns = _columns(snapshot, name, made, int(counts.sum()))
        cells = made.create_group("Cells")
        for part, numbers in (("Counts", counts), ("OffsetsInFile", begins)):
            cells.create_group(part)[name] = numbers
        free = begins.copy()
        for file, begin, end in runs:
            with h5py.File(snapshot.files[file], "r") as opened:
                group = opened[name]
                cell = grid.cells_of(group["Coordinates"][begin:end])
                order = np.argsort(cell, kind="stable")
                which, first, number = np.unique(cell[order], return_index=True, return_counts=True)
                for column, target in columns.items():
                    rows = group[column][begin:end][order]
                    for at, start, many in zip(free[which], first, number, strict=True):
                        target[at : at + many] = rows[start : start + many]
                free[which] += number
            steps.done()


def _one_file(made: Any, name: str, count: int, part_type: int) -> None:
    """Have the header say that this is all of it."""
    header = made.require_group("Header").attrs
    header["NumFilesPerSnapshot"] = 1
    header["ThisFile"] = 0
    for key in ("NumPart_ThisFile", "NumPart_Total"):
        numbers = np.zeros(max(part_type + 1, len(np.ravel(header.get(key, ())))), np.int64)
        numbers[part_type] = count
        header[key] = numbers
    made.create_group(name)


def _columns(snapshot: Snapshot, name: str, made: Any, count: int) -> dict[str, Any]:
    """Data sets to be filled, as the first file that has this type has them."""
    h5py = require("h5py", "reading HDF5 files")
    for path in snapshot.files:
        with h5py.File(path, "r") as opened:
            if name not in opened or "Coordinates" not in opened[name]:
                continue
            found = {}
            for column, dataset in opened[name].items():
                if getattr(dataset, "shape", None):
                    found[column] = made[name].create_dataset(column, (count, *dataset.shape[1:]), dataset.dtype)
                    found[column].attrs.update(dataset.attrs)
            return found
    return {}
