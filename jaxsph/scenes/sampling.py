r"""Spread particles evenly: in a box, or through the fluid that other particles fill; look at what they make; and `mixer` and
`dam_break`, of packaged simulations: a few frames of particles that carry a dye.

Flow: packaged npz, formulas -> [sampling] -> Scene, Camera: one eye for all frames, and depths that are snug for the frame.

A particle stands for the volume $s^3$ of its spacing $s$, and its support radius is $2 s$, which holds about
$\frac{4}{3} \pi 2^3 \approx 33$ particles: what SPH codes use in three dimensions.

In `mixer` a paddle stirs a tank in which dye stands in cubes, as in Hochstetter et al. 2016, figure 9. In `dam_break` two columns
of water collapse into a basin: thin sheets, spray, and much empty space. The files in `data/` were computed for this project with
SPlisHSPlasH (DFSPH); each holds `position` (frames, N, 3), `concentration` (N,), `time` (frames,) in seconds, and `spacing` in
metres: a particle's mass over the rest density is `spacing ** 3`.
"""

from __future__ import annotations

import functools
from importlib import resources
from typing import Any

import numpy as np
import scipy
from jaxtyping import Float, Shaped

from jaxsph.model.camera.camera import Camera, axes_along
from jaxsph.model.camera.directions import UP, corners_of
from jaxsph.model.camera.framing import snug
from jaxsph.model.particles.particles import Particles
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction

SUPPORT_IN_SPACINGS = 2.0  # support radius over particle spacing
PLASTIC = 1.2207440846057596  # root of x^4 = x + 1: its powers step evenly through a cube (Roberts' R3 sequence)
JITTER = 0.2  # largest random step from the even place, in spacings: enough to hide the pattern, too little to clump
FOV_DEGREES = 35.0
BORDER = 0.06  # part of the image that stays empty around a scene
MIXED = 8  # simulated neighbours that a new particle takes its quantity from: those around one lattice cube
TANK = ((-0.6, 0.0, -0.6), (0.6, 0.9, 0.6))  # where the fluid stands at rest, metres; what splashes above it may leave the image
BASIN = ((-1.55, 0.0, -1.55), (1.55, 0.9, 1.55))  # where nearly all of the water stays, metres


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

    Of evenly spread points those `count` are kept that lie nearest to a simulated particle; their spacing is chosen so that the
    fluid keeps its volume. Their quantity is the mean of the nearest simulated particles' by inverse square distance.

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


def pictured(
    particles: Particles,
    transfer: TransferFunction,
    box: tuple[Any, Any],
    direction: tuple[float, float, float],
    width: int,
    height: int,
) -> tuple[Scene, Camera]:
    r"""A fluid, and a camera along `direction` whose image a box fills but for a border, with depths snug to the particles.

    With $k$ the tangent of half the opening, an eye at lateral place $e$ and distance $D$ sees a corner when
    $|x - e| \le k (z + D)$. The nearest such eye has $e = (a + b) / 2$ and $D = (a - b) / 2k$, where
    $a = \max(x - k z)$ and $b = \min(x + k z)$ over the corners; likewise for $y$.
    """
    forward = np.asarray(direction) / np.linalg.norm(direction)
    axes = axes_along(forward, UP)
    corners = corners_of(*box) @ axes.T
    tangent = np.tan(np.radians(FOV_DEGREES) / 2) * (1 - BORDER) * np.array([width / height, 1.0])
    ahead = corners[:, 2:] * tangent
    most, least = (corners[:, :2] - ahead).max(0), (corners[:, :2] + ahead).min(0)
    eye = np.append((most + least) / 2, -((most - least) / (2 * tangent)).max()) @ axes
    camera = Camera.look_at(eye, eye + forward, UP, FOV_DEGREES, width, height, near=1.0, far=2.0)
    return Scene(particles=particles, transfer=transfer), snug(camera, particles)


@functools.cache
def simulation(name: str) -> dict[str, np.ndarray]:
    """What the packaged file called `name` holds."""
    with (resources.files(__package__) / "data" / f"{name}.npz").open("rb") as file, np.load(file) as stored:
        return dict(stored)


def particles_of(name: str, frame: float | None, count: int | None, seed: int) -> Particles:
    """Particles of one frame, by default the second: the simulated ones, or `count` that fill the same fluid.

    Raises:
        ValueError: `frame` is not one of the simulation's.
    """
    stored = simulation(name)
    frame, frames = 1 if frame is None else frame, range(len(stored["position"]))
    if frame not in frames:
        raise ValueError(f"`frame` of scene {name!r} must be one of {list(frames)}, got {frame!r}")
    position, concentration, spacing = stored["position"][int(frame)], stored["concentration"], float(stored["spacing"])
    if count is not None and count != len(position):
        position, concentration, spacing = refill(position, concentration, spacing, count, seed)
    return fluid_of(position, concentration, spacing)


def mixer(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """A simulated tank 1.2 m wide; the quantity is the concentration of the dye, in [0, 1].

    Frames 0, 1 and 2 are 0.0, 0.2 and 0.4 seconds after the paddle starts; `None` is frame 1. `particles=None` are
    the 43,740 simulated particles; any other number fills the same fluid.
    """
    fluid = particles_of("mixer", frame, particles, seed)
    transfer = TransferFunction.from_points(
        values=[0.0, 0.2, 0.45, 0.7, 1.0],
        colors=[(0.20, 0.45, 0.85), (0.15, 0.50, 0.85), (0.10, 0.80, 0.60), (0.75, 0.95, 0.30), (1.0, 0.62, 0.15)],
        extinction=[0.9, 0.9, 2.0, 3.5, 5.0],
    )
    return pictured(fluid, transfer, TANK, (-0.45, -0.42, -1.0), width, height)


def dam_break(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """A simulated basin 3.1 m wide; the quantity is the concentration of a dye that stood in cubes, in [0, 1].

    Frames 0, 1 and 2 are 0.0, 0.3 and 0.6 seconds after the columns are let go; `None` is frame 1. `particles=None`
    are the 59,582 simulated particles; any other number fills the same fluid.
    """
    water = particles_of("dam_break", frame, particles, seed)
    transfer = TransferFunction.from_points(
        values=[0.0, 0.35, 0.65, 1.0],
        colors=[(0.15, 0.45, 0.80), (0.30, 0.65, 0.85), (0.95, 0.60, 0.35), (0.95, 0.35, 0.20)],
        extinction=[1.5, 2.0, 4.0, 5.0],
    )
    return pictured(water, transfer, BASIN, (-0.35, -0.55, -1.0), width, height)
