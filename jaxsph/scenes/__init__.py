"""Built-in scenes: particles, transfer function and camera by name.

Flow: [scenes] -> Scene, Camera -> render -> image.

| name | what | particles | frames |
|---|---|---|---|
| `mixer` | a paddle stirs a dyed tank; an SPH simulation, packaged | 43,740 simulated | 0, 1, 2 |
| `dam_break` | two dyed columns collapse into a basin; an SPH simulation, packaged | 59,582 simulated | 0, 1, 2 |
| `checker_board` | cubes of increasing concentration that diffuse; analytic | 100,000 | any >= 0 |
| `radial` | a radial concentration under narrow bands of colour; analytic | 100,000 | static: any |
| `letters` | letters of dyed fluid fall into a basin; analytic ballistic motion | 100,000 | any >= 0 |
| `flubber` | two fluids orbit a centre and wind into sheets; analytic | 100,000 | any >= 0 |

Any other number of particles may be asked for: analytic scenes are sampled anew, simulated ones are filled again with
particles of another size (`sampling.refill`). The same arguments give the same particles on every machine.
"""

from __future__ import annotations

from jaxsph.model.camera.camera import Camera
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction, fitted
from jaxsph.model.transfer.looks import default_transfer, opacity_by_second
from jaxsph.model.transfer.maps import colormap
from jaxsph.numerics.names import did_you_mean
from jaxsph.scenes.analytic import checker_board, flubber, letters, radial
from jaxsph.scenes.sampling import dam_break, mixer

__all__ = [
    "checker_board",
    "colormap",
    "dam_break",
    "default_transfer",
    "fitted",
    "flubber",
    "letters",
    "load",
    "mixer",
    "names",
    "opacity_by_second",
    "preset",
    "radial",
]

preset = TransferFunction.preset
SCENES = {made.__name__: made for made in (mixer, radial, checker_board, dam_break, letters, flubber)}


def names() -> tuple[str, ...]:
    """The names that `load` knows."""
    return tuple(SCENES)


def load(
    name: str, particles: int | None = None, frame: float | None = None, *, width: int = 512, height: int = 512, seed: int = 0
) -> tuple[Scene, Camera]:
    """Make a built-in scene and a camera that looks at it.

    Args:
        name: one of `names()`.
        particles: how many, at least 1; `None` is the scene's own number.
        frame: moment of the scene; `None` is the one that shows it best. All frames share the eye, and their near
            and far are snug.
        width, height: size of the camera's image in pixels.
        seed: another arrangement of the particles; without effect where simulated particles are used as they are.

    Raises:
        ValueError: an unknown name, fewer than one particle, a frame that the scene does not have.
    """
    if name not in SCENES:
        raise ValueError(f"`name` must be one of {', '.join(names())}, got {name!r}{did_you_mean(name, names())}")
    if particles is not None and (isinstance(particles, bool) or int(particles) != particles or particles < 1):
        raise ValueError(f"`particles` must be an integer of at least 1, got {particles!r}")
    return SCENES[name](particles=particles, frame=frame, width=width, height=height, seed=seed)
