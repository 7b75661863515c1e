"""jaxsph: volume rendering of SPH particles, in JAX."""

from jaxsph import io, reference, scenes
from jaxsph.access.morton import prepare
from jaxsph.model import Camera, Image, Particles, Scene, Settings, TransferFunction
from jaxsph.plan import Plan
from jaxsph.planning import plan
from jaxsph.render import CapacityError, render
from jaxsph.sweep import sweep
from jaxsph.version import __version__

__all__ = [
    "Camera",
    "CapacityError",
    "Image",
    "Particles",
    "Plan",
    "Scene",
    "Settings",
    "TransferFunction",
    "__version__",
    "io",
    "plan",
    "prepare",
    "reference",
    "render",
    "scenes",
    "sweep",
]
