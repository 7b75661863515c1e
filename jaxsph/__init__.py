"""jaxsph: volume rendering of SPH particles, in JAX."""

from jaxsph import io, reference, scenes
from jaxsph.access.morton import prepare
from jaxsph.coarse import Coarsened, coarse_bound, coarsened
from jaxsph.field.in_octree import in_octree, octree_plans
from jaxsph.field.iso_surface import IsoSurface
from jaxsph.field.within import Within
from jaxsph.model import Camera, Image, Particles, Points, Scene, Settings, TransferFunction, Volume
from jaxsph.model.clips import Box, Plane, Sphere
from jaxsph.plan import Plan
from jaxsph.planning import plan
from jaxsph.progressive import Progressive, progressive
from jaxsph.render import CapacityError, render
from jaxsph.resample import resample
from jaxsph.slices import Slice, slice_of
from jaxsph.splats import splat_bound
from jaxsph.sweep import sweep
from jaxsph.version import __version__

__all__ = [
    "Box",
    "Camera",
    "CapacityError",
    "Coarsened",
    "Image",
    "IsoSurface",
    "Particles",
    "Plan",
    "Plane",
    "Points",
    "Progressive",
    "Scene",
    "Settings",
    "Slice",
    "Sphere",
    "TransferFunction",
    "Volume",
    "Within",
    "__version__",
    "coarse_bound",
    "coarsened",
    "in_octree",
    "io",
    "octree_plans",
    "plan",
    "prepare",
    "progressive",
    "reference",
    "render",
    "resample",
    "scenes",
    "slice_of",
    "splat_bound",
    "sweep",
]
