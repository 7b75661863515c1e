"""`checker_board`: cubes of increasing concentration that diffuse, as in Hochstetter et al. 2016, figure 8."""

from __future__ import annotations

import numpy as np
import scipy
from jaxtyping import Float

from jaxsph.model import Camera, Scene, TransferFunction
from jaxsph.scenes.sampling import fluid_of, looking_at_box, moment_of, scatter

PARTICLES = 100_000
CUBES = 5  # cubes along each axis
FRONT = 0.01  # width of the front between cubes in frame 0, over the edge of the board
SPREAD = 0.0004  # what a frame adds to the square of that width


def checker_board(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """A unit cube of fluid; of its 5 x 5 x 5 cubes every second is dyed, more to the right and to the back.

    Frame 0 has sharp fronts, later ones diffuse (any number >= 0, fractions too); `None` is frame 2.
    """
    moment = moment_of("checker_board", frame, 2.0)
    count = PARTICLES if particles is None else particles
    position = scatter(np.zeros(3), np.ones(3), count, seed)
    spacing = (1.0 / count) ** (1 / 3)
    fluid = fluid_of(position, concentration(position, moment), spacing)
    transfer = TransferFunction.from_points(
        values=[0.0, 0.1, 0.3, 0.5, 0.75, 1.0],
        colors=[(0.2, 0.3, 0.5), (0.35, 0.35, 0.95), (0.15, 0.7, 0.75), (0.35, 0.85, 0.3), (1.0, 0.8, 0.2), (1.0, 0.3, 0.15)],
        extinction=[0.15, 3.0, 5.0, 6.0, 7.0, 8.0],
    )
    camera = looking_at_box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (-0.55, -0.45, -1.0), fluid, width, height)
    return Scene(particles=fluid, transfer=transfer), camera


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
