"""The command `transfer`: the figure of a transfer function over what rays meet, and the function as a file.

Flow: file, scene or saved function, options -> Scene, Camera -> [transfer] -> figure, JSON.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from jaxsph import io
from jaxsph.cli import look as cli_look
from jaxsph.cli import scene as cli_scene
from jaxsph.cli import voice
from jaxsph.cli.console import UsageError, refuse, require_writable, span
from jaxsph.cli.options import groups, values
from jaxsph.cli.options.groups import OUTPUT, OWN, option, output
from jaxsph.cli.voice import say
from jaxsph.io.replace import write_figure
from jaxsph.plot.transfer_figure import transfer_figure

OF_SOURCES = ("color_by", "save", "colormap", "range", "norm", "preset", "optical_depth", "transfer")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Transfer(groups.Options, groups.Key, groups.Look, groups.View, groups.Source):
    """Options of the command."""

    unit: Annotated[str | None, option("--unit", "UNIT", str, OUTPUT, "of the quantity on its axis, as Msun/kpc**3")] = None
    length_unit: Annotated[str | None, option("--length-unit", "UNIT", str, OUTPUT, "of lengths, as kpc")] = None
    output: Annotated[Path | None, output(".png, .pdf or .svg: the figure (default: named after FILE, here)")] = None
    save: Annotated[Path | None, option("--save", "FILE.json", Path, OUTPUT, "write the function, for --transfer")] = None
    rays: Annotated[
        int, option("--rays", "N", values.whole, OWN, "random pixels for the histogram of what they meet (default 2000)")
    ] = 2000


def transfer(
    file: Annotated[str, Parameter(help="a file, scene:NAME, or a saved function (.json)")], /, *, asked: Transfer = Transfer()
) -> None:
    """Draw a transfer function over what rays meet."""
    options = dataclasses.replace(asked, source=file)
    output = _checked(options)
    if Path(file).suffix.lower() == ".json":
        refuse(options, OF_SOURCES, "is for FILE or scene:NAME, and this is a saved function")
        _draw_file(file, output)
        return
    scene, camera, labels = cli_scene.scene_of(options)
    look = scene.looks[0]
    write_figure(transfer_figure(look, scene, camera, labels=labels, title=file, rays=options.rays), output)
    say("figure", f"{output}, over what {min(options.rays, camera.width * camera.height)} rays meet")
    voice.written(output, values=[float(look.values[0]), float(look.values[-1])])
    if options.save is not None:
        look.save(options.save)
        say("saved", f"{options.save}: render with --transfer {options.save}")
        voice.written(options.save)


def _checked(options: Any) -> Path:
    """Where the figure goes; know before the work that it, and the function, can be written there."""
    stem = Path(str(options.source).split(":")[1] if str(options.source).startswith("scene:") else options.source).stem
    output: Path = options.output or Path(f"{stem}_transfer.png")
    cli_look.require_figure(output)
    if options.save is not None:
        require_writable(options.save, "--save: a transfer function is written as", (".json",))
    if options.rays < 1:
        raise UsageError(f"--rays must be at least 1, got {options.rays}")
    return output


def _draw_file(file: str, output: Path) -> None:
    """The figure of a saved function alone."""
    look = io.read_transfer(file)
    say("colours", f"{len(look.values)} control points over {span(look.values)}, extinction {span(look.extinction)}")
    write_figure(transfer_figure(look, title=Path(file).name), output)
    say("figure", str(output))
    voice.written(output)
