"""Which particles of a table are shown, by conditions and shares; those of two snapshots told by their ids, and what they are at
a time between.

Flow: ParticleTable, text -> [matching: select] -> assemble; ids of two snapshots -> [matching: match] -> Matched; columns of both
-> [matching: between] -> columns.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsph.io.damage import DataError
from jaxsph.io.settle.around import shortest
from jaxsph.io.settle.quantities import choose_quantity
from jaxsph.io.settle.where import ConditionError, Expression
from jaxsph.io.table import ParticleTable

ID_NAMES = ("id", "ids", "idp", "pid", "particleid", "particleids", "particle_id", "particle_ids", "iorig")
MIN_MATCHED = 0.5  # share of the smaller snapshot that must be found in the other: with fewer, ids are numbers of something else
MAX_MISSED = 0.5
"""Share of their way by which velocities may miss where particles are in the next snapshot, the median, to be of use."""
GEOMETRIC = ("support", "volume")  # columns that are positive by nature, and change by factors


class Matched(NamedTuple):
    """Where in two snapshots those particles stand that are in both, and those that are in one alone."""

    first: Int[np.ndarray, " both"]
    second: Int[np.ndarray, " both"]
    only_first: Int[np.ndarray, " vanish"]
    only_second: Int[np.ndarray, " appear"]


def ids_of(table: ParticleTable) -> np.ndarray | str:
    """The ids of a table's particles, or why there are none."""
    name = table.named(*ID_NAMES)
    if name is None:
        return "particles have no ids"
    ids = table.columns[name]
    if ids.ndim != 1 or ids.dtype.kind not in "iu":
        return f"`{name}` are no whole numbers"
    if len(np.unique(ids)) < len(ids):
        return f"several particles have the same `{name}`"
    return ids


def velocity_of(table: ParticleTable) -> np.ndarray | None:
    """The velocities of a table's particles, (N, 3), or None."""
    name = table.of_role("velocity")
    velocity = None if name is None else table.columns[name]
    usable = velocity is not None and velocity.ndim == 2 and velocity.shape[1] == 3 and np.isfinite(velocity).all()
    return velocity if usable else None


def runs(first: np.ndarray | None, second: np.ndarray | None, step: float | None) -> tuple[np.ndarray, np.ndarray] | None:
    """Velocities of two snapshots times the time between them, or None where any is not known."""
    if first is None or second is None or step is None:
        return None
    return step * first.astype(np.float64), step * second.astype(np.float64)


def match(first: np.ndarray | str, second: np.ndarray | str) -> Matched | str:
    """The particles of two snapshots that have the same id, or why they cannot be told."""
    if isinstance(first, str):
        return first
    if isinstance(second, str):
        return second
    _, one, other = np.intersect1d(first, second, assume_unique=True, return_indices=True)
    least = MIN_MATCHED * min(len(first), len(second))
    if len(one) <= least:
        return f"only {len(one):,} ids of {len(first):,} and {len(second):,} are the same"
    alone = [np.delete(np.arange(len(ids)), places) for ids, places in ((first, one), (second, other))]
    order = np.argsort(one)
    return Matched(one[order], other[order], *alone)


def between(
    first: Mapping[str, np.ndarray],
    second: Mapping[str, np.ndarray],
    matched: Matched,
    share: float,
    box: tuple[float, float, float] | None = None,
    run: tuple[np.ndarray, np.ndarray] | None = None,
) -> dict[str, np.ndarray]:
    """Columns of the particles at a share in (0, 1) of the way from one snapshot to the next, float64, see `Snapshots.at`.

    `run` holds velocities times the time between the snapshots, all of first and second; without, ways are straight.
    """
    columns = {}
    for name, before in first.items():
        one, other = (np.asarray(column, np.float64) for column in (before, second[name]))
        same = one[matched.first], other[matched.second]
        if name == "position":
            way = way_of(*same, box)
            moved = same[0] + share * way
            if run is not None:
                begin, end = share * (1 - share) ** 2, share**2 * (1 - share)
                moved = same[0] + share**2 * (3 - 2 * share) * way
                moved = moved + begin * run[0][matched.first] - end * run[1][matched.second]
            if box is not None and (same[0] >= 0).all() and (same[0] <= np.asarray(box)).all():
                moved = moved % np.asarray(box, np.float64)
        elif name in GEOMETRIC and all((end > 0).all() for end in same):
            moved = np.exp((1 - share) * np.log(same[0]) + share * np.log(same[1]))
        else:
            moved = (1 - share) * same[0] + share * same[1]
        alone = one[matched.only_first] if share < 0.5 else other[matched.only_second]
        columns[name] = np.concatenate([moved, alone])
    return columns


def way_of(first: np.ndarray, second: np.ndarray, box: tuple[float, ...] | None) -> Float[np.ndarray, "both 3"]:
    """How far particles have moved: in a periodic box, on the shortest way."""
    return shortest(second.astype(np.float64) - first, box)


def agree(way: Float[np.ndarray, "both 3"], run: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether velocities tell how particles move from one snapshot to the next: are in its units, and change little enough.

    The mean of the two must lead the median particle to within half of its way of where it is.
    """
    missed = np.linalg.norm(way - 0.5 * (run[0] + run[1]), axis=1)
    return bool(np.median(missed) <= MAX_MISSED * np.median(np.linalg.norm(way, axis=1)))


def select(
    table: ParticleTable, where: str | None = None, share: float | None = None, *, density: Callable[[], Any] | None = None
) -> tuple[Bool[np.ndarray, " particles"], tuple[str, ...]]:
    """Mark the particles that meet a condition, or a share of these; return notes on both, too.

    A share is drawn at random, but always the same, by ids where there are some.

    `density` gives the summed density when the table holds none.
    """
    shown, notes = np.ones(len(table), bool), []
    if where is not None:
        condition = Expression(where, lambda name: choose_quantity(table, name, density=density, finite=False)[0], "condition")
        parts = condition.parts()
        masks = [np.broadcast_to(condition.of_particles(part), len(table)) for part in parts]
        left_out = (f"{(~mask).sum():,} left out by {condition.source(part)}" for part, mask in zip(parts, masks, strict=True))
        shown, words = functools.reduce(np.logical_and, masks), ", ".join(left_out)
        notes.append(f"where {where}: {shown.sum():,} of {len(table):,} particles; {words}")
        if len(table) and not shown.any():
            raise DataError(f"no particle is left of {len(table):,} where {where}: {words}; `where` must leave some")
    if share is not None:
        everyone, shown = shown, _share_of(table, shown, share)
        notes.append(_told_of_share(share, shown, everyone))
    return shown, tuple(notes)


def _not_summed() -> np.ndarray:
    """Stand for a density that is a sum over particles, and is not known yet."""
    raise NotImplementedError


def drawn(
    table: ParticleTable, where: str | None, share: float
) -> tuple[ParticleTable, Int[np.ndarray, " some"], Bool[np.ndarray, " some"] | None, tuple[str, ...]]:
    """Draw a share of particles before their neighbours are looked for; each then stands for several.

    A share of those that meet a condition is the one of `select`, and there are as many of the others beside them, which are
    neighbours, too. Supports grow as spacings do, volumes as numbers.

    Returns:
        The table, the rows that it has, who of them meets the condition, None where that needs their summed density, and notes.
    """
    try:
        meets, notes = select(table, where, density=_not_summed)
    except NotImplementedError:
        some, rows, _, notes = drawn(table, None, share)
        return some, rows, None, notes
    chosen = _share_of(table, meets, share)
    rows = np.flatnonzero(chosen | _share_of(table, ~meets, share))
    each = float(meets.sum() / max(chosen.sum(), 1)) or 1.0
    some, wide = table.rows(rows), each ** (1 / table.dimensions)
    said = [
        f"{one}, {wide:.3g} times as far as in the file" if one.startswith("support =") and table.support is not None else one
        for one in table.conventions
    ]
    more: dict[str, Any] = {"stands_for": each, "conventions": tuple(said)}
    more |= {} if some.support is None else {"support": some.support * wide}
    more |= {} if some.volume is None else {"volume": some.volume * each}
    note = f"{_told_of_share(share, chosen, meets)}, in which each has the mass and the volume of {each:.4g}"
    return dataclasses.replace(some, **more), rows, meets[rows], (*notes, note)


def _told_of_share(share: float, chosen: np.ndarray, everyone: np.ndarray) -> str:
    count = f"{chosen.sum():,} of {everyone.sum():,} particles"
    return f"a share of {share:g}: {count}, for a quick look: their field is another one"


def _share_of(table: ParticleTable, among: np.ndarray, share: float) -> np.ndarray:
    """Of those that are kept a share, at random but always the same, at least one."""
    if not 0 < share <= 1:
        raise ConditionError(f"`share` must be above 0 and at most 1, got {share:g}; 0.1 shows a tenth of the particles")
    some = np.flatnonzero(among)
    number = min(max(round(share * len(some)), 1), len(some))
    chosen = np.zeros(len(table), bool)
    chosen[some[_shuffled(table)[some].argsort(kind="stable")[:number]]] = True
    return chosen


def evaluated(table: ParticleTable, text: str, name: str) -> np.ndarray:
    """The numbers, (N,) float64, of an expression such as `2*h`; those of its own supports are called `support`, too."""
    if table.support is not None:
        table = dataclasses.replace(table, columns={"support": table.support, **table.columns})
    try:
        return np.broadcast_to(Expression(text, lambda name: choose_quantity(table, name, finite=False)[0]).numbers(), len(table))
    except ConditionError as error:
        raise ConditionError(f"`{name}`: {error}") from error


def _shuffled(table: ParticleTable) -> np.ndarray:
    """Numbers to draw by, one a particle: of ids, such that a share is of the same particles in each file of a sequence."""
    ids = ids_of(table)
    if isinstance(ids, str):
        return np.random.default_rng(0).random(len(table))
    mixed = ids.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)  # Steele, Lea & Flood 2014: splitmix64
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return np.asarray(mixed ^ (mixed >> np.uint64(31)))
