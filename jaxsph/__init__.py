"""jaxsph: volume rendering of SPH particles, in JAX."""

from jaxsph import io, reference, scenes
from jaxsph.access.morton import prepare
from jaxsph.coarse import Coarsened, coarse_bound, coarsened
from jaxsph.field.in_octree import in_octree, octree_plans
from jaxsph.field.iso_surface import IsoSurface
from jaxsph.model import Camera, Image, Particles, Points, Scene, Settings, TransferFunction, Volume
from jaxsph.model.framing import along_axis
from jaxsph.model.held import emission
from jaxsph.model.projection import Projection
from jaxsph.plan import Plan
from jaxsph.planning import plan
from jaxsph.progressive import Progressive, progressive
from jaxsph.project import project
from jaxsph.projection_plan import ProjectionPlan, plan_projection
from jaxsph.render import CapacityError, render
from jaxsph.resample import resample
from jaxsph.splats import splat_bound
from jaxsph.sweep import sweep
from jaxsph.version import __version__

__all__ = [
    "Camera",
    "CapacityError",
    "Coarsened",
    "Image",
    "IsoSurface",
    "Particles",
    "Plan",
    "Points",
    "Progressive",
    "Projection",
    "ProjectionPlan",
    "Scene",
    "Settings",
    "TransferFunction",
    "Volume",
    "__version__",
    "along_axis",
    "coarse_bound",
    "coarsened",
    "emission",
    "in_octree",
    "io",
    "octree_plans",
    "plan",
    "plan_projection",
    "prepare",
    "progressive",
    "project",
    "reference",
    "render",
    "resample",
    "scenes",
    "splat_bound",
    "sweep",
]
