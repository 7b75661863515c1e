"""An index of a snapshot that is larger than memory: where in space the particles of each run of rows are.

Flow: files -> [index: one pass, run by run] -> SnapshotIndex -> disk -> which runs a view needs.

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
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.disk.rows import RUN, Snapshot, needed_columns, supports_and_volumes, together
from jaxsph.io.replace import written_whole
from jaxsph.io.table import ParticleTable
from jaxsph.numerics.checks import Progress

SUFFIX = ".jaxsph-index.npz"
OF_RUNS = "run_"
VERSION = 2


@dataclasses.dataclass(frozen=True, eq=False)
class SnapshotIndex:
    """What is known of a snapshot without its particles.

    Attributes:
        files: of the snapshot.
        part_type: kind of particles.
        file, begin, end: of each run, number of its file and rows.
        lower, upper: of each run, corners of the box around the positions, float64.
        outer_lower, outer_upper: the same around the supports.
        support, least: of each run, largest and smallest support.
        widest, strongest: of each run, the row in its file of the largest support, and of the largest V / H^3.
        strength: of each run, the largest V / H^3.
        volume: of each run, least and largest.
    """

    files: tuple[Path, ...]
    part_type: int
    file: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    outer_lower: np.ndarray
    outer_upper: np.ndarray
    support: np.ndarray
    least: np.ndarray
    widest: np.ndarray
    strongest: np.ndarray
    strength: np.ndarray
    volume: np.ndarray

    def __len__(self) -> int:
        return int((self.end - self.begin).sum())

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners of the box around all supports, as for `Camera.framing`; of nothing, zeros."""
        if not len(self.file):
            return np.zeros(3), np.zeros(3)
        return self.outer_lower.min(0), self.outer_upper.max(0)


CORNERS = "lower", "upper", "outer_lower", "outer_upper"
ARRAYS = "file", "begin", "end", *CORNERS, "support", "least", "widest", "strongest", "strength", "volume"


def index_of(snapshot: Snapshot, *, progress: Progress | None = None) -> SnapshotIndex:
    """The index of a snapshot: the one that is kept if it is of these very files, else made in one pass, and kept.

    Raises `ValueError`: damaged files; particles without supports, or without masses and densities. Warns where it is not kept.
    """
    kept = _kept(snapshot)
    if kept is not None:
        return kept
    made = _made(snapshot, progress)
    arrays = {OF_RUNS + name: getattr(made, name) for name in ARRAYS}
    try:
        with written_whole(index_path(snapshot)) as temporary:
            np.savez(temporary, identity=_marked(snapshot), **arrays)
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
            found = SnapshotIndex(snapshot.files, snapshot.part_type, **{name: kept[OF_RUNS + name] for name in ARRAYS})
    except Exception:  # whatever a damaged archive raises: it is made again
        return None
    return found if _fits(found, snapshot) else None


def _fits(index: SnapshotIndex, snapshot: Snapshot) -> bool:
    """Whether an index can be of these files: of their runs, with boxes, supports and volumes that particles can have."""
    runs = np.array(list(snapshot.runs()), np.int64).reshape(-1, 3)
    shapes = [(len(runs), *((3,) if name in CORNERS else (2,) if name == "volume" else ())) for name in ARRAYS]
    arrays = [getattr(index, name) for name in ARRAYS]
    if not len(runs):
        return all(len(array) == 0 for array in arrays)
    if any(array.shape != shape or array.dtype.kind not in "iuf" for array, shape in zip(arrays, shapes, strict=True)):
        return False
    begin, end = runs[:, 1], runs[:, 2]
    ascending = (
        (index.least > 0, index.least <= index.support),
        (begin <= index.widest, index.widest < end),
        (begin <= index.strongest, index.strongest < end),
        (index.volume[:, 0] >= 0, index.volume[:, 0] <= index.volume[:, 1]),
        (index.outer_lower <= index.lower, index.lower <= index.upper),
        (index.upper <= index.outer_upper, index.strength >= 0),
    )
    numbers = all(np.isfinite(array).all() for array in arrays)
    same = (np.stack([index.file, index.begin, index.end], 1) == runs).all()
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
    columns = [np.array(column) for column in zip(*rows, strict=True)] if rows else [np.zeros(0, np.int64)] * len(ARRAYS)
    return SnapshotIndex(snapshot.files, snapshot.part_type, **dict(zip(ARRAYS, columns, strict=True)))


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
