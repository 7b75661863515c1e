"""jaxsph: volume rendering of SPH particles, in JAX."""

import jaxsph.plot.methods  # noqa: F401 (images, paths, ... get their methods there)
from jaxsph import io, reference, scenes
from jaxsph.analysis.met import met
from jaxsph.analysis.projection.plan import ProjectionPlan, plan_projection
from jaxsph.analysis.projection.project import project
from jaxsph.analysis.resample import resample
from jaxsph.analysis.slices import Slice, slice_of
from jaxsph.engine.access.morton import prepare
from jaxsph.engine.frame.progressive import progressive
from jaxsph.engine.media.in_octree import in_octree
from jaxsph.engine.media.iso_surface import IsoSurface
from jaxsph.engine.media.within import Within
from jaxsph.engine.planning.fit import plan
from jaxsph.engine.planning.plan import Plan
from jaxsph.engine.render import render
from jaxsph.model import Camera, CameraPath, Image, Particles, Points, Scene, Settings, TransferFunction, Volume
from jaxsph.model.camera.framing import along_axis
from jaxsph.model.clips.shapes import Box, Plane, Sphere
from jaxsph.model.particles.held import emission
from jaxsph.model.projection import Projection
from jaxsph.model.transfer.domains import control_values
from jaxsph.numerics.faults import CapacityError
from jaxsph.numerics.version import __version__
from jaxsph.scale.from_disk import render_from_disk
from jaxsph.scale.on_disk import OnDisk
from jaxsph.scale.parts import merge, render_tile
from jaxsph.sequence.frames import render_frames
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.sequence.task import FrameFile, FramesError
from jaxsph.trade.sweep import sweep

__all__ = [
    "Box",
    "Camera",
    "CameraPath",
    "CapacityError",
    "FrameFile",
    "FramesError",
    "Image",
    "IsoSurface",
    "OnDisk",
    "Particles",
    "Plan",
    "Plane",
    "Points",
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
    "in_octree",
    "io",
    "merge",
    "met",
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
]
