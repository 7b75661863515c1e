"""Many frames: snapshots over time, and frames on one machine or many."""

from typing import TYPE_CHECKING

from jaxsph.numerics.names import lazy

if TYPE_CHECKING:
    from jaxsph.sequence.frames import render_frames
    from jaxsph.sequence.snapshots import Snapshots
    from jaxsph.sequence.task import FrameFile, FramesError

__all__ = ["FrameFile", "FramesError", "Snapshots", "render_frames"]

__getattr__, __dir__ = lazy(
    __name__,
    {
        "FrameFile": "jaxsph.sequence.task:FrameFile",
        "FramesError": "jaxsph.sequence.task:FramesError",
        "Snapshots": "jaxsph.sequence.snapshots:Snapshots",
        "render_frames": "jaxsph.sequence.frames:render_frames",
    },
)
