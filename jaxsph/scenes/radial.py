"""`radial`: a smooth concentration under a transfer function that is anything but, as in Hochstetter et al. 2016, figure 3."""

from __future__ import annotations

import colorsys

import numpy as np

from jaxsph.model import Camera, Scene, TransferFunction
from jaxsph.scenes.sampling import fluid_of, looking_at_box, scatter

PARTICLES = 100_000
CENTRE = (1.0, 1.0, 1.0)  # where the concentration is 0: the upper right corner that the camera sees in front
BANDS = 16  # narrow bands of the transfer function, evenly spaced over the concentration


def radial(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    r"""A unit cube of fluid with the quantity $|x - c| / \sqrt{3}$, $c$ a corner: from 0 there to 1 at the far corner.

    It does not move: `frame` is accepted and changes nothing.
    """
    count = PARTICLES if particles is None else particles
    position = scatter(np.zeros(3), np.ones(3), count, seed)
    concentration = np.linalg.norm(position - CENTRE, axis=1) / np.sqrt(3)
    spacing = (1.0 / count) ** (1 / 3)
    fluid = fluid_of(position, concentration, spacing)
    camera = looking_at_box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (-0.55, -0.45, -1.0), fluid, width, height)
    return Scene(particles=fluid, transfer=narrow_bands()), camera


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
