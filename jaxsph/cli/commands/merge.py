"""One picture by several commands: which part `render --tile I/N` makes, and `merge` for the whole.

Flow: I/N -> render_tile -> part.exr ... parts -> [cli_merge] -> merge -> EXR or PNG.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from jaxsph import io
from jaxsph.cli import voice
from jaxsph.cli.console import IMAGES, UsageError, largest, refuse, require_writable, tell_if_unseen
from jaxsph.cli.options import groups
from jaxsph.cli.options.groups import output
from jaxsph.cli.voice import say
from jaxsph.model import Settings
from jaxsph.scale import parts as tiles


@dataclasses.dataclass(frozen=True, kw_only=True)
class Merge(groups.Options):
    """Options of the command."""

    output: Annotated[Path | None, output(".exr or .png")] = None


def suffix(options: Any) -> str:
    """Of a picture that is named after its source."""
    return ".png" if options.tile is None else "_{}_of_{}.exr".format(*options.tile)


def check_tile(options: Any, settings: Settings, output: Path) -> None:
    """Refuse what a part cannot be asked for."""
    if options.tile is None:
        return
    others = "progressive", "annotate", "unit", "length_unit", "devices", "background"
    refuse(options, others, "and --tile exclude each other; --tile is a part of one picture, as it is")
    if settings.screen == "quadtree":
        raise UsageError("--screen quadtree cannot be cut into parts; leave out --screen or --tile")
    if output.suffix.lower() != ".exr":
        raise UsageError(f"{output}: a part must be .exr, which says where it belongs; `jaxsph merge` makes a .png of all parts")


def merge(
    *files: Annotated[Path, Parameter(help="all parts of one picture, those of `jaxsph render --tile I/N`, in any order")],
    asked: Merge = Merge(),
) -> None:
    """Read the parts, put them together, and write the picture."""
    if asked.output is None or not files:
        raise UsageError("-o OUT is needed: where should the picture go?" if files else "the parts of a picture are needed")
    require_writable(asked.output, "an image must be", IMAGES)
    for path in files:
        if path.suffix.lower() != ".exr":
            raise UsageError(f"{path}: parts are .exr")
    image = tiles.merge_tiles([io.read_image(path) for path in files], names=[str(path) for path in files])
    image.save(asked.output)
    height, width = image.shape
    say("image", f"{asked.output}, {width} x {height}, of {len(files)} parts")
    tolerance = dict(image.metadata).get("jaxsph.tolerance")
    if tolerance is not None:
        kind = "certified" if image.certified else "estimated"
        say("error", f"at most {largest(image.error_bound):.2g} ({kind}), tolerance {tolerance:g}")
    voice.written(asked.output, size=[width, height], parts=len(files))
    tell_if_unseen("merge", asked.output, [image.color])
