r"""Support radii from nearest neighbours, kernel sums for volumes and densities, and whether those that a file stores are such.

Flow: ParticleTable -> [supports] -> supports and volumes of `assemble`, or a sentence on why what is stored is not used.

Many files hold points and nothing more. Where they lie about evenly, as those of liquids do, one support of two spacings is
theirs, so that what splashes off is as small as the rest; where they cluster, a support that reaches a fixed number of
neighbours. With the volume $V_i = 1 / \sum_j W(|x_i - x_j|, H_i)$ either turns such a set into an SPH field.

A column called a smoothing length is a softening in some codes, and a column called a density is 1 everywhere in files of
initial conditions. No header tells. A length is taken for $h$, with the support $2 h$, where that reaches a plausible number of
neighbours that is about the same everywhere; a density is taken for one where it is about the sum
$\sum_j m_j W(|x_i - x_j|, H_i)$ of the cubic spline. A code's least smoothing length shows as a pile of equal smallest values:
supports of the pile reach more particles than others do, and are as the code had them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxsph.io.damage import DataError
from jaxsph.io.file_units import between
from jaxsph.io.table import ParticleTable
from jaxsph.model.particles import kernels
from jaxsph.model.particles.flat import dimensions_of
from jaxsph.numerics.rows import distinct, share_places

Sides = tuple[float, float, float]
NEIGHBOURS = 32  # neighbours a support reaches when a file says nothing: about what SPH codes use in three dimensions
SPACINGS = 2.0  # of particles that lie evenly: support over spacing, as codes for liquids have it
EVEN, FEW = 1.45, 9
"""Ratio of the upper to the lower quartile of distances to the eighth neighbour up to which particles lie evenly, and how many
there must be to tell; liquids have 1.0 to 1.35, gas that has begun to cluster 1.55."""
EIGHTH = {1: 4.0, 2: 2**0.5, 3: 2**0.5}  # distance to the eighth neighbour on a lattice, over its spacing, by dimension
BALLS = {1: 2.0, 2: np.pi, 3: 4 / 3 * np.pi}  # volume of the unit ball, by dimension
SAMPLED = 1 << 14  # particles whose neighbours tell how evenly all lie
PAIR_BUDGET = 2**22  # pairs looked at in one go: about 100 MB of distances, indices and weights
MAX_PAIRS, SAMPLED_PARTICLES = 2**36, 256
"""Pairs of a kernel sum from which it is refused: hours of work, where a support was given in another unit; who tells."""
SHOW_PROGRESS_FROM = 100_000
"""Particles from which a search lasts long enough (about a second) to show a progress bar on a terminal."""
ASKED = 512
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


def even_spacing(position: Float[np.ndarray, "particles 3"], *, box: Sides | None = None, quick: bool = False) -> float | None:
    """Spacing of particles that lie about evenly, also across the faces of a `box`; None where they cluster, or are too few.

    A `quick` answer of large sets is that of a few cubes.
    """
    places = in_period(position, box)
    if share_places(places):
        position = places = places[distinct(places)[0]]
    if len(places) < FEW:
        return None
    if quick and len(places) > MAX_WHOLE:
        sample = _Sample(ParticleTable(position, box_size=box), np.ones(len(places), bool))
        eighth = sample.nearest(FEW - 1)[0][:, -1]
    else:
        some = places[:: max(1, len(places) // SAMPLED)]
        eighth = scipy.spatial.KDTree(places, boxsize=box).query(some, k=FEW, workers=-1)[0][:, -1]
    low, middle, high = np.percentile(eighth, (25, 50, 75))
    return float(middle / EIGHTH[dimensions_of(places, box)[0]]) if 0 < high <= EVEN * low else None


def neighbours_in(number: float, dimensions: int) -> float:
    """Number of neighbours within a distance, on a lattice, that holds `number` of them in three dimensions."""
    return float(BALLS[dimensions] * (number / BALLS[3]) ** (dimensions / 3))


def nearest_neighbour_supports(
    position: Float[np.ndarray, "particles 3"],
    neighbours: int = NEIGHBOURS,
    *,
    box: Sides | None = None,
    progress: bool = False,
    at: Int[np.ndarray, " centres"] | None = None,
) -> Float[np.ndarray, " particles"]:
    r"""Distance to the `neighbours`-th nearest other particle.

    With only $m <$ `neighbours` others, the distance $d$ to the farthest is scaled as in a uniform set,
    $H = d \, (k / m)^{1/3}$. Coincident particles count as one place where the distance would be 0 otherwise. Where
    there is only one place, no length is known and every support is 1.

    Args:
        position: (N, 3), any length unit; distances are computed in float64.
        neighbours: $k \ge 1$.
        box: sides of a periodic box, across whose faces neighbours are found; None for none.
        progress: show a progress bar; on a terminal large sets show one anyway.
        at: numbers of the particles that are asked; `None` for all.
    """
    if neighbours < 1:
        raise ValueError(f"`neighbours` must be at least 1, got {neighbours}; 32 is a good choice")
    position = in_period(position, box)
    count = len(position)
    if count == 0:
        return np.zeros(0)
    places, place_of = distinct(position)
    centres = np.arange(len(places)) if at is None else np.unique(place_of[at])
    shown = place_of if at is None else place_of[at]
    if len(places) == 1:
        return np.ones(len(shown))
    points, multiplicity = position[places], np.bincount(place_of)
    tree = scipy.spatial.KDTree(points, boxsize=box)
    reach, nearest = min(neighbours, count - 1), min(neighbours + 1, len(places))
    support = np.empty(len(places))
    for block in _slices(np.full(len(centres), nearest), progress, "supports"):
        rows = centres[block]
        distance, place = tree.query(points[rows], k=nearest, workers=-1)
        others = np.cumsum(multiplicity[place], axis=1) - 1  # all there are within that distance but the particle itself
        away = distance[np.arange(len(distance)), (others >= reach).argmax(axis=1)]
        among_particles = away * (neighbours / reach) ** (1 / 3)
        among_places = distance[:, -1] * (neighbours / (nearest - 1)) ** (1 / 3)
        support[rows] = np.where(away > 0, among_particles, among_places)
    return support[shown]


def kernel_sum(
    position: Float[np.ndarray, "particles 3"],
    support: Float[np.ndarray, " particles"] | float,
    weight: Float[np.ndarray, " particles"] | None = None,
    *,
    kernel: str = "poly6",
    box: Sides | None = None,
    progress: bool = False,
    at: Int[np.ndarray, " centres"] | None = None,
) -> Float[np.ndarray, " particles"]:
    r"""The gather sum $\sum_j w_j W(|x_i - x_j|, H_i)$ at every particle, itself included.

    With masses as weights this is the SPH density, as codes with varying supports define and store it (each particle
    uses its own $H_i$); without weights it is the number density, whose inverse is a volume.

    Args:
        position: (N, 3); distances are computed in float64.
        support: (N,) support radii $H > 0$, or one of all, same unit as `position`; with `at` of those.
        weight: (N,) weights $w$; `None` means 1.
        kernel: name of a kernel of `jaxsph.model.particles.kernels`.
        box, progress, at: as for `nearest_neighbour_supports`; sums go to the nearest image of each particle.

    Returns:
        (N,) float64 sums, positive where weights are, in units of `weight` over a volume.

    Raises:
        ValueError: supports that reach so many particles that the sum would take hours.
    """
    chosen = kernels.by_name(kernel)
    position = in_period(position, box)
    centres = position if at is None else position[at]
    support = np.broadcast_to(np.asarray(support, dtype=np.float64), len(centres))
    if len(position) == 0:
        return np.zeros(0)
    places, place_of = distinct(position)
    askers, asker_of = distinct(np.column_stack([centres, support]))
    weights = np.append(np.bincount(place_of, None if weight is None else np.asarray(weight, np.float64)), 0.0)
    tree, points, radii = scipy.spatial.KDTree(position[places], boxsize=box), centres[askers], support[askers]
    some = slice(None, None, max(1, len(points) // SAMPLED_PARTICLES))
    number = float(tree.query_ball_point(points[some], radii[some], return_length=True, workers=-1).mean())
    if number * len(points) > MAX_PAIRS:
        wrong = f"supports reach about {number:.0f} particles each, {number * len(points):.0f} pairs in all,"
        raise DataError(f"{wrong} and a kernel sum over them would take hours; give smaller supports, or check their unit")
    total = np.empty(len(askers))
    reached = tree.query_ball_point(points, radii, return_length=True, workers=-1)
    order = np.argsort(reached, kind="stable")  # correlation_length counts together, so that a block has little padding
    for block in _slices(reached[order], progress, "kernel sums"):
        rows = order[block]
        most, farthest = max(2, int(reached[rows].max())), float(radii[rows].max())  # k = 1 would drop an axis
        distance, neighbour = tree.query(points[rows], k=most, distance_upper_bound=farthest, workers=-1)
        total[rows] = gathered(chosen, distance, radii[rows], weights[neighbour])
    return total[asker_of]


def gathered(kernel: kernels.Kernel, distance: np.ndarray, support: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Sums over neighbours, one row each, of weights times kernels of its support; they may be infinitely far."""
    q = np.minimum(distance / support[:, None], 1.0)
    return np.asarray(kernel.norm * (kernel.of_square(q * q, np) * weight).sum(axis=1) / support**3)


def in_period(position: np.ndarray, box: Sides | None) -> np.ndarray:
    """Positions in float64, in a periodic box if there is one."""
    position = np.asarray(position, dtype=np.float64)
    if box is None:
        return position
    wrapped = np.mod(position, box)
    return np.where(wrapped >= box, 0.0, wrapped)


def _slices(pairs: np.ndarray, progress: bool, what: str) -> Iterator[slice]:
    """Consecutive blocks of rows whose largest entry of ascending `pairs`, times their number, fits `PAIR_BUDGET`.

    A bar shows how far they are when it is asked for, or when the wait is worth one and a person watches.
    """
    bar: Any = contextlib.nullcontext()
    count, start = len(pairs), 0
    if progress or (count >= SHOW_PROGRESS_FROM and sys.stderr.isatty()):
        with contextlib.suppress(ImportError):  # a bar is a comfort, not a need
            from tqdm import tqdm

            bar = tqdm(total=count, desc=what, unit=" particles", unit_scale=True, leave=False)
    with bar as shown:
        while start < count:
            largest = int(pairs[min(count, start + max(1, PAIR_BUDGET // int(pairs[start]))) - 1])
            stop = min(count, start + max(1, PAIR_BUDGET // largest))
            yield slice(start, stop)
            if shown is not None:
                shown.update(stop - start)
            start = stop


class StoredDensity(NamedTuple):
    """What was found of a density column."""

    column: str | None  # its name, where volumes are masses over it
    measured: str = ""  # its ratio to the sums; empty where it is not used, or was not measured
    told: str = ""  # why it is not used, or is used unchecked
    placeholder: str | None = None  # name of a column that is one number for all, and not their density


def with_stored_lengths(table: ParticleTable, *names: str) -> ParticleTable:
    """The table with supports of twice the first of its columns of these names that proves to be a smoothing length.

    Conventions say of each column that is there what was measured, and whether it is used.
    """
    said: list[str] = []
    for name in filter(None, (table.named(name) for name in names)):
        trouble, notes = _judged_length(table, name)
        if trouble is None:
            support = SUPPORT_OVER_H * table.exact(name)
            return dataclasses.replace(table, support=support, conventions=(*table.conventions, *said, *notes))
        said.append(f"column `{name}` is not used: {trouble}; pass `support=` to set supports yourself")
    return table.with_notes(*said)


def stored_density(table: ParticleTable) -> StoredDensity:
    """Whether volumes are masses over the stored density: it is the sum over the file's supports, else to the 32nd neighbour.

    Sets that are too small, or flat, cannot be judged, and are believed.
    """
    mass_name, name = (table.of_role(role) for role in ("mass", "density"))
    if table.volume is not None or mass_name is None or name is None or not len(table):
        return StoredDensity(None)
    not_used = f"stored density `{name}` is not used for volumes"
    for positive in (mass_name, name):
        if not is_positive(table.columns[positive]):
            return StoredDensity(None, told=f"{not_used}: `{positive}` is not one positive number a particle")
    if len(table) < MIN_PARTICLES or table.dimensions < 3:
        return StoredDensity(name, told=f"stored density `{name}` is used unchecked: particles are too few, or in a plane")
    column, mass = density_as_summed(table, name), table.exact(mass_name)
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


def density_as_summed(table: ParticleTable, name: str) -> np.ndarray:
    """Densities in masses over lengths cubed as these are stored: they may be physical, and lengths comoving."""
    units, mass = table.units, table.units.columns.get(table.of_role("mass") or "")
    summed = mass and units.length and mass.over(units.length, table.dimensions)
    return table.exact(name) * between(units.columns.get(name), summed, units)


def _judged_length(table: ParticleTable, name: str) -> tuple[str | None, list[str]]:
    """Say why a column is no smoothing length, or return `None` and sentences on the supports that it gives."""
    length = table.columns[name]
    if not is_positive(length):
        return "it is not one positive number a particle", []
    if len(table) < MIN_PARTICLES:
        return f"{len(table)} particles are too few to tell a smoothing length from a softening", []
    piled = length == length.min()
    share = float(piled.mean())
    has_floor = PILE <= share <= 0.5
    judged = piled if share > 0.5 else ~piled  # of a length for all, or nearly so, the pile is what there is to judge
    sample = _Sample(table, *((judged, piled) if has_floor else (judged,)))
    rows = sample.rows
    reach = SUPPORT_OVER_H * length[rows, None].astype(np.float64) * (1 + float(np.finfo(np.float32).eps))
    number = (sample.nearest(MAX_NEIGHBOURS + 1)[0] <= reach).sum(axis=1) - 1.0  # at most one too many
    low, middle, high = np.percentile(number[judged[rows]], (MIDDLE[0], 50, MIDDLE[1]))
    fewest, most = (round(neighbours_in(one, table.dimensions)) for one in (MIN_NEIGHBOURS, MAX_NEIGHBOURS))
    if not (fewest <= middle <= most and high <= STEADY * low):
        wanted = f"a steady number of {fewest} to {most}"
        return f"twice of it reaches {_capped(low)} .. {_capped(high)} neighbours (the middle two thirds), not {wanted}", []
    notes = [f"support = 2 x {name}, which reaches {low:.0f} .. {_capped(high)} neighbours (the middle two thirds)"]
    if has_floor:
        at_floor, pile = float(np.median(number[piled[rows]])), f"{share:.1%} of `{name}` is its least, {length.min():g}"
        if at_floor < middle:
            return f"{pile}, and twice of that reaches {at_floor:.0f} neighbours in the median, others {middle:.0f}", []
        reaches = f"where supports reach {_capped(at_floor)} neighbours in the median"
        notes.append(f"{pile}: a floor of the code, {reaches}; pass `support=` to have others")
    return None, notes


def _sampled_sums(table: ParticleTable, mass: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a sample, and at each the sum of kernels times masses."""
    sample = _Sample(table, np.ones(len(table), bool))
    rows, (distance, neighbour) = sample.rows, sample.nearest(MOST_SUMMED)
    own = distance[:, NEIGHBOURS] if table.support is None else table.support[rows].astype(np.float64)
    reach = np.clip(own, distance[:, FEWEST_SUMMED], distance[:, -1])
    reach = np.maximum(reach, np.finfo(np.float32).tiny)  # of particles in one place
    return rows, gathered(kernels.by_name(KERNEL), distance, reach, mass[neighbour])


class _Sample:
    """A sample of particles, and the tree in which their neighbours are found: of large sets those around a few of them.

    It is made for few questions: cells are halved where they are, which is several times faster.
    """

    def __init__(self, table: ParticleTable, *masks: np.ndarray) -> None:
        self.points = in_period(table.position, table.box_size)
        self._region: np.ndarray | None = None
        if len(self.points) <= MAX_WHOLE:
            self.rows = np.unique(np.concatenate([_some(mask, ASKED) for mask in masks]))
        else:
            regions = [(mask, self._around(row, table.box_size)) for mask in masks for row in _some(mask, REGIONS)]
            near = [region[: ASKED // REGIONS] for _, region in regions]
            self.rows = np.unique(np.concatenate([few[mask[few]] for (mask, _), few in zip(regions, near, strict=True)]))
            self._region = np.unique(np.concatenate([region for _, region in regions]))
        within = self.points if self._region is None else self.points[self._region]
        self._tree = scipy.spatial.KDTree(within, 32, balanced_tree=False, compact_nodes=False, boxsize=table.box_size)

    def nearest(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """Distances of the sample to so many particles, themselves first, and which rows these are."""
        distance, neighbour = self._tree.query(self.points[self.rows], k=min(self._tree.n, number + 1), workers=-1)
        return distance, neighbour if self._region is None else self._region[neighbour]

    def _around(self, row: int, box: Sides | None) -> np.ndarray:
        """About `REGION` particles in a cube around one, nearest first; how wide it is to be is told by a share of them."""
        farthest = np.zeros(len(self.points))
        for axis in range(3):
            apart = np.abs(self.points[:, axis] - self.points[row, axis])
            np.maximum(farthest, apart if box is None else np.minimum(apart, box[axis] - apart), out=farthest)
        few = farthest[:: max(1, REGION // ASKED)]
        wanted = min(len(few) - 1, ASKED)
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
