"""jaxsph: volume rendering of SPH particles, in JAX."""

__version__ = "0.1.0"

from jaxsph import io, reference, scenes
from jaxsph.model import Camera, Image, Particles, Scene, Settings, TransferFunction
from jaxsph.plan import Plan, plan
from jaxsph.render import CapacityError, render
from jaxsph.sweep import sweep

__all__ = [
    "Camera",
    "CapacityError",
    "Image",
    "Particles",
    "Plan",
    "Scene",
    "Settings",
    "TransferFunction",
    "io",
    "plan",
    "reference",
    "render",
    "scenes",
    "sweep",
]
