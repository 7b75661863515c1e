"""jaxsph: volume rendering of SPH particles, in JAX."""

from jaxsph import image_figure, io, reference, scenes, transfer_figure
from jaxsph.access.morton import prepare
from jaxsph.field.in_octree import in_octree, octree_plans
from jaxsph.field.iso_surface import IsoSurface
from jaxsph.field.within import Within
from jaxsph.frame_task import FrameFile, FramesError
from jaxsph.frames import render_frames
from jaxsph.from_disk import render_from_disk
from jaxsph.met import Met, met
from jaxsph.model import Camera, CameraPath, Image, Particles, Points, Scene, Settings, TransferFunction, Volume
from jaxsph.model.clip_shapes import Box, Plane, Sphere
from jaxsph.model.domains import control_values
from jaxsph.model.framing import along_axis
from jaxsph.model.held import emission
from jaxsph.model.projection import Projection
from jaxsph.numerics.faults import CapacityError
from jaxsph.on_disk import OnDisk
from jaxsph.plan import Plan
from jaxsph.planning import plan
from jaxsph.progressive import Progressive, progressive
from jaxsph.project import project
from jaxsph.projection_plan import ProjectionPlan, plan_projection
from jaxsph.render import render
from jaxsph.resample import resample
from jaxsph.slices import Slice, slice_of
from jaxsph.snapshots import Snapshots
from jaxsph.sweep import sweep
from jaxsph.tiles import merge, render_tile
from jaxsph.version import __version__

__all__ = [
    "Box",
    "Camera",
    "CameraPath",
    "CapacityError",
    "FrameFile",
    "FramesError",
    "Image",
    "IsoSurface",
    "Met",
    "OnDisk",
    "Particles",
    "Plan",
    "Plane",
    "Points",
    "Progressive",
    "Projection",
    "ProjectionPlan",
    "Scene",
    "Settings",
    "Slice",
    "Snapshots",
    "Sphere",
    "TransferFunction",
    "Volume",
    "Within",
    "__version__",
    "along_axis",
    "control_values",
    "emission",
    "image_figure",
    "in_octree",
    "io",
    "merge",
    "met",
    "octree_plans",
    "plan",
    "plan_projection",
    "prepare",
    "progressive",
    "project",
    "reference",
    "render",
    "render_frames",
    "render_from_disk",
    "render_tile",
    "resample",
    "scenes",
    "slice_of",
    "sweep",
    "transfer_figure",
]
