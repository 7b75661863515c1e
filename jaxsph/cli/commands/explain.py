"""The command `explain`: the error budget of a pixel, and its ray.

Flow: options -> Scene, Camera, Settings, pixel -> `jaxsph.explain` -> [explain] -> a table on stdout, a figure.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

from jaxsph.analysis.explain import explain as explained
from jaxsph.analysis.explain import pixel_of
from jaxsph.cli import look as cli_look
from jaxsph.cli import scene as cli_scene
from jaxsph.cli import voice
from jaxsph.cli.console import UsageError, camera_line, wrong_usage
from jaxsph.cli.options import groups, values
from jaxsph.cli.options.groups import OWN, option, output
from jaxsph.cli.options.settings import as_medium, settings_of
from jaxsph.cli.voice import say


@dataclasses.dataclass(frozen=True, kw_only=True)
class Explain(groups.Options, groups.Draft, groups.SurfaceLook, groups.View, groups.Beside, groups.Source):
    """Options of the command."""

    pixel: Annotated[Any, option("--pixel", "R,C", values.pixel, OWN, "row and column, from 0 at the top and the left")] = None
    output: Annotated[Path | None, output("a figure too: .png, .pdf or .svg")] = None


def explain(file: Annotated[str | None, groups.FILE] = None, /, *, asked: Explain = Explain()) -> None:
    """Say what the error bound of a pixel is made of, and what its ray meets."""
    options = dataclasses.replace(asked, source=file)
    settings = settings_of(options)
    options = as_medium(options, settings)
    cli_scene.require_something(options)
    if options.pixel is None:
        raise UsageError("--pixel R C says which pixel is to be explained: its row and its column")
    with wrong_usage():
        pixel_of(options.pixel, *options.size)
    if options.output is not None:
        cli_look.require_figure(options.output)
    scene, camera, labels = cli_scene.scene_of(options)
    if scene.surface is not None:
        raise UsageError("a surface of particles has no error to explain; --surface none explains them as a medium")
    say("camera", camera_line(camera, options))
    made = explained(scene, camera, settings, pixel=options.pixel)
    voice.result(str(made))
    voice.report(**{field.name: getattr(made, field.name) for field in dataclasses.fields(made)}, off_integral=made.off_integral)
    if options.output is not None:
        made.save(options.output, labels.quantity, str(options.source or ""))
        voice.written(options.output)
