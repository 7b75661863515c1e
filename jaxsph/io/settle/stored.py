r"""Whether smoothing lengths and densities that a file stores are those of its particles: a sample of them is asked.

Flow: ParticleTable -> [stored] -> supports and volumes of `assemble`, or a sentence on why they are not used.

A column called a smoothing length is a softening in some codes, and a column called a density is 1 everywhere in files of
initial conditions. No header tells. A length is taken for $h$, with the support $2 h$, where that reaches a plausible number of
neighbours that is about the same everywhere; a density is taken for one where it is about the sum
$\sum_j m_j W(|x_i - x_j|, H_i)$ of the cubic spline. A code's least smoothing length shows as a pile of equal smallest values:
supports of the pile reach more particles than others do, and are as the code had them.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy

from jaxsph.io.settle.quantities import ROLES
from jaxsph.io.settle.supports import NEIGHBOURS, Sides, gathered, in_period
from jaxsph.io.table import ParticleTable
from jaxsph.model.particles import kernels

SAMPLED = 512
"""Particles that are asked: the median of so many is known to a few per cent, and a search among all takes milliseconds."""
MAX_WHOLE, REGIONS, REGION = 2**20, 8, 2**15
"""Particles up to which all are searched; of more, this many cubes with so many particles each."""
MIN_PARTICLES = 64  # fewer have more surface than inside: neither neighbours nor sums tell
MIN_NEIGHBOURS, MAX_NEIGHBOURS = 16, 160
"""Neighbours within 2 h: codes have 32 to 64. A length that is the support itself would reach eight times as many."""
STEADY, MIDDLE = 3.0, (16, 84)
"""Their ratio, between these percentiles, up to which they are about the same: up to 2.0 of h, above 10 for softenings."""
PILE = 0.01  # share of lengths that are equal to the smallest from which it is a floor
ALIKE = 2.0
"""Ratio of a density to the sum, either way, up to which it is one: kernels and neighbours that codes choose make up to 1.4."""
SPREAD, SPREAD_BETWEEN = 4.0, (10, 90)
"""Ratio of the sums, between these percentiles, from which one density for all is a placeholder: that of a liquid is 2."""
FEWEST_SUMMED, MOST_SUMMED = 16, 512
"""Particles that sums go over: a support that reaches fewer or more is not what is judged here."""
KERNEL = "cubic_spline"
SUPPORT_OVER_H = 2.0


@dataclasses.dataclass(frozen=True)
class StoredDensity:
    """What was found of a density column.

    Attributes:
        column: name of the column, where volumes are masses over it; else `None`.
        measured: its ratio to the sums; empty where it is not used, or was not measured.
        told: why it is not used, or is used unchecked; else empty.
        placeholder: name of a column that is one number for all, and not their density; else `None`.
    """

    column: str | None
    measured: str = ""
    told: str = ""
    placeholder: str | None = None


def with_stored_lengths(table: ParticleTable, *names: str) -> ParticleTable:
    """The table with supports of twice the first of its columns of these names that proves to be a smoothing length.

    Conventions say of each column that is there what was measured, and whether it is used.
    """
    said: list[str] = []
    for name in filter(None, (table.named(name) for name in names)):
        trouble, told = _judged_length(table, name)
        if trouble is None:
            support = SUPPORT_OVER_H * table.columns[name].astype(np.float64)
            return dataclasses.replace(table, support=support, conventions=(*table.conventions, *said, *told))
        said.append(f"column `{name}` is not used: {trouble}; pass `support=` to set supports yourself")
    return dataclasses.replace(table, conventions=(*table.conventions, *said))


def stored_density(table: ParticleTable) -> StoredDensity:
    """Whether volumes are masses over the stored density: it is the sum over the file's supports, else to the 32nd neighbour.

    Sets that are too small, or flat, cannot be judged, and are believed.
    """
    mass_name, name = (table.named(*ROLES[role]) for role in ("mass", "density"))
    if table.volume is not None or mass_name is None or name is None or not len(table):
        return StoredDensity(None)
    not_used = f"stored density `{name}` is not used for volumes"
    for positive in (mass_name, name):
        if not is_positive(table.columns[positive]):
            return StoredDensity(None, told=f"{not_used}: `{positive}` is not one positive number a particle")
    if len(table) < MIN_PARTICLES or not np.ptp(table.position, axis=0).all():
        return StoredDensity(name, told=f"stored density `{name}` is used unchecked: particles are too few, or in a plane")
    column, mass = (table.columns[key].astype(np.float64) for key in (name, mass_name))
    rows, sums = _sampled_sums(table, mass)
    ratio = float(np.median(column[rows] / sums))
    low, high = np.percentile(sums, SPREAD_BETWEEN)
    constant = bool(column.min() == column.max())
    measured = f"{ratio:.3g} times the sum of kernels in the median of {len(rows)} particles"
    if 1 / ALIKE <= ratio <= ALIKE and not (constant and high > SPREAD * low):
        return StoredDensity(name, measured)
    what = f"it is {column[0]:g} everywhere, and sums are {low:.3g} .. {high:.3g}" if constant else f"it is {measured}"
    remedy = "set `volume` of the table to have others"
    return StoredDensity(None, told=f"{not_used}: {what}; {remedy}", placeholder=name if constant else None)


def without_placeholder(table: ParticleTable, stored: StoredDensity) -> ParticleTable:
    """The table without a density that is none, so that densities are sums whatever they are asked for by."""
    if stored.placeholder is None:
        return table
    columns = {name: column for name, column in table.columns.items() if name != stored.placeholder}
    return dataclasses.replace(table, columns=columns)


def _judged_length(table: ParticleTable, name: str) -> tuple[str | None, list[str]]:
    """Why a column is no smoothing length, `None` where it is, and then sentences on what is used."""
    length = table.columns[name]
    if not is_positive(length):
        return "it is not one positive number a particle", []
    if len(table) < MIN_PARTICLES:
        return f"{len(table)} particles are too few to tell a smoothing length from a softening", []
    piled = length == length.min()
    share = float(piled.mean())
    has_floor = PILE <= share <= 0.5
    judged = piled if share > 0.5 else ~piled  # of a length for all, or nearly so, the pile is what there is to judge
    asked = _Asked(table, *((judged, piled) if has_floor else (judged,)))
    rows = asked.rows
    reach = SUPPORT_OVER_H * length[rows, None].astype(np.float64) * (1 + float(np.finfo(np.float32).eps))
    reached = (asked.nearest(MAX_NEIGHBOURS + 1)[0] <= reach).sum(axis=1) - 1.0  # at most one too many
    low, middle, high = np.percentile(reached[judged[rows]], (MIDDLE[0], 50, MIDDLE[1]))
    if not (MIN_NEIGHBOURS <= middle <= MAX_NEIGHBOURS and high <= STEADY * low):
        wanted = f"a steady number of {MIN_NEIGHBOURS} to {MAX_NEIGHBOURS}"
        return f"twice of it reaches {_capped(low)} .. {_capped(high)} neighbours (the middle two thirds), not {wanted}", []
    told = [f"support = 2 x {name}, which reaches {low:.0f} .. {_capped(high)} neighbours (the middle two thirds)"]
    if has_floor:
        at_floor, pile = float(np.median(reached[piled[rows]])), f"{share:.1%} of `{name}` is its least, {length.min():g}"
        if at_floor < middle:
            return f"{pile}, and twice of that reaches {at_floor:.0f} neighbours in the median, others {middle:.0f}", []
        reaches = f"where supports reach {_capped(at_floor)} neighbours in the median"
        told.append(f"{pile}: a floor of the code, {reaches}; pass `support=` to have others")
    return None, told


def _sampled_sums(table: ParticleTable, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a sample, and at each the sum of kernels times masses."""
    asked = _Asked(table, np.ones(len(table), bool))
    rows, (distance, neighbour) = asked.rows, asked.nearest(MOST_SUMMED)
    own = distance[:, NEIGHBOURS] if table.support is None else table.support[rows].astype(np.float64)
    reach = np.clip(own, distance[:, FEWEST_SUMMED], distance[:, -1])
    reach = np.maximum(reach, np.finfo(np.float32).tiny)  # of particles in one place
    return rows, gathered(kernels.by_name(KERNEL), distance, reach, mass[neighbour])


class _Asked:
    """A sample of particles, and the tree in which their neighbours are found: of large sets those around a few of them.

    It is made for few questions: cells are halved where they are, which is several times faster.
    """

    def __init__(self, table: ParticleTable, *masks: np.ndarray) -> None:
        self.points = in_period(table.position, table.box_size)
        self._held: np.ndarray | None = None
        if len(self.points) <= MAX_WHOLE:
            self.rows = np.unique(np.concatenate([_some(mask, SAMPLED) for mask in masks]))
        else:
            regions = [(mask, self._around(row, table.box_size)) for mask in masks for row in _some(mask, REGIONS)]
            near = [region[: SAMPLED // REGIONS] for _, region in regions]
            self.rows = np.unique(np.concatenate([few[mask[few]] for (mask, _), few in zip(regions, near, strict=True)]))
            self._held = np.unique(np.concatenate([region for _, region in regions]))
        within = self.points if self._held is None else self.points[self._held]
        self._tree = scipy.spatial.KDTree(within, 32, balanced_tree=False, compact_nodes=False, boxsize=table.box_size)

    def nearest(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Distances of the sample to so many particles, themselves first, and which rows these are."""
        distance, neighbour = self._tree.query(self.points[self.rows], k=min(self._tree.n, number + 1), workers=-1)
        return distance, neighbour if self._held is None else self._held[neighbour]

    def _around(self, row: int, box: Sides | None) -> np.ndarray:
        """About `REGION` particles in a cube around one, nearest first; how wide it is to be is told by a share of them."""
        farthest = np.zeros(len(self.points))
        for axis in range(3):
            apart = np.abs(self.points[:, axis] - self.points[row, axis])
            np.maximum(farthest, apart if box is None else np.minimum(apart, box[axis] - apart), out=farthest)
        few = farthest[:: max(1, REGION // SAMPLED)]
        wanted = min(len(few) - 1, SAMPLED)
        region = np.flatnonzero(farthest <= np.partition(few, wanted)[wanted])
        return region[np.argsort(farthest[region], kind="stable")]


def _some(mask: np.ndarray, number: int) -> np.ndarray:
    """Some of the rows that a mask marks, the same ones each time."""
    rows = np.flatnonzero(mask)
    return rows if len(rows) <= number else np.random.default_rng(0).choice(rows, number, replace=False, shuffle=False)


def is_positive(column: np.ndarray) -> bool:
    """Whether a column is one positive number a particle, of any particles."""
    return column.ndim == 1 and len(column) > 0 and bool((np.isfinite(column) & (column > 0)).all())


def _capped(count: float) -> str:
    return f"{count:.0f}" if count <= MAX_NEIGHBOURS else f"more than {MAX_NEIGHBOURS}"
