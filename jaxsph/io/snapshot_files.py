"""Which files belong together: those of one snapshot, and the snapshots of a sequence, in their order.

Flow: path, reader -> [files: joined] -> ParticleTable of all files; paths, times -> [files: in_order] -> Order -> snapshots.

Codes that run on many nodes write a snapshot to several files, `snap_002.0.hdf5`, `snap_002.1.hdf5`, ... Any of them stands for
all. Files may lack a type of particles that others have. A sequence is ordered by the times in its files, else by the numbers in
their names.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsph.io.damage import DataError, NoParticlesError, regular_file
from jaxsph.io.parsing import choose_type
from jaxsph.io.table import ParticleTable, has_role

DIGITS = re.compile(r"\d+")
BY_FILES = "as the files say"
MAX_NAMED = 8  # missing numbers that a message names one by one
NAMED = 3  # missing files that are named at most
PART = re.compile(r"(.*\.)(\d+)(\.[A-Za-z]\w*)?")
COUNTED = 2**32  # up to which headers count
STRANGERS = "these are not the files of one snapshot; copy all of them again, into a folder of their own"
Reader = Callable[[Path, int | str | None], ParticleTable]


def joined(path: Path, part_type: int | str | None, read: Reader) -> ParticleTable:
    """The particles of all files of a snapshot, in the order of their numbers, given any of them, be there some in it or not."""
    try:
        table = read(path, part_type)
    except NoParticlesError:
        of_others = (_read(read, file, part_type) for file in with_parts([path])[1:])
        other = next((part for part in of_others if part is not None), None)
        if other is None or other.num_files == 1:
            raise
        table = other
    if table.num_files == 1:
        if is_all(len(table), table):
            return table
        note = f"its header says {table.announced} particles of this type, and it has {len(table)}: is it a part of another?"
        return table.with_notes(note)
    files = files_of(path, table.num_files)
    if files is None:
        note = f"one of {table.num_files} files of the snapshot, by a name without its number: only its particles are read"
        return table.with_notes(note)
    tables = [part for file in files if (part := _read(read, file, part_type)) is not None]
    filled = [part for part in tables if len(part)] or tables
    chosen = choose_type(sorted({part.part_type for part in filled if part.part_type is not None}), None)
    of_type = (part if part.part_type == chosen else _read(read, Path(part.path), chosen) for part in tables)
    parts = [part for part in of_type if part is not None]
    refuse_strangers(parts, sum(map(len, parts)))
    return concatenated(parts, len(files))


def is_all(count: int, table: ParticleTable) -> bool:
    """Whether so many particles are all that the snapshot announces, if it does."""
    return not table.announced or (count - table.announced) % COUNTED == 0


def refuse_strangers(parts: Sequence[ParticleTable], count: int) -> None:
    """Refuse files of together `count` particles that are not all parts of one snapshot, by what each begins with."""
    first, firsts = parts[0], dict[bytes, ParticleTable]()
    for part in parts:
        for name in ("num_files", "announced", "time", "box_size"):
            own, other = getattr(part, name), getattr(first, name)
            if own != other:
                raise DataError(f"{part.path}: has {name} = {own}, and {first.path} {other}: {STRANGERS}")
        twin = firsts.setdefault(part.position[:1].tobytes(), part) if len(part) else part
        if twin is not part and np.array_equal(twin.position, part.position) and np.ptp(part.position, 0).any():
            raise DataError(f"{part.path}: has the particles of {twin.path} once more: {STRANGERS}")
    if not is_all(count, first):
        raise DataError(f"{first.path}: announces {first.announced} particles, and its files have {count}: {STRANGERS}")


def files_of(path: Path, number: int) -> list[Path] | None:
    """All files of the snapshot that a file is one of; None where its name does not say which it is.

    Raises `ValueError`: some are not there, or no regular files. The folder is listed once: a header may ask for any number.
    """
    match = PART.fullmatch(path.name)
    if match is None or int(match[2]) >= number:
        return None
    there = _numbers_beside(path, match[1], match[3] or "", number)
    missing = (f"{match[1]}{nth}{match[3] or ''}" for nth in range(number) if nth not in there)
    named, num_missing = list(itertools.islice(missing, NAMED)), number - len(there)
    for name in named:
        if path.with_name(name).exists():
            regular_file(path.with_name(name))  # says what it is instead
    if named:
        more = f" and {num_missing - NAMED} more" if num_missing > NAMED else ""
        raise DataError(f"{path}: is one of {number} files of a snapshot; beside it {', '.join(named)}{more} cannot be found")
    return [path.with_name(f"{match[1]}{nth}{match[3] or ''}") for nth in range(number)]


def with_parts(files: Iterable[Path]) -> list[Path]:
    """Files, and those beside them that are called alike but for their number, as parts of one snapshot are."""
    files = list(files)
    alike = {(file.parent, match[1], match[3] or ""): file for file in files if (match := PART.fullmatch(file.name))}
    for (folder, before, after), file in alike.items():
        files += [folder / f"{before}{nth}{after}" for nth in _numbers_beside(file, before, after, sys.maxsize)]
    return files


def _numbers_beside(path: Path, before: str, after: str, number: int) -> set[int]:
    """Numbers below `number` of the regular files that are called as this one but for that."""
    with os.scandir(path.parent) as entries:
        matches = [(entry, PART.fullmatch(entry.name)) for entry in entries if entry.name.startswith(before)]
        alike = [(entry, match[2]) for entry, match in matches if match and (match[1], match[3] or "") == (before, after)]
        numbers = {int(text) for entry, text in alike if text == str(int(text)) and entry.is_file()}
    return {nth for nth in numbers if nth < number}


def concatenated(tables: Sequence[ParticleTable], number: int) -> ParticleTable:
    """One table of the particles of several, with what the first says of all; columns that not all have are left out.

    Raises `ValueError`: supports, volumes, masses or densities are in some files only.
    """
    first = tables[0]
    filled = [table for table in tables if len(table)] or [first]
    widths = [{name: column.shape[1:] for name, column in table.columns.items()}.items() for table in filled]
    shared = set(widths[0]).intersection(*widths)
    partial = {name for held in widths for name, _ in set(held) - shared}
    needed = sorted(name for name in partial if has_role(name, "mass") or has_role(name, "density"))
    for table in filled[1:]:
        for name in ("support", "volume"):
            if (getattr(table, name) is None) != (getattr(filled[0], name) is None):
                needed.append(f"{name}s")
        if needed:
            what = ", ".join(needed)
            raise DataError(f"{table.path}: {what} of the particles are in some files of the snapshot only; write it again")

    names = [name for name, _ in widths[0] if name not in partial]
    columns = {name: np.concatenate([table.columns[name] for table in filled]) for name in names}
    whole: dict[str, Any] = {}
    for name in ("position", "support", "volume"):
        arrays = [getattr(table, name) for table in filled]
        whole[name] = None if arrays[0] is None else np.concatenate(arrays)
    left_out = [f"left out {', '.join(sorted(partial))}: in some files of the snapshot only"] if partial else []
    said = (*first.conventions, *left_out, *([f"of {number} files"] if number > 1 else []))
    return dataclasses.replace(first, **whole, columns=columns, conventions=said)


def _read(read: Reader, file: Path, part_type: int | str | None) -> ParticleTable | None:
    try:
        return dataclasses.replace(read(file, part_type), path=str(file))
    except NoParticlesError:
        return None


class Order(NamedTuple):
    """When the snapshots of a sequence are."""

    indices: tuple[int, ...]  # of the files as given, in the order of time
    times: tuple[float, ...]  # that ascend, one a file
    told: str  # one sentence on where they are from
    by_files: bool  # whether the files say them


def numbers_of(paths: Sequence[Path]) -> tuple[int, ...] | None:
    """The number of each file in the sequence; `None` where names differ in anything but one number."""
    names = [path.name for path in paths]
    runs = [DIGITS.findall(name) for name in names]
    texts = {tuple(DIGITS.split(name)) for name in names}
    if len(paths) < 2 or len(texts) > 1 or not runs[0]:
        return None
    differing = [place for place in range(len(runs[0])) if len({run[place] for run in runs}) > 1]
    if len(differing) != 1:
        return None
    return tuple(int(run[differing[0]]) for run in runs)


def missing_numbers(numbers: Sequence[int]) -> list[int]:
    """What is not there of an evenly numbered sequence.

    Its step is the most common difference of neighbours, the smaller of two that are equally common; so every tenth snapshot of
    a run lacks nothing. Where a difference is no multiple of the step nothing is said to be missing.
    """
    there = sorted(set(numbers))
    steps = [after - before for before, after in itertools.pairwise(there)]
    if not steps:
        return []
    step = max(collections.Counter(steps).items(), key=lambda pair: (pair[1], -pair[0]))[0]
    gaps = [range(before + step, after, step) for before, after in itertools.pairwise(there) if (after - before) % step == 0]
    return [number for gap in gaps for number in gap]


def require_no_gap(paths: Sequence[Path]) -> None:
    """Raise `ValueError` that names the numbers that are missing in the names of a sequence."""
    numbers = numbers_of(paths)
    missing = [] if numbers is None else missing_numbers(numbers)
    if numbers is None or not missing:
        return
    ends = max(n for n in numbers if n < missing[0]), min(n for n in numbers if n > missing[0])
    before, after = (paths[numbers.index(end)] for end in ends)
    named, more = ", ".join(map(str, missing[:MAX_NAMED])), len(missing) - MAX_NAMED
    one = len(missing) == 1
    said = f"{'number' if one else 'numbers'} {named}{f' and {more} more' if more > 0 else ''} {'is' if one else 'are'} missing"
    raise ValueError(f"{said} in the sequence, first between {before} and {after}")


def in_order(paths: Sequence[Path], times: Sequence[float | None]) -> Order:
    """The order of snapshots, and when they are. Raises `ValueError`: two of them are of the same time."""
    numbers = numbers_of(paths)
    if all(time is not None for time in times):
        moments = [float(time) for time in times if time is not None]
        words = BY_FILES
    elif numbers is not None:
        moments, words = [float(number) for number in numbers], "the numbers in the names, as not all files say when they are"
    else:
        moments = [float(place) for place in range(len(paths))]
        words = "the places in the order given, as not all files say when they are"
    indices = tuple(sorted(range(len(paths)), key=lambda place: moments[place]))
    for one, other in itertools.pairwise(indices):
        if moments[one] == moments[other]:
            raise ValueError(f"{paths[one]} and {paths[other]} are both of time {moments[one]:g}; leave one of them out")
    if words == BY_FILES and numbers is not None and [numbers[i] for i in indices] != sorted(numbers):
        words += "; that is another order than the numbers in their names have"
    by_files = words.startswith(BY_FILES)
    return Order(indices, tuple(moments[place] for place in indices), words, by_files)
