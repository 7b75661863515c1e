"""What the files of a sequence hold, found by reading each once before anything is rendered.

Flow: paths -> [survey] -> Snapshots.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxsph import io
from jaxsph.io.opening.options import Source
from jaxsph.io.opening.rest_frame import in_frame
from jaxsph.io.settle.assemble import chosen
from jaxsph.io.settle.matching import Matched, agree, evaluated, ids_of, match, runs, velocity_of, way_of
from jaxsph.io.settle.quantities import choose_quantity
from jaxsph.io.snapshot_files import Order, files_of, in_order, numbers_of, require_no_gap
from jaxsph.model.camera.camera import BoundingBox
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.maps import value_range
from jaxsph.numerics.checks import Progress

MAX_VALUES = 1 << 16  # values of a file that the range over all files is taken from, evenly spread over its particles
FAR = 4.0  # supports that particles may move between snapshots before it is said that straight ways are a guess
Who = tuple[np.ndarray | str, np.ndarray, np.ndarray | None]
"""Of a snapshot's particles: ids, or why there are none, positions, and velocities where it has them."""
Way = tuple[Matched, np.ndarray, tuple[np.ndarray, np.ndarray] | None]
"""To the next snapshot: who is who, how far those in both have moved; velocities times the time between, of all in each, where
they tell how particles move."""
NEARLY_ALL, AMPLY = (10, 90), 0.3
"""Percentiles between which most of a file lies, and by how much of that a picture is larger to either side, at most."""


@dataclasses.dataclass(frozen=True)
class SnapshotFile:
    """One file of a sequence."""

    path: Path
    identity: tuple[tuple[str, int, int], ...]  # name, bytes and time of change in nanoseconds, of all files of the snapshot
    num_particles: int
    time: float | None  # as the file says it
    box: tuple[float, float, float] | None  # edges of its period
    bounding_box: BoundingBox  # around its particles, with their supports where the file has them
    bulk: BoundingBox  # the same without what lies far from nearly all of them


@dataclasses.dataclass(frozen=True)
class UnreadFile:
    """A file of a sequence that cannot be read; called, as the source of a frame, it raises `ValueError`: why."""

    path: Path
    why: str  # what is wrong with it, and its name
    before: int = -1  # which of the files that can be read is before it in the order of time; -1 where none is

    def __call__(self) -> Scene:
        """There is none."""
        raise ValueError(self.why)


class Step(NamedTuple):
    """From one file to the next."""

    matched: int  # particles that are in both, by their ids
    vanish: int  # those that are in the first alone
    appear: int  # and in the second
    moved: float | None  # median way of a particle over the median support; None where supports are not in the file
    curved: bool  # whether velocities tell how particles move

    @classmethod
    def between(cls, first: io.ParticleTable, second: io.ParticleTable) -> Step | str:
        """The step, or why particles cannot be told."""
        duration = None if first.time is None or second.time is None else second.time - first.time
        one, other = ((ids_of(table), table.position, velocity_of(table)) for table in (first, second))
        way = way_between(one, other, duration, second.box_size)
        if isinstance(way, str):
            return way
        matched, moved, run = way
        length = float(np.median(np.linalg.norm(moved, axis=1)))
        supports = None if first.support is None else length / float(np.median(first.support))
        return cls(len(matched.first), len(matched.only_first), len(matched.only_second), supports, run is not None)


@dataclasses.dataclass(frozen=True, eq=False)
class Survey:
    """What the files of a sequence hold."""

    files: tuple[SnapshotFile, ...]  # in the order of time
    order: Order
    source: Source  # what of them was asked for
    quantity: str  # full name of what is shown, of all of them
    middle: Particles  # of the file in the middle
    report: io.Report  # what was settled for those
    span: tuple[float, float]  # range of nearly all values of all files
    box: tuple[float, float, float] | None  # edges of the periodic box that all files have
    wide: bool  # whether positions are float64 in any file
    steps: tuple[Step | str, ...]  # or why ids cannot be matched; none where times have another order than names
    unread: tuple[UnreadFile, ...] = ()  # by their names in the sequence, as they do not say when they are

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the box around all particles of all files, or of their period."""
        if self.box is not None:
            return np.zeros(3), np.array(self.box)
        return BoundingBox.around(file.bounding_box for file in self.files)

    def bulk(self) -> BoundingBox | None:
        """The box around nearly all particles of all files; None where there is a period, or it is all there is."""
        box, (lower, upper) = BoundingBox.around(file.bulk for file in self.files), self.bounds()
        return None if self.box is not None or (box.upper - box.lower >= upper - lower).all() else box

    def told(self) -> list[str]:
        """Sentences on what is between the files."""
        together = [step for step in self.steps if isinstance(step, Step)]
        said = []
        for why in dict.fromkeys(step for step in self.steps if isinstance(step, str)):
            said.append(f"{self.steps.count(why)} of {len(self.steps)} intervals show the nearer snapshot, as {why}")
        if together:
            counts = [f"{sum(getattr(step, name) for step in together):,} {name}" for name in ("matched", "vanish", "appear")]
            where = f"in {len(together)} of {len(self.steps)} intervals: {', '.join(counts)}"
            said.insert(0, f"particles move from file to file by their ids, {where}")
            curved = sum(step.curved for step in together)
            said.insert(1, f"by their velocities in {curved} of these, straight and evenly in {len(together) - curved}")
        far = max((step.moved for step in together if step.moved is not None), default=0.0)
        if len({file.box for file in self.files}) > 1:
            said.append("periods of the files differ, so there is none: supports do not reach across faces")
        if far > FAR:
            said.append(f"the median particle moves by up to {far:.2g} supports from file to file: what is between is a guess")
        return said


def table_of(source: Source, path: Path) -> io.ParticleTable:
    """What a file holds of what is asked for."""
    table = io.read_table(path, part_type=source.part_type, physical=source.physical)
    return chosen(in_frame(table, source.frame, source.box), source.color_by, *source.how, **source.which)


def surveyed(
    paths: Iterable[str | os.PathLike[str]],
    source: Source,
    *,
    gaps: bool,
    strict: bool,
    progress: Progress | None,
) -> Survey:
    """Read all files once; see `Snapshots.from_files`."""
    if len(source.types) > 1:
        raise ValueError(f"`part_type` must be one type of particles for a sequence, got {source.part_type!r}; choose one")
    named = _named(paths, gaps)
    middle, report = _middle(named, source)
    support = float(np.asarray(middle.support).max(initial=0))
    files, steps, unread = list[SnapshotFile](), list[Step | str](), list[tuple[Path, str, int]]()
    values, wide, last = [], False, None
    for number, path in enumerate(named, 1):
        try:
            table = table_of(source, path)
            shown = _values(table, source, report.quantity)
        except (ValueError, OSError) as error:
            unread.append((path, str(error) if str(path) in str(error) else f"{path}: {error}", len(files)))
            last = None
        else:
            files.append(_file(path, table, _reach(table, source, support) if len(table) else 0.0))
            values.append(shown[:: max(len(shown) // MAX_VALUES, 1)])
            wide |= table.position.dtype == np.float64
            steps += [] if last is None else [Step.between(last, table)]
            last = table
        if progress is not None:
            progress(number, len(named))
    if strict and unread:
        told = "; ".join(why for _, why, _ in unread)
        raise ValueError(f"{len(unread)} of {len(named)} snapshots cannot be read, so nothing is rendered: {told}")
    boxes = {file.box for file in files}
    order = in_order([file.path for file in files], [file.time for file in files])
    return Survey(
        files=tuple(files[place] for place in order.indices),
        order=order,
        source=source,
        quantity=report.quantity,
        middle=middle,
        report=report,
        span=value_range(np.concatenate(values)),
        box=boxes.pop() if len(boxes) == 1 else None,
        wide=wide,
        steps=tuple(steps) if order.indices == tuple(range(len(files))) else (),
        unread=tuple(UnreadFile(path, why, order.indices.index(read - 1) if read else -1) for path, why, read in unread),
    )


def _named(paths: Iterable[str | os.PathLike[str]], gaps: bool) -> list[Path]:
    """Files that are there, by the numbers in their names, of which none is missing unless there may be `gaps`."""
    named = [Path(path) for path in paths]
    if not named:
        raise ValueError("`paths` must be at least one particle file, got none")
    numbers = numbers_of(named)
    if numbers is not None:
        named = [path for _, path in sorted(zip(numbers, named, strict=True))]
    for path in named:
        if not path.exists():
            raise FileNotFoundError(f"{path}: there is no such file")
    if not gaps:
        require_no_gap(named)
    return named


def _middle(paths: list[Path], source: Source) -> tuple[Particles, io.Report]:
    """The file in the middle, or the next to it that can be read: those that cannot are told of later, all at once."""
    nearest = sorted(paths, key=lambda path: abs(paths.index(path) - len(paths) // 2))
    for path in nearest:
        try:
            table = table_of(source, path)
        except io.ConditionError:
            raise
        except (ValueError, OSError) as error:
            if path == nearest[-1]:
                raise ValueError(f"none of {len(paths)} snapshots can be read; the last: {error}") from error
            continue
        return io.particles_from_table(table, source.color_by, *source.how, opacity_by=source.opacity_by)
    raise AssertionError("there is a last path")


def _file(path: Path, table: io.ParticleTable, reach: float) -> SnapshotFile:
    within = sorted(path.rglob("*")) if path.is_dir() else files_of(path, table.num_files) or [path]
    states = ((str(file.relative_to(path.parent)), file.stat()) for file in within)
    identity = tuple((name, state.st_size, state.st_mtime_ns) for name, state in states)
    bulk = bounding_box = BoundingBox.around(())
    if len(table):
        position = table.position.astype(np.float64)
        lower, upper = position.min(0), position.max(0)
        bounding_box = BoundingBox(lower - reach, upper + reach)
        low, high = np.percentile(position, NEARLY_ALL, axis=0)
        amply, own = AMPLY * (high - low), np.minimum(reach, AMPLY * (high - low).max())
        bulk = BoundingBox(np.maximum(lower, low - amply) - own, np.minimum(upper, high + amply) + own)
    return SnapshotFile(path, identity, len(table), table.time, table.box_size, bounding_box, bulk)


def _values(table: io.ParticleTable, source: Source, quantity: str) -> np.ndarray:
    try:
        return choose_quantity(table, quantity)[0]
    except io.DataError:  # a density that is summed over neighbours is not in the file
        return io.particles_from_table(table, quantity, *source.how)[0].to_numpy()["quantity"]


def _reach(table: io.ParticleTable, source: Source, support: float) -> float:
    """The longest support of a file, that of the middle one where it has none."""
    if source.support is not None:
        return float(np.max(evaluated(table, source.support, "support")) if isinstance(source.support, str) else source.support)
    return support if table.support is None else float(table.support.max(initial=0))


def way_between(first: Who, second: Who, duration: float | None, box: tuple[float, ...] | None) -> Way | str:
    """The way from one snapshot to the next, or why particles cannot be told."""
    (ids, place, velocity), (other_ids, other_place, other_velocity) = first, second
    matched = match(ids, other_ids)
    if isinstance(matched, str):
        return matched
    moved = way_of(place[matched.first], other_place[matched.second], box)
    run = runs(velocity, other_velocity, duration)
    if run is not None and not agree(moved, (run[0][matched.first], run[1][matched.second])):
        run = None
    return matched, moved, run
