r"""Support radii from nearest neighbours, and kernel sums for volumes and densities, on the host.

Flow: ParticleTable -> [supports] -> Particles.

Many files hold points and nothing more. Where they lie about evenly, as those of liquids do, one support of two spacings is
theirs, so that what splashes off is as small as the rest; where they cluster, a support that reaches a fixed number of
neighbours. With the volume $V_i = 1 / \sum_j W(|x_i - x_j|, H_i)$ either turns such a set into an SPH field.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float

from jaxsph.io.damage import DataError
from jaxsph.model.particles import kernels

Sides = tuple[float, float, float]
NEIGHBOURS = 32  # neighbours a support reaches when a file says nothing: about what SPH codes use in three dimensions
SPACINGS = 2.0  # of particles that lie evenly: support over spacing, as codes for liquids have it
EVEN, FEW = 1.45, 9
"""Ratio of the upper to the lower quartile of distances to the eighth neighbour up to which particles lie evenly, and how many
there must be to tell; liquids have 1.0 to 1.35, gas that has begun to cluster 1.55."""
EIGHTH = 2**0.5  # distance to the eighth neighbour on a cubic lattice, over its spacing
SAMPLED = 1 << 14  # particles whose neighbours tell how evenly all lie
PAIR_BUDGET = 2**22  # pairs looked at in one go: about 100 MB of distances, indices and weights
MAX_PAIRS, SAMPLED_PARTICLES = 2**36, 256
"""Pairs of a kernel sum from which it is refused: hours of work, where a support was given in another unit; who tells."""
SHOW_PROGRESS_FROM = 100_000
"""Particles from which a search lasts long enough (about a second) to show a progress bar on a terminal."""


def even_spacing(position: Float[np.ndarray, "particles 3"], *, box: Sides | None = None) -> float | None:
    """Spacing of particles that lie about evenly, also across the faces of a `box`; None where they cluster, or are too few."""
    places = in_period(position, box)
    if len(places) < FEW:
        return None
    some = places[:: max(1, len(places) // SAMPLED)]
    eighth = scipy.spatial.KDTree(places, boxsize=box).query(some, k=FEW, workers=-1)[0][:, -1]
    low, middle, high = np.percentile(eighth, (25, 50, 75))
    return float(middle / EIGHTH) if 0 < high <= EVEN * low else None


def nearest_neighbour_supports(
    position: Float[np.ndarray, "particles 3"],
    neighbours: int = NEIGHBOURS,
    *,
    box: Sides | None = None,
    progress: bool = False,
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
    """
    if neighbours < 1:
        raise ValueError(f"`neighbours` must be at least 1, got {neighbours}; 32 is a good choice")
    position = in_period(position, box)
    count = len(position)
    if count == 0:
        return np.zeros(0)
    places, place_of = _distinct(position)
    if len(places) == 1:
        return np.ones(count)
    points, multiplicity = position[places], np.bincount(place_of)
    tree = scipy.spatial.KDTree(points, boxsize=box)
    reach, nearest = min(neighbours, count - 1), min(neighbours + 1, len(places))
    support = np.empty(len(places))
    for rows in _slices(np.full(len(places), nearest), progress, "supports"):
        distance, place = tree.query(points[rows], k=nearest, workers=-1)
        others = np.cumsum(multiplicity[place], axis=1) - 1  # all there are within that distance but the particle itself
        found = distance[np.arange(len(distance)), (others >= reach).argmax(axis=1)]
        among_particles = found * (neighbours / reach) ** (1 / 3)
        among_places = distance[:, -1] * (neighbours / (nearest - 1)) ** (1 / 3)
        support[rows] = np.where(found > 0, among_particles, among_places)
    return support[place_of]


def kernel_sum(
    position: Float[np.ndarray, "particles 3"],
    support: Float[np.ndarray, " particles"] | float,
    weight: Float[np.ndarray, " particles"] | None = None,
    *,
    kernel: str = "poly6",
    box: Sides | None = None,
    progress: bool = False,
) -> Float[np.ndarray, " particles"]:
    r"""The gather sum $\sum_j w_j W(|x_i - x_j|, H_i)$ at every particle, itself included.

    With masses as weights this is the SPH density, as codes with varying supports define and store it (each particle
    uses its own $H_i$); without weights it is the number density, whose inverse is a volume.

    Args:
        position: (N, 3); distances are computed in float64.
        support: (N,) support radii $H > 0$, or one of all, same unit as `position`.
        weight: (N,) weights $w$; `None` means 1.
        kernel: name of a kernel of `jaxsph.model.particles.kernels`.
        box, progress: as for `nearest_neighbour_supports`; sums go to the nearest image of each particle.

    Returns:
        (N,) float64 sums, positive where weights are, in units of `weight` over a volume.

    Raises:
        ValueError: supports that reach so many particles that the sum would take hours.
    """
    chosen = kernels.by_name(kernel)
    position = in_period(position, box)
    support = np.broadcast_to(np.asarray(support, dtype=np.float64), len(position))
    if len(position) == 0:
        return np.zeros(0)
    places, place_of = _distinct(position)
    askers, asker_of = _distinct(np.column_stack([position, support]))
    weights = np.append(np.bincount(place_of, None if weight is None else np.asarray(weight, np.float64)), 0.0)
    tree, points, radii = scipy.spatial.KDTree(position[places], boxsize=box), position[askers], support[askers]
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


def _distinct(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The index of one of each group of equal rows, and for every row the number of its group.

    A tree cannot part points that coincide, and would compare each with all others. Rows that all differ keep their order.
    """
    order = np.lexsort(rows.T)
    ordered = rows[order]
    is_first = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    if is_first.all():
        every = np.arange(len(rows))
        return every, every
    group = np.empty(len(rows), np.int64)
    group[order] = np.cumsum(is_first) - 1
    return order[is_first], group


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
