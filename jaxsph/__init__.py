"""jaxsph: volume rendering of SPH particles, in JAX.

Names are imported when they are first used (PEP 562), so that importing this module imports nothing that takes time.
"""

from typing import TYPE_CHECKING, Any

import jaxsph.engine.cast  # noqa: F401 (integrators are entered there)
from jaxsph.numerics import __version__ as __version__
from jaxsph.numerics.names import import_by_name

if TYPE_CHECKING:
    from jaxsph import io as io, reference as reference, scale as scale, scenes as scenes, sequence as sequence
    from jaxsph.analysis.at_places import resample as resample, sample as sample
    from jaxsph.analysis.explain import explain as explain
    from jaxsph.analysis.mesh import mesh as mesh
    from jaxsph.analysis.projection.plan import plan_projection as plan_projection
    from jaxsph.analysis.projection.project import project as project
    from jaxsph.analysis.slices import slice as slice
    from jaxsph.analysis.visibility import visibility_histogram as visibility_histogram
    from jaxsph.engine.bracket import bracket as bracket
    from jaxsph.engine.frame.quadtree import progressive as progressive
    from jaxsph.engine.media.shown import Within as Within
    from jaxsph.engine.media.surfaces.iso_surface import IsoSurface as IsoSurface
    from jaxsph.engine.planning.fit import plan as plan
    from jaxsph.engine.render import render as render
    from jaxsph.model.camera.camera import Camera as Camera
    from jaxsph.model.camera.path import CameraPath as CameraPath
    from jaxsph.model.clips import Box as Box, Plane as Plane, Sphere as Sphere
    from jaxsph.model.image import Image as Image
    from jaxsph.model.particles.particles import Particles as Particles
    from jaxsph.model.particles.prepare import prepare as prepare
    from jaxsph.model.points import Points as Points
    from jaxsph.model.scene import Scene as Scene, Surface as Surface
    from jaxsph.model.settings import Settings as Settings
    from jaxsph.model.trainable import trainable as trainable
    from jaxsph.model.transfer.function import TransferFunction as TransferFunction
    from jaxsph.model.volume import Volume as Volume
    from jaxsph.numerics.faults import CapacityError as CapacityError
    from jaxsph.sequence.frames import render_frames as render_frames
    from jaxsph.trade.sweep import sweep as sweep
    from jaxsph.viewer.widget import view as view

NAMES = {
    # Things: what is in a picture, and what pictures are.
    "Particles": "jaxsph.model.particles.particles:Particles",
    "Points": "jaxsph.model.points:Points",
    "Volume": "jaxsph.model.volume:Volume",
    "IsoSurface": "jaxsph.engine.media.surfaces.iso_surface:IsoSurface",
    "Surface": "jaxsph.model.scene:Surface",
    "Scene": "jaxsph.model.scene:Scene",
    "Box": "jaxsph.model.clips:Box",
    "Plane": "jaxsph.model.clips:Plane",
    "Sphere": "jaxsph.model.clips:Sphere",
    "Within": "jaxsph.engine.media.shown:Within",
    "Image": "jaxsph.model.image:Image",
    # Looks.
    "TransferFunction": "jaxsph.model.transfer.function:TransferFunction",
    "visibility_histogram": "jaxsph.analysis.visibility:visibility_histogram",
    # Cameras.
    "Camera": "jaxsph.model.camera.camera:Camera",
    "CameraPath": "jaxsph.model.camera.path:CameraPath",
    # Verbs, how well they are to be done, and what they need or raise.
    "render": "jaxsph.engine.render:render",
    "bracket": "jaxsph.engine.bracket:bracket",
    "progressive": "jaxsph.engine.frame.quadtree:progressive",
    "plan": "jaxsph.engine.planning.fit:plan",
    "prepare": "jaxsph.model.particles.prepare:prepare",
    "trainable": "jaxsph.model.trainable:trainable",
    "project": "jaxsph.analysis.projection.project:project",
    "plan_projection": "jaxsph.analysis.projection.plan:plan_projection",
    "sample": "jaxsph.analysis.at_places:sample",
    "slice": "jaxsph.analysis.slices:slice",
    "resample": "jaxsph.analysis.at_places:resample",
    "explain": "jaxsph.analysis.explain:explain",
    "mesh": "jaxsph.analysis.mesh:mesh",
    "view": "jaxsph.viewer.widget:view",
    "sweep": "jaxsph.trade.sweep:sweep",
    "Settings": "jaxsph.model.settings:Settings",
    "CapacityError": "jaxsph.numerics.faults:CapacityError",
    # Sequences.
    "render_frames": "jaxsph.sequence.frames:render_frames",
    # Rooms: files, built-in scenes, the oracle, pictures by parts, many frames.
    "io": "jaxsph.io",
    "scenes": "jaxsph.scenes",
    "reference": "jaxsph.reference",
    "scale": "jaxsph.scale",
    "sequence": "jaxsph.sequence",
}

__all__ = [*NAMES]


def __getattr__(name: str) -> Any:
    if name not in NAMES:
        raise AttributeError(f"module 'jaxsph' has no attribute {name!r}")
    globals()[name] = import_by_name(NAMES[name])
    return globals()[name]


def __dir__() -> list[str]:
    return sorted(NAMES)
