"""Snapshots larger than memory, of which some rows are read at a time, and an index of where in space those of each run are.

Flow: files -> [Snapshot.runs, Snapshot.read] -> tables of some particles -> [index_of: one pass] -> SnapshotIndex -> on_disk.

Such snapshots are Gadget-like HDF5, in one file or several.

A run is a few ten thousand neighbouring rows of one file: those of a cell, or of several, where the code (SWIFT) stores particles
cell by cell and says so. Of each are kept the box around its particles, and the largest support, which no code's own tables have.
The index lies beside the snapshot, and is made again when a file has another size or time of change, and when it is damaged or
does not fit the rows that the files have.
"""

from __future__ import annotations

import dataclasses
import itertools
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.damage import DataError, require
from jaxsph.io.disk.files import files_of, refuse_strangers
from jaxsph.io.readers import hdf5
from jaxsph.io.readers.hdf5_guards import PURPOSE, holds, member, opened, position_shape, read_dataset
from jaxsph.io.replace import written_whole
from jaxsph.io.settle.quantities import ROLES, available_quantities, choose_quantity
from jaxsph.io.table import ParticleTable, plain
from jaxsph.io.units import number_of
from jaxsph.numerics.checks import Progress

SUFFIX = ".jaxsph-index.npz"
VERSION = 3
RUN = 1 << 14  # rows of a run: the least that is read
READ = 1 << 17  # rows that are read at once, of runs that follow on one another: opening a file costs as much as reading a run
OTHER_FORMAT = (
    "is not a Gadget-like HDF5 snapshot, all that `--from-disk` and `OnDisk.open` can read, as they read "
    "some rows at a time; render it as a whole, without `--from-disk`"
)


class Snapshot:
    """The files of a Gadget-like HDF5 snapshot, by any of them, of which some rows can be read. Raises as `read_table`."""

    def __init__(self, path: str | Path, part_type: int | str | None = None):
        path = Path(path)
        if not path.exists():
            raise FileNotFoundError(f"{path}: there is no such file")
        h5py = require("h5py", PURPOSE)
        if path.is_dir() or (path.is_file() and not h5py.is_hdf5(path)):
            raise DataError(f"{path}: {OTHER_FORMAT}")
        with opened(path) as file:
            if not any(name.startswith("PartType") for name in file):
                raise DataError(OTHER_FORMAT)
            first = hdf5.gadget(file, part_type, slice(0, 1))
        assert first.part_type is not None
        self.part_type: int = first.part_type
        self.files = tuple(files_of(path, first.num_files) or (path,)) if first.num_files > 1 else (path,)
        self.first = first
        begins = (dataclasses.replace(self.read(n, slice(0, RUN), ()), path=str(file)) for n, file in enumerate(self.files))
        if len(self.files) > 1 and (filled := [begin for begin in begins if len(begin)]):
            refuse_strangers(filled, len(self))

    def __len__(self) -> int:
        return sum(end - begin for _, begin, end in self.runs())

    @property
    def identity(self) -> tuple[tuple[str, int, int, int], ...]:
        """Names, sizes in bytes and times of change of the files: of their data as is said, and of anything as the system knows.

        The first can be set, and is where a file is copied over another. Numbers of files (inodes) are other ones at every
        mount on some systems, so they are not asked.
        """
        told = ((file.name, file.stat()) for file in self.files)
        return tuple((name, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns) for name, stat in told)

    def read(self, file: int, rows: slice, only: Sequence[str] | None = None) -> ParticleTable:
        """Some rows of a file; besides positions `only` the columns of those names."""
        with opened(self.files[file]) as source:
            if f"PartType{self.part_type}" not in source:
                return dataclasses.replace(self.first, position=np.zeros((0, 3), np.float32), columns={}, support=None)
            names = None if only is None else {plain(name) for name in only}
            return hdf5.gadget(source, self.part_type, rows, names)

    def runs(self) -> Iterator[tuple[int, int, int]]:
        """File, first row and end of each run."""
        for number, path in enumerate(self.files):
            with opened(path) as source:
                name = f"PartType{self.part_type}"
                if name not in source or not holds(source[name], "Coordinates"):
                    continue
                count = position_shape(member(source[name], "Coordinates"))[0]
                edges = _edges(count, _cells(source, name))
            yield from ((number, int(begin), int(end)) for begin, end in itertools.pairwise(edges) if end > begin)


def together(runs: Iterable[tuple[int, int, int]]) -> Iterator[tuple[int, list[tuple[int, int]]]]:
    """Runs that follow on one another in a file, as many as are read at once: number of the file, and rows of each."""
    held: list[tuple[int, int]] = []
    last = -1
    for file, begin, end in runs:
        if held and (file != last or begin != held[-1][1] or end - held[0][0] > READ):
            yield last, held
            held = []
        last = file
        held.append((begin, end))
    if held:
        yield last, held


def _cells(file: Any, name: str) -> np.ndarray | None:
    """First rows of the cells of a SWIFT snapshot, ascending; None where it has none, or its cells leave rows out."""
    cells = file.get("Cells")
    if cells is None or any(part not in cells or name not in cells[part] for part in ("Counts", "OffsetsInFile")):
        return None
    counts, offsets = (read_dataset(cells[part][name]).astype(np.int64) for part in ("Counts", "OffsetsInFile"))
    if "Files" in cells and name in cells["Files"]:  # of a snapshot in several files, those that lie in this one
        header = file["Header"].attrs if "Header" in file else {}
        inside = read_dataset(cells["Files"][name]) == int(number_of(header, "ThisFile") or 0)
        counts, offsets = counts[inside], offsets[inside]
    order = np.argsort(offsets, kind="stable")
    counts, offsets = counts[order], offsets[order]
    filled = counts > 0
    counts, offsets = counts[filled], offsets[filled]
    whole = len(offsets) and offsets[0] == 0 and (offsets[:-1] + counts[:-1] == offsets[1:]).all()
    return offsets if whole else None


def _edges(count: int, cells: np.ndarray | None) -> np.ndarray:
    """Ends of the runs of so many rows: none longer than `RUN`, and none across the middle of a cell that is shorter."""
    if cells is None:
        return np.unique([*range(0, count, RUN), count])
    edges = [0]
    for end in (*cells[1:].tolist(), count):
        while end - edges[-1] > 2 * RUN:
            edges.append(edges[-1] + RUN)
        if end - edges[-1] >= RUN // 2 or end == count:
            edges.append(end)
    return np.unique(edges)


def supports_and_volumes(table: ParticleTable) -> tuple[np.ndarray, np.ndarray]:
    """Both in float64; a stored density is not held against sums, as `supports` does in memory: they need all other particles.

    Raises `ValueError`: neither can be found without all other particles.
    """
    mass, density = (table.named(*ROLES[role]) for role in ("mass", "density"))
    if table.support is None or (table.volume is None and (mass is None or density is None)):
        raise DataError(
            "has particles without supports, or without masses and densities: these need all neighbours; read it as a whole"
        )
    if table.volume is not None:
        return table.support.astype(np.float64), table.volume.astype(np.float64)
    assert mass is not None and density is not None
    return table.support.astype(np.float64), table.columns[mass].astype(np.float64) / table.columns[density].astype(np.float64)


def needed_columns(first: ParticleTable, *quantities: str) -> list[str]:
    """Names of the columns that supports, volumes and quantities come from; `first` is a table of any rows.

    Raises `ValueError`: a quantity that is not there, or that is a sum over neighbours.
    """
    roles = list(map(plain, hdf5.SMOOTHING_NAMES))
    roles += [name for role in ("mass", "density") if (name := first.named(*ROLES[role])) is not None]
    found = []
    for quantity in quantities:
        if plain(quantity) == "density" and first.named(*ROLES["density"]) is None:
            raise DataError(f"{quantity!r} would be a sum over neighbours; there are {', '.join(available_quantities(first))}")
        values, _ = choose_quantity(first, quantity)
        for name in first.columns:
            others = dataclasses.replace(first, columns={key: column for key, column in first.columns.items() if key != name})
            try:
                again, _ = choose_quantity(others, quantity)
            except DataError:
                found.append(name)
            else:
                found += [] if np.array_equal(again, values) else [name]
    return list(dict.fromkeys([*roles, *found]))


CORNERS = "lower", "upper", "outer_lower", "outer_upper"
RUNS = np.dtype(
    [
        *((name, "i8") for name in ("file", "begin", "end")), *((name, "f8", 3) for name in CORNERS), ("support", "f8"),
        ("least", "f8"), ("widest", "i8"), ("strongest", "i8"), ("strength", "f8"), ("volume", "f8", 2),
    ]
)  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class SnapshotIndex:
    """What is known of a snapshot without its particles.

    Attributes:
        files: of the snapshot.
        part_type: kind of particles.
        runs: of each run, a row of numbers by name:
            file, begin, end: number of its file and rows.
            lower, upper: corners of the box around the positions.
            outer_lower, outer_upper: the same around the supports.
            support, least: largest and smallest support.
            widest, strongest: the row in its file of the largest support, and of the largest V / H^3.
            strength: the largest V / H^3.
            volume: least and largest.
    """

    files: tuple[Path, ...]
    part_type: int
    runs: np.recarray

    def __len__(self) -> int:
        return int((self.runs.end - self.runs.begin).sum())

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the box around all supports, as for `Camera.framing`; of nothing, zeros."""
        if not len(self.runs):
            return np.zeros(3), np.zeros(3)
        return self.runs.outer_lower.min(0), self.runs.outer_upper.max(0)


def index_of(snapshot: Snapshot, *, progress: Progress | None = None) -> SnapshotIndex:
    """The index of a snapshot: the one that is kept if it is of these very files, else made in one pass, and kept.

    Raises `ValueError`: damaged files; particles without supports, or without masses and densities. Warns where it is not kept.
    """
    kept = _kept(snapshot)
    if kept is not None:
        return kept
    made = _made(snapshot, progress)
    try:
        with written_whole(index_path(snapshot)) as temporary:
            np.savez(temporary, identity=_marked(snapshot), runs=made.runs)
    except ValueError as error:
        warnings.warn(f"the index of the snapshot is not kept, and is made again the next time: {error}", stacklevel=2)
    return made


def index_path(snapshot: Snapshot) -> Path:
    """Where the index is kept."""
    return snapshot.files[0].with_name(f"{snapshot.files[0].name}.{snapshot.part_type}{SUFFIX}")


def _marked(snapshot: Snapshot) -> np.ndarray:
    return np.array(repr((VERSION, RUN, snapshot.part_type, snapshot.identity)))


def _kept(snapshot: Snapshot) -> SnapshotIndex | None:
    path = index_path(snapshot)
    if not path.is_file():
        return None
    try:
        with zipfile.ZipFile(path) as archive:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):  # as it is never written
                return None
        with np.load(path, allow_pickle=False) as kept:
            if str(kept["identity"]) != str(_marked(snapshot)):
                return None
            found = SnapshotIndex(snapshot.files, snapshot.part_type, kept["runs"].view(np.recarray))
    except Exception:  # whatever a damaged archive raises: it is made again
        return None
    return found if _fits(found, snapshot) else None


def _fits(index: SnapshotIndex, snapshot: Snapshot) -> bool:
    """Whether an index can be of these files: of their runs, with boxes, supports and volumes that particles can have."""
    runs, there = index.runs, np.array(list(snapshot.runs()), np.int64).reshape(-1, 3)
    if runs.dtype != RUNS or runs.shape != (len(there),):
        return False
    ascending = (
        (runs.least > 0, runs.least <= runs.support),
        (runs.begin <= runs.widest, runs.widest < runs.end),
        (runs.begin <= runs.strongest, runs.strongest < runs.end),
        (runs.volume[:, 0] >= 0, runs.volume[:, 0] <= runs.volume[:, 1]),
        (runs.outer_lower <= runs.lower, runs.lower <= runs.upper),
        (runs.upper <= runs.outer_upper, runs.strength >= 0),
    )
    numbers = all(np.isfinite(runs[name]).all() for name in RUNS.names or ())
    same = (np.stack([runs.file, runs.begin, runs.end], 1) == there).all()
    return bool(numbers and same and all(each.all() for each in itertools.chain.from_iterable(ascending)))


def _made(snapshot: Snapshot, progress: Progress | None) -> SnapshotIndex:
    needed, reads = needed_columns(snapshot.first), list(together(snapshot.runs()))
    rows = []
    for done, (file, runs) in enumerate(reads, 1):
        first = runs[0][0]
        table = snapshot.read(file, slice(first, runs[-1][1]), needed)
        rows += [(file, begin, end, *_known(table.rows(slice(begin - first, end - first)), begin)) for begin, end in runs]
        if progress is not None:
            progress(done, len(reads))
    return SnapshotIndex(snapshot.files, snapshot.part_type, np.array(rows, RUNS).view(np.recarray))


def _known(table: ParticleTable, begin: int) -> tuple[Any, ...]:
    """What is kept of a run."""
    support, volume = supports_and_volumes(table)
    (long, long_exponent), (large, large_exponent) = (np.frexp(each) for each in (support, volume))
    long, large = long.astype(np.float32), large.astype(np.float32)
    # V / H^3, rounded as float32 rounds it: so that it is largest where it will be largest in view
    strength = np.ldexp((large / (long * long * long)).astype(np.float64), large_exponent - 3 * long_exponent)
    position = table.position.astype(np.float64)
    widest, strongest = int(support.argmax()), int(strength.argmax())
    reach = support[:, None]
    corners = position.min(0), position.max(0), (position - reach).min(0), (position + reach).max(0)
    rows = begin + widest, begin + strongest
    return *corners, support[widest], support.min(), *rows, strength[strongest], (volume.min(), volume.max())
