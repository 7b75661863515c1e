"""`mixer`: a paddle stirs a tank in which dye stands in cubes, as in Hochstetter et al. 2016, figure 9."""

from __future__ import annotations

from jaxsph.model import Camera, Scene, TransferFunction
from jaxsph.scenes.simulated import particles_of
from jaxsph.scenes.view import looking_at_box

TANK = ((-0.6, 0.0, -0.6), (0.6, 0.9, 0.6))
"""Where the fluid stands at rest, metres; what splashes above it may leave the image."""


def mixer(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """A simulated tank 1.2 m wide; the quantity is the concentration of the dye, in [0, 1].

    Frames 0, 1 and 2 are 0.0, 0.2 and 0.4 seconds after the paddle starts; `None` is frame 1. `particles=None` are
    the 43,740 simulated particles; any other number fills the same fluid.
    """
    fluid = particles_of("mixer", 1 if frame is None else frame, particles, seed)
    transfer = TransferFunction.from_points(
        values=[0.0, 0.2, 0.45, 0.7, 1.0],
        colors=[(0.20, 0.45, 0.85), (0.15, 0.50, 0.85), (0.10, 0.80, 0.60), (0.75, 0.95, 0.30), (1.0, 0.62, 0.15)],
        extinction=[0.9, 0.9, 2.0, 3.5, 5.0],
    )
    camera = looking_at_box(*TANK, (-0.45, -0.42, -1.0), fluid, width, height)
    return Scene(particles=fluid, transfer=transfer), camera
