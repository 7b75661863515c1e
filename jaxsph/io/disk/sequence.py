"""The snapshots of a sequence in their order: by the times in the files, else by the numbers in their names.

Flow: paths, times -> [sequence] -> order, times -> snapshots.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import re
from collections.abc import Sequence
from pathlib import Path

DIGITS = re.compile(r"\d+")
BY_FILES = "as the files say"
MAX_NAMED = 8  # missing numbers that a message names one by one


@dataclasses.dataclass(frozen=True)
class Order:
    """When the snapshots of a sequence are.

    Attributes:
        indices: of the files as given, in the order of time.
        times: that ascend, one a file.
        told: one sentence on where they are from.
        by_files: whether the files say them.
    """

    indices: tuple[int, ...]
    times: tuple[float, ...]
    told: str
    by_files: bool


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
        found = [float(time) for time in times if time is not None]
        told = BY_FILES
    elif numbers is not None:
        found, told = [float(number) for number in numbers], "the numbers in the names, as not all files say when they are"
    else:
        found = [float(place) for place in range(len(paths))]
        told = "the places in the order given, as not all files say when they are"
    indices = tuple(sorted(range(len(paths)), key=lambda place: found[place]))
    for one, other in itertools.pairwise(indices):
        if found[one] == found[other]:
            raise ValueError(f"{paths[one]} and {paths[other]} are both of time {found[one]:g}; leave one of them out")
    if told == BY_FILES and numbers is not None and [numbers[i] for i in indices] != sorted(numbers):
        told += "; that is another order than the numbers in their names have"
    by_files = told.startswith(BY_FILES)
    return Order(indices, tuple(found[place] for place in indices), told, by_files)
