"""Scenes from packaged simulations: a few frames of particles that carry a dye.

Flow: packaged npz -> [simulated] -> mixer, dam_break -> Scene.

The files in `data/` were computed for this project with SPlisHSPlasH (DFSPH); each holds `position` (frames, N, 3),
`concentration` (N,), `time` (frames,) in seconds, and `spacing` in metres: a particle's mass over the rest density is
`spacing ** 3`.
"""

from __future__ import annotations

import functools
import operator
from importlib import resources
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsph.model import Particles
from jaxsph.scenes.sampling import SUPPORT_IN_SPACINGS, refill


class Simulation(NamedTuple):
    """What a packaged file holds."""

    position: Float[np.ndarray, "frames particles 3"]
    concentration: Float[np.ndarray, " particles"]
    time: Float[np.ndarray, " frames"]
    spacing: float


@functools.cache
def simulation(name: str) -> Simulation:
    """The packaged simulation called `name`."""
    with (resources.files("jaxsph.scenes") / "data" / f"{name}.npz").open("rb") as file, np.load(file) as stored:
        return Simulation(stored["position"], stored["concentration"], stored["time"], float(stored["spacing"]))


def particles_of(name: str, frame: float, count: int | None, seed: int) -> Particles:
    """Particles of one frame: the simulated ones, or `count` that fill the same fluid.

    Raises:
        ValueError: `frame` is not one of the simulation's.
    """
    stored = simulation(name)
    try:
        index = operator.index(int(frame)) if float(frame).is_integer() else -1
    except (TypeError, ValueError, OverflowError):
        index = -1
    if not 0 <= index < len(stored.position):
        raise ValueError(f"`frame` of scene {name!r} must be one of {list(range(len(stored.position)))}, got {frame!r}")
    position, concentration, spacing = stored.position[index], stored.concentration, stored.spacing
    if count is not None and count != len(position):
        position, concentration, spacing = refill(position, concentration, spacing, count, seed)
    return Particles.from_arrays(
        position.astype(np.float32), SUPPORT_IN_SPACINGS * spacing, concentration.astype(np.float32), spacing**3
    )
