"""`mixer` and `dam_break`, from packaged simulations: a few frames of particles that carry a dye.

In `mixer` a paddle stirs a tank in which dye stands in cubes, as in Hochstetter et al. 2016, figure 9. In `dam_break` two columns
of water collapse into a basin: thin sheets, spray, and much empty space.

Flow: packaged npz -> [simulated] -> Scene.

The files in `data/` were computed for this project with SPlisHSPlasH (DFSPH); each holds `position` (frames, N, 3),
`concentration` (N,), `time` (frames,) in seconds, and `spacing` in metres: a particle's mass over the rest density is
`spacing ** 3`.
"""

from __future__ import annotations

import functools
from importlib import resources

import numpy as np

from jaxsph.model import Camera, Particles, Scene, TransferFunction
from jaxsph.scenes.sampling import fluid_of, pictured, refill

TANK = ((-0.6, 0.0, -0.6), (0.6, 0.9, 0.6))  # where the fluid stands at rest, metres; what splashes above it may leave the image
BASIN = ((-1.55, 0.0, -1.55), (1.55, 0.9, 1.55))  # where nearly all of the water stays, metres


@functools.cache
def simulation(name: str) -> dict[str, np.ndarray]:
    """What the packaged file called `name` holds."""
    with (resources.files("jaxsph.scenes") / "data" / f"{name}.npz").open("rb") as file, np.load(file) as stored:
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
