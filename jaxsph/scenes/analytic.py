r"""Analytic scenes: `checker_board` and `radial`, of a unit cube of fluid, and `flubber`, of two balls; each is a formula.

`checker_board` has cubes of increasing concentration that diffuse, as in Hochstetter et al. 2016, figure 8. `radial` is a smooth
concentration under a transfer function that is anything but, as in figure 3. In `flubber` two fluids wind around each other while
they orbit a centre, after figure 10.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable

import numpy as np
import scipy
from jaxtyping import Float

from jaxsph.model import Camera, Particles, Scene, TransferFunction
from jaxsph.scenes.sampling import fluid_of, moment_of, pictured, scatter

PARTICLES = 100_000
CUBE = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
OBLIQUELY = (-0.55, -0.45, -1.0)  # where one looks at a cube
CUBES = 5  # cubes along each axis of the board
FRONT = 0.01  # width of the front between cubes in frame 0, over the edge of the board
SPREAD = 0.0004  # what a frame adds to the square of that width
CENTRE = (1.0, 1.0, 1.0)  # where the radial concentration is 0: the upper right corner that the camera sees in front
BANDS = 16  # narrow bands of its transfer function, evenly spaced over the concentration
BALL = 0.5  # radius of each fluid's ball in frame 0; the two touch at the centre
TILT = np.radians(40.0)  # between the axes of the two rotations, which makes sheets of what would be a flat spiral
RATES = (0.9, 0.5)  # of the two rotations at the centre, radians a frame
CORE = 0.35
"""Distance from the centre within which the fluid turns nearly as one; without it the centre would turn infinitely fast."""


def _cube(quantity: Callable[[np.ndarray], np.ndarray], particles: int | None, seed: int) -> Particles:
    """Fluid in a unit cube, of a quantity that depends on the place."""
    count = PARTICLES if particles is None else particles
    position = scatter(np.zeros(3), np.ones(3), count, seed)
    return fluid_of(position, quantity(position), (1.0 / count) ** (1 / 3))


def checker_board(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """A unit cube of fluid; of its 5 x 5 x 5 cubes every second is dyed, more to the right and to the back.

    Frame 0 has sharp fronts, later ones diffuse (any number >= 0, fractions too); `None` is frame 2.
    """
    moment = moment_of("checker_board", frame, 2.0)
    fluid = _cube(lambda position: concentration(position, moment), particles, seed)
    transfer = TransferFunction.from_points(
        values=[0.0, 0.1, 0.3, 0.5, 0.75, 1.0],
        colors=[(0.2, 0.3, 0.5), (0.35, 0.35, 0.95), (0.15, 0.7, 0.75), (0.35, 0.85, 0.3), (1.0, 0.8, 0.2), (1.0, 0.3, 0.15)],
        extinction=[0.15, 3.0, 5.0, 6.0, 7.0, 8.0],
    )
    return pictured(fluid, transfer, CUBE, OBLIQUELY, width, height)


def concentration(position: Float[np.ndarray, "particles 3"], frame: float) -> Float[np.ndarray, " particles"]:
    r"""Concentration in [0, 1] at points of the unit cube.

    The exact solution of the diffusion equation without flux through the cube's faces. A dyed interval $[a, b]$ of an
    axis becomes $\frac{1}{2} [\mathrm{erf}((x - a)/w) - \mathrm{erf}((x - b)/w)]$ plus its mirror images, and cubes are
    products of intervals; $w^2 = `FRONT`^2 + `SPREAD` \cdot frame$.
    """
    width = np.sqrt(FRONT**2 + SPREAD * frame)
    edges = np.arange(CUBES + 1) / CUBES
    shares = []
    for x in position.T:
        mirrored = [x, -x, 2.0 - x, x + 2.0, x - 2.0]
        steps = np.sum([[scipy.special.erf((image - edge) / width) for edge in edges] for image in mirrored], axis=0)
        shares.append(0.5 * (steps[:-1] - steps[1:]))
    column, row, depth = np.indices((CUBES,) * 3)
    increasing = 0.1 + 0.9 * (column + (CUBES - 1 - depth)) / (2 * (CUBES - 1))  # the camera stands on the +z side
    dyed = np.where((column + row + depth) % 2 == 0, increasing, 0.0)
    total = np.zeros(len(position))
    for i, share in enumerate(shares[0]):
        for j, other in enumerate(shares[1]):
            total += share * other * (dyed[i, j] @ np.asarray(shares[2]))
    return np.clip(total, 0.0, 1.0)


def radial(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    r"""A unit cube of fluid with the quantity $|x - c| / \sqrt{3}$, $c$ a corner: from 0 there to 1 at the far corner.

    It does not move: `frame` is accepted and changes nothing.
    """
    fluid = _cube(lambda position: np.linalg.norm(position - CENTRE, axis=1) / np.sqrt(3), particles, seed)
    return pictured(fluid, narrow_bands(), CUBE, OBLIQUELY, width, height)


def narrow_bands() -> TransferFunction:
    """Thin shells of strong colour, a fifth of a band wide, in a faint haze."""
    values, colors, extinction = [0.0], [(0.35, 0.4, 0.5)], [0.15]
    for band in range(BANDS):
        middle, half = (band + 0.5) / BANDS, 0.1 / BANDS
        color = colorsys.hsv_to_rgb((0.62 * band) % 1.0, 0.75, 1.0)
        edge = 0.5 * half
        values += [middle - half - edge, middle - half, middle + half, middle + half + edge]
        colors += [(0.35, 0.4, 0.5), color, color, (0.35, 0.4, 0.5)]
        extinction += [0.15, 20.0, 20.0, 0.15]
    return TransferFunction.from_points([*values, 1.0], [*colors, (0.35, 0.4, 0.5)], [*extinction, 0.15])


def flubber(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """Two balls of fluid, quantity 0 and 1, that orbit the point where they touch and are wound into sheets.

    It is a formula, not a simulation (`orbited`): frames are any number >= 0, fractions too; `None` is frame 8.
    """
    moment = moment_of("flubber", frame, 8.0)
    count = PARTICLES if particles is None else particles
    halves = [ball(part, seed + number) for number, part in enumerate((count // 2, count - count // 2))]
    place = np.concatenate([half + (side * BALL, 0.0, 0.0) for side, half in zip((-1, 1), halves, strict=True)])
    quantity = np.repeat([0.0, 1.0], [len(half) for half in halves])
    spacing = (2 * 4 / 3 * np.pi * BALL**3 / count) ** (1 / 3)
    fluid = fluid_of(orbited(place, moment), quantity, spacing)
    transfer = TransferFunction.from_points(
        values=[0.0, 0.35, 0.5, 0.65, 1.0],
        colors=[(0.95, 0.45, 0.15), (0.95, 0.60, 0.25), (0.95, 0.95, 0.85), (0.30, 0.75, 0.70), (0.10, 0.50, 0.75)],
        extinction=[2.5, 2.5, 8.0, 2.5, 2.5],
    )
    reach = 1.6 * BALL
    return pictured(fluid, transfer, ((-reach,) * 3, (reach,) * 3), (-0.35, -0.75, -1.0), width, height)


def ball(count: int, seed: int) -> Float[np.ndarray, "count 3"]:
    """`count` points, evenly spread through a ball of radius `BALL` around the origin."""
    box = scatter(np.full(3, -BALL), np.full(3, BALL), round(count * 6 / np.pi), seed)
    return box[np.sort(np.argsort((box**2).sum(1), kind="stable")[:count])]


def orbited(position: Float[np.ndarray, "particles 3"], frame: float) -> Float[np.ndarray, "particles 3"]:
    r"""Where particles are after `frame` frames.

    Every sphere around the centre turns rigidly, by the angle $\omega\, t\, (1 + r^2 / c^2)^{-3/4}$ around one axis and
    then around another: far out as $r^{-3/2}$, the rate of Kepler's orbits. Rotations that depend on the radius alone
    keep volume, so the fluid stays as dense as it was.
    """
    radius = np.linalg.norm(position, axis=1)
    slower = frame * (1 + (radius / CORE) ** 2) ** -0.75
    axes = ((0.0, 1.0, 0.0), (np.sin(TILT), np.cos(TILT), 0.0))
    for axis, rate in zip(axes, RATES, strict=True):
        position = _turned(position, np.asarray(axis), rate * slower)
    return position


def _turned(position: np.ndarray, axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rodrigues' rotation of every point by its own angle."""
    along = (position @ axis)[:, None] * axis
    sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
    return along + (position - along) * cosine + np.cross(axis, position) * sine
