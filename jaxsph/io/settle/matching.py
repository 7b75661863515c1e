"""The particles of two snapshots told by their ids, and what they are at a time between.

Flow: ids of two snapshots -> [matching: match] -> Matched; columns of both -> [matching: between] -> columns.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from jaxsph.io.settle.quantities import ROLES
from jaxsph.io.table import ParticleTable

ID_NAMES = ("id", "ids", "idp", "pid", "particleid", "particleids", "particle_id", "particle_ids", "iorig")
MIN_MATCHED = 0.5  # share of the smaller snapshot that must be found in the other: with fewer, ids are numbers of something else
MAX_MISSED = 0.5
"""Share of their way by which velocities may miss where particles are in the next snapshot, the median, to be of use."""
GEOMETRIC = ("support", "volume")  # columns that are positive by nature, and change by factors


@dataclasses.dataclass(frozen=True)
class Matched:
    """Which particles of two snapshots are the same.

    Attributes:
        first, second: where the particles that are in both stand in each.
        only_first, only_second: where those stand that are in one alone.
    """

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
    name = table.named(*ROLES["velocity"])
    found = None if name is None else table.columns[name]
    usable = found is not None and found.ndim == 2 and found.shape[1] == 3 and np.isfinite(found).all()
    return found if usable else None


def runs(first: np.ndarray | None, second: np.ndarray | None, step: float | None) -> tuple[np.ndarray, np.ndarray] | None:
    """Velocities of two snapshots times the time between them, or None where any is not known."""
    if first is None or second is None or step is None:
        return None
    return step * first.astype(np.float64), step * second.astype(np.float64)


def match(first: np.ndarray | str, second: np.ndarray | str) -> Matched | str:
    """The particles of two snapshots that have the same id, or why they cannot be told."""
    for ids in (first, second):
        if isinstance(ids, str):
            return ids
    assert not isinstance(first, str) and not isinstance(second, str)
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
    """Columns of the particles at a share in (0, 1) of the way from one snapshot to the next, float64.

    Particles in both move straight and evenly, on the shortest way across the faces of a periodic `box`; with `run`, velocities
    times the time between the snapshots, all of first and second, they move on the cubic that has them at its ends. Supports
    and volumes change geometrically, all else linearly. Particles in one alone are there for the half that is nearer to it,
    where they are.
    """
    found = {}
    for name, before in first.items():
        one, other = (np.asarray(column, np.float64) for column in (before, second[name]))
        same = one[matched.first], other[matched.second]
        if name == "position":
            moved = same[0] + share * way_of(*same, box)
            if run is not None:
                begin, end = share * (1 - share) ** 2, share**2 * (1 - share)
                moved = same[0] + share**2 * (3 - 2 * share) * way_of(*same, box)
                moved = moved + begin * run[0][matched.first] - end * run[1][matched.second]
            if box is not None and (same[0] >= 0).all() and (same[0] <= np.asarray(box)).all():
                moved = moved % np.asarray(box, np.float64)
        elif name in GEOMETRIC and all((end > 0).all() for end in same):
            moved = np.exp((1 - share) * np.log(same[0]) + share * np.log(same[1]))
        else:
            moved = (1 - share) * same[0] + share * same[1]
        alone = one[matched.only_first] if share < 0.5 else other[matched.only_second]
        found[name] = np.concatenate([moved, alone])
    return found


def way_of(first: np.ndarray, second: np.ndarray, box: tuple[float, ...] | None) -> Float[np.ndarray, "both 3"]:
    """How far particles have moved: in a periodic box, on the shortest way."""
    way = second.astype(np.float64) - first
    if box is None:
        return way
    edges = np.asarray(box, np.float64)
    return way - edges * np.round(way / edges)


def agree(way: Float[np.ndarray, "both 3"], run: tuple[np.ndarray, np.ndarray]) -> bool:
    """Whether velocities tell how particles move from one snapshot to the next: are in its units, and change little enough.

    The mean of the two must lead the median particle to within half of its way of where it is.
    """
    missed = np.linalg.norm(way - 0.5 * (run[0] + run[1]), axis=1)
    return bool(np.median(missed) <= MAX_MISSED * np.median(np.linalg.norm(way, axis=1)))
