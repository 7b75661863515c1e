"""One picture by several commands: which part `render --tile I/N` makes, and `merge` for the whole.

Flow: I/N -> render_tile -> part.exr ... parts -> [cli_merge] -> merge -> EXR or PNG.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from jaxsph import io
from jaxsph.cli.console import IMAGES, UsageError, largest, refuse, require_writable, say
from jaxsph.model import Settings
from jaxsph.scale import parts as tiles

MORE = "Parts are those of `jaxsph render --tile I/N`, in any order; they must be all of one picture."


def add_tile(parser: argparse.ArgumentParser) -> None:
    """The option of `render`."""
    more = "render part I of N alone, some rows of the picture, as EXR: I from 0 to N - 1, or from 1 to N (N is 0 then)"
    parser.add_argument("--tile", type=tile, metavar="I/N", help=f"{more}; `jaxsph merge` puts parts together")


class Part(tuple[int, int]):
    """Which part, from 0 on, and of how many; written as it was asked for."""

    text = ""

    def __str__(self) -> str:
        return self.text


def tile(text: str) -> Part:
    """Which part of how many; arrays of jobs count from 0 or from 1, and either way all parts are there."""
    try:
        index, count = (int(part) for part in text.split("/"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a part; write the second of four as 1/4") from None
    if count < 1 or not 0 <= index <= count:
        raise argparse.ArgumentTypeError(f"{text!r} is not a part; I must lie in [0, N], and N be at least 1")
    part = Part((index % count, count))
    part.text = f"{index}/{count}"
    return part


def suffix(options: argparse.Namespace) -> str:
    """Of a picture that is named after its source."""
    return ".png" if options.tile is None else "_{}_of_{}.exr".format(*options.tile)


def check_tile(options: argparse.Namespace, settings: Settings, output: Path) -> None:
    """Refuse what a part cannot be asked for."""
    if options.tile is None:
        return
    others = "progressive", "annotate", "slice", "devices"
    refuse(options, others, "and --tile exclude each other; --tile is a part of one picture, as it is")
    if settings.screen == "quadtree":
        raise UsageError("--screen quadtree cannot be cut into parts; leave out --screen or --tile")
    if output.suffix.lower() != ".exr":
        raise UsageError(f"{output}: a part must be .exr, which says where it belongs; `jaxsph merge` makes a .png of all parts")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the command `merge`."""
    parser.add_argument("parts", nargs="+", type=Path, metavar="PART.exr", help="all parts of one picture")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help=".exr or .png")


def run(options: argparse.Namespace) -> None:
    """Read the parts, put them together, and write the picture."""
    require_writable(options.output, "an image must be", IMAGES)
    for path in options.parts:
        if path.suffix.lower() != ".exr":
            raise UsageError(f"{path}: parts are .exr")
    image = tiles.merge_tiles([io.read_image(path) for path in options.parts], names=[str(path) for path in options.parts])
    image.save(options.output)
    height, width = image.shape
    say("image", f"{options.output}, {width} x {height}, of {len(options.parts)} parts")
    tolerance = dict(image.metadata).get("jaxsph.tolerance")
    if tolerance is not None:
        kind = "certified" if image.certified else "estimated"
        say("error", f"at most {largest(image.error_bound):.2g} ({kind}), tolerance {tolerance:g}")
