"""Snapshots in several files, as codes write them that run on many nodes: `snap_002.0.hdf5`, `snap_002.1.hdf5`, ... as one.

Flow: path, reader -> [snapshot_files] -> ParticleTable of all files.

Any of the files stands for all. Files may lack a type of particles that others have.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .damage import DataError, NoParticlesError
from .table import ParticleTable

PART = re.compile(r"(.*\.)(\d+)(\.[A-Za-z]\w*)?")
Reader = Callable[[Path, int | None], ParticleTable]


def joined(table: ParticleTable, path: Path, part_type: int | None, read: Reader) -> ParticleTable:
    """The particles of all files of a snapshot, in the order of their numbers; the table itself if it is in one file.

    Args:
        table: what `read` gave for `path`.
        read: reads one file; `NoParticlesError` where it has none of the type.

    Raises:
        ValueError: a file is missing or damaged (which), or files have different columns.
    """
    if table.num_files == 1:
        return table
    files = files_of(path, table.num_files)
    if files is None:
        note = f"one of {table.num_files} files of the snapshot, by a name without its number: only its particles are read"
        return dataclasses.replace(table, conventions=(*table.conventions, note))
    missing = [file.name for file in files if not file.exists()]
    if missing:
        raise DataError(f"{path}: is one of {len(files)} files of a snapshot; beside it {_some(missing)} cannot be found")
    tables = [found for file in files if (found := _read(read, file, part_type)) is not None]
    chosen = min(found.part_type for found in tables if found.part_type is not None)
    of_type = (found if found.part_type == chosen else _read(read, Path(found.path), chosen) for found in tables)
    return concatenated([found for found in of_type if found is not None], len(files))


def files_of(path: Path, number: int) -> list[Path] | None:
    """All files of the snapshot that a file is one of; None where its name does not say which it is."""
    match = PART.fullmatch(path.name)
    if match is None or int(match[2]) >= number:
        return None
    return [path.with_name(f"{match[1]}{nth}{match[3] or ''}") for nth in range(number)]


def concatenated(tables: Sequence[ParticleTable], number: int) -> ParticleTable:
    """One table of the particles of several, with what the first says of all.

    Raises:
        ValueError: columns differ.
    """
    first = tables[0]
    filled = [table for table in tables if len(table)] or [first]
    for table in filled[1:]:
        differ = set(filled[0].columns) ^ set(table.columns)
        if differ or (table.support is None) != (filled[0].support is None):
            what = ", ".join(sorted(differ)) or "supports"
            raise DataError(f"{table.path}: {what} of the particles are in some files of the snapshot only; write it again")

    def whole(arrays: Sequence[np.ndarray | None]) -> np.ndarray | None:
        present = [array for array in arrays if array is not None]
        return np.concatenate(present) if present else None

    columns = {name: np.concatenate([table.columns[name] for table in filled]) for name in filled[0].columns}
    position = np.concatenate([table.position for table in filled])
    support, volume = whole([table.support for table in filled]), whole([table.volume for table in filled])
    said = (*first.conventions, f"of {number} files")
    more: dict[str, Any] = {"support": support, "volume": volume, "conventions": said, "num_files": 1}
    return dataclasses.replace(first, position=position, columns=columns, **more)


def _read(read: Reader, file: Path, part_type: int | None) -> ParticleTable | None:
    try:
        return dataclasses.replace(read(file, part_type), path=str(file))
    except NoParticlesError:
        return None


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
