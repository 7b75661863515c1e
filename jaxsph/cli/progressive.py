"""The option --progressive: a file that holds a picture soon, and a better one after every stage.

Flow: scene, camera, settings -> progressive -> [cli_progressive] -> files, lines of text.
"""

from __future__ import annotations

from pathlib import Path

from jaxsph.cli.console import say
from jaxsph.engine.frame.progressive import progressive
from jaxsph.model import Camera, Image, Scene, Settings


def render_in_stages(scene: Scene, camera: Camera, settings: Settings, output: Path) -> Image:
    """The last image; `output` is rewritten at each stage, whole or not at all, and keeps the last when interrupted."""
    shown: Image | None = None
    try:
        for image in progressive(scene, camera, settings):
            image.save(output)
            shown = image
            say(f"stage {image.stats['stage']}", _line(image))
    except KeyboardInterrupt:
        if shown is not None:
            say("stopped", f"{output} holds stage {shown.stats['stage']}")
        raise
    assert shown is not None
    return shown


def _line(image: Image) -> str:
    """What is known of an image, and what is left to do."""
    stats = image.stats
    errors = f"estimated error {stats['max_error']:.2g} at most, {100 * stats['l2_error']:.2g} % in L2"
    return f"{errors}; {stats['rays']:,} rays cast, {stats['rays_left']:,} left at most; {sum(stats['seconds'].values()):.2f} s"
