r"""Spread particles evenly: in a box, or through the fluid that other particles fill.

Flow: [sampling] -> scenes -> Scene.

A particle stands for the volume $s^3$ of its spacing $s$, and its support radius is $2 s$, which holds about
$\frac{4}{3} \pi 2^3 \approx 33$ particles: what SPH codes use in three dimensions.
"""

from __future__ import annotations

import numpy as np
import scipy
from jaxtyping import Float, Shaped

from jaxsph.model import Particles

SUPPORT_IN_SPACINGS = 2.0  # support radius over particle spacing
PLASTIC = 1.2207440846057596  # root of x^4 = x + 1: its powers step evenly through a cube (Roberts' R3 sequence)
JITTER = 0.2  # largest random step from the even place, in spacings: enough to hide the pattern, too little to clump
MIXED = 8  # simulated neighbours that a new particle takes its quantity from: those around one lattice cube


def fluid_of(position: Float[np.ndarray, "count 3"], quantity: Float[np.ndarray, " count"], spacing: float) -> Particles:
    """Particles in float32 that stand for their share of a fluid."""
    return Particles.from_arrays(
        position.astype(np.float32), SUPPORT_IN_SPACINGS * spacing, quantity.astype(np.float32), spacing**3
    )


def moment_of(name: str, frame: float | None, best: float, last: float = np.inf) -> float:
    """The frame of a scene that is asked for, `best` where none is.

    Raises:
        ValueError: one below 0, beyond the last or not finite.
    """
    moment = best if frame is None else float(frame)
    if not (np.isfinite(moment) and 0 <= moment <= last):
        most = "finite" if np.isinf(last) else f"at most {last:,}"
        raise ValueError(f"`frame` of scene {name!r} must be >= 0 and {most}, got {frame!r}")
    return moment


def scatter(
    lower: Shaped[np.ndarray, "3"], upper: Shaped[np.ndarray, "3"], count: int, seed: int = 0
) -> Float[np.ndarray, "count 3"]:
    """Exactly `count` points, evenly spread through a box and a little jittered, all inside it.

    The places are a shifted R3 sequence: no two are closer than about half a spacing, no hole is wider than one, and
    unlike a lattice it has every count.
    """
    lower, upper = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    size = upper - lower
    generator = np.random.default_rng(seed)
    step = PLASTIC ** -np.arange(1.0, 4.0)
    place = (generator.random(3) + np.arange(count)[:, None] * step) % 1.0
    spacing = (size.prod() / max(count, 1)) ** (1 / 3)
    moved = lower + place * size + generator.uniform(-JITTER, JITTER, (count, 3)) * spacing
    return np.clip(moved, lower, upper)


def refill(
    position: Float[np.ndarray, "particles 3"],
    quantity: Float[np.ndarray, " particles"],
    spacing: float,
    count: int,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "count 3"], Float[np.ndarray, " count"], float]:
    """Fill the fluid of simulated particles with `count` particles of another size.

    Of evenly spread points those `count` are kept that lie nearest to a simulated particle; their spacing is chosen so
    that the fluid keeps its volume. Their quantity is the mean of the nearest simulated particles' by inverse square
    distance.

    Returns:
        Positions, quantities, and the new spacing.
    """
    spacing_new = spacing * (len(position) / count) ** (1 / 3)
    candidates = _around(position, spacing, spacing_new, count, seed)
    tree = scipy.spatial.cKDTree(position)
    nearest, _ = tree.query(candidates, workers=-1)
    kept = candidates[np.sort(np.argsort(nearest, kind="stable")[:count])]
    distance, neighbour = tree.query(kept, k=np.arange(1, min(MIXED, len(position)) + 1), workers=-1)
    weight = 1 / (distance**2 + (0.1 * spacing) ** 2)  # the second term: at a simulated particle its own value, not NaN
    mixed = (weight * quantity[neighbour]).sum(1) / weight.sum(1)
    return kept, mixed, spacing_new


def _around(position: np.ndarray, spacing: float, spacing_new: float, count: int, seed: int) -> np.ndarray:
    """Evenly spread points at least `count` many, in the cells (and their neighbours) that hold simulated particles."""
    cell = max(spacing, spacing_new)
    lower = position.min(0) - 1.5 * cell
    shape = np.ceil((position.max(0) + 1.5 * cell - lower) / cell).astype(int)
    occupied = np.zeros(shape, bool)
    occupied[tuple(((position - lower) / cell).astype(int).T)] = True
    occupied = scipy.ndimage.binary_dilation(occupied, np.ones((3, 3, 3), bool))
    upper = lower + shape * cell
    points = scatter(lower, upper, round((upper - lower).prod() / spacing_new**3), seed)
    index = np.minimum(((points - lower) / cell).astype(int), shape - 1)
    points = points[occupied[tuple(index.T)]]
    assert len(points) >= count  # the dilated cells hold the fluid with room to spare
    return points
