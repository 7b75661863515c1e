"""`dam_break`: two columns of water collapse into a basin: thin sheets, spray, and much empty space."""

from __future__ import annotations

from jaxsph.model import Camera, Scene, TransferFunction
from jaxsph.scenes.simulated import particles_of
from jaxsph.scenes.view import looking_at_box

BASIN = ((-1.55, 0.0, -1.55), (1.55, 0.9, 1.55))
"""Where nearly all of the water stays, metres."""


def dam_break(
    particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """A simulated basin 3.1 m wide; the quantity is the concentration of a dye that stood in cubes, in [0, 1].

    Frames 0, 1 and 2 are 0.0, 0.3 and 0.6 seconds after the columns are let go; `None` is frame 1. `particles=None`
    are the 59,582 simulated particles; any other number fills the same fluid.
    """
    water = particles_of("dam_break", 1 if frame is None else frame, particles, seed)
    transfer = TransferFunction.from_points(
        values=[0.0, 0.35, 0.65, 1.0],
        colors=[(0.15, 0.45, 0.80), (0.30, 0.65, 0.85), (0.95, 0.60, 0.35), (0.95, 0.35, 0.20)],
        extinction=[1.5, 2.0, 4.0, 5.0],
    )
    camera = looking_at_box(*BASIN, (-0.35, -0.55, -1.0), water, width, height)
    return Scene(particles=water, transfer=transfer), camera
