"""Many frames: snapshots over time, and frames on one machine or many."""

from jaxsph.sequence.frames import render_frames
from jaxsph.sequence.snapshots import Snapshots
from jaxsph.sequence.task import FrameFile, FramesError

__all__ = ["FrameFile", "FramesError", "Snapshots", "render_frames"]
