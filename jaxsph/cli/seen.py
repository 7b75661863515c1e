"""Points of a surface instead of a picture of it: `jaxsph render FILE --surface -o points.ply`.

Flow: Scene, Camera, Settings -> `jaxsph.surface_depth` -> [seen] -> PLY, its path on stdout.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from jaxsph.analysis.surface_depth import surface_depth
from jaxsph.cli import voice
from jaxsph.cli.console import UsageError, camera_line, refuse
from jaxsph.cli.voice import say
from jaxsph.io.images.point_cloud import SUFFIX
from jaxsph.model import Camera, Scene, Settings

OF_PICTURES = ("tile", "progressive", "annotate", "background", "unit", "length_unit", "devices", "points", "volume", "iso")


def is_points(output: Path) -> bool:
    """Whether what is asked for are points."""
    return output.suffix.lower() == SUFFIX


def check(options: Any, output: Path) -> None:
    """Refuse what points do not have."""
    if is_points(output):
        refuse(options, (*OF_PICTURES, "from_disk"), f"is of pictures, and {output} is to hold points of a surface; leave it out")


def write(scene: Scene, camera: Camera, settings: Settings, options: Any, output: Path) -> None:
    """Write the points that are seen, and say how many.

    Raises:
        UsageError: there is no surface.
    """
    if scene.surface is None:
        raise UsageError(f"{output} holds points of a surface, and {options.source} is shown as a medium; add --surface")
    started = time.perf_counter()
    found = surface_depth(scene, camera, settings)
    found.save(output)
    count = int(found.met.sum())
    met = f"{count:,} of {camera.width * camera.height:,} rays meet the surface"
    say("points", f"{output}, {met}, {settings.samples} samples a ray")
    say("time", f"{time.perf_counter() - started:.2f} s")
    size = [camera.width, camera.height]
    voice.written(output, points=count, size=size, camera=camera_line(camera, options))
