"""Many frames: snapshots over time, and frames on one machine or many."""

from typing import TYPE_CHECKING

from jaxsph.numerics.names import lazy

if TYPE_CHECKING:
    from jaxsph.sequence.frames import render_frames
    from jaxsph.sequence.snapshots import Snapshots
    from jaxsph.sequence.task import FrameFile, FramesError

__all__ = ["FrameFile", "FramesError", "Snapshots", "render_frames"]

_PLACES = {"FrameFile": "task", "FramesError": "task", "Snapshots": "snapshots", "render_frames": "frames"}
__getattr__, __dir__ = lazy(__name__, {name: f"{__name__}.{module}:{name}" for name, module in _PLACES.items()})
