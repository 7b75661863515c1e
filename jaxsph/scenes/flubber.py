"""`flubber`: two fluids wind around each other while they orbit a centre, after Hochstetter et al. 2016, figure 10; analytic."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from jaxsph.model import Camera, Scene, TransferFunction
from jaxsph.scenes.sampling import fluid_of, looking_at_box, moment_of, scatter

PARTICLES = 100_000
BALL = 0.5  # radius of each fluid's ball in frame 0; the two touch at the centre
TILT = np.radians(40.0)  # between the axes of the two rotations, which makes sheets of what would be a flat spiral
RATES = (0.9, 0.5)  # of the two rotations at the centre, radians a frame

CORE = 0.35
"""Distance from the centre within which the fluid turns nearly as one; without it the centre would turn infinitely fast."""


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
    camera = looking_at_box((-reach,) * 3, (reach,) * 3, (-0.35, -0.75, -1.0), fluid, width, height)
    return Scene(particles=fluid, transfer=transfer), camera


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
