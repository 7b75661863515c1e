"""Pictures with a key on the command line: `--annotate`, and the labels of what a file holds.

Flow: options, table, image -> [cli_annotate] -> labels -> annotated PNG.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.cli.console import UsageError, say
from jaxsph.io import Labels, ParticleTable, labels_of
from jaxsph.io.libraries import require
from jaxsph.io.replace import written_whole
from jaxsph.io.settle.labels import NEEDS, can_name
from jaxsph.io.settle.quantities import LOG_PREFIX
from jaxsph.io.settle.unit_names import unit_of
from jaxsph.model import Camera, Image, Scene
from jaxsph.plot.image_figure import image_figure

SUFFIX = ".png"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the key."""
    add = parser.add_argument_group("key").add_argument
    add("--annotate", action="store_true", help="with colour bar, scale bar, axes, outline and time (a .png)")
    add_units(parser, add)


def add_units(parser: argparse.ArgumentParser, add: Any) -> None:
    """Options of units, for a key or a figure."""
    parser.set_defaults(labels=Labels())
    add("--unit", metavar="UNIT", help="of the quantity on its axis, as Msun/kpc**3 (default: by what the file states)")
    add("--length-unit", metavar="UNIT", help="of lengths, as kpc")


def check(options: argparse.Namespace, output: Path) -> None:
    """Know before the work that the key can be drawn."""
    if options.annotate:
        require_figure(output, (SUFFIX,))
        if options.progressive:
            raise UsageError("--annotate draws on the finished picture; leave out --progressive")
    elif options.unit is not None or options.length_unit is not None:
        name = "unit" if options.unit is not None else "length-unit"
        raise UsageError(f"--{name} goes with --annotate")


def require_figure(output: Path, suffixes: tuple[str, ...]) -> None:
    """Know before the work that a figure can be written, and drawn at all."""
    if output.suffix.lower() not in suffixes:
        raise UsageError(f"{output}: a figure is written as {' or '.join(suffixes)}")
    if not output.parent.is_dir():
        raise ValueError(f"{output}: there is no folder {output.parent} to write it to; make it first")
    if output.is_dir() or not os.access(output.parent, os.W_OK):
        raise ValueError(f"{output}: cannot be written; choose another place with -o")
    require("matplotlib", "figures", "color")


def wanted(options: argparse.Namespace) -> bool:
    """Whether the command shows labels at all."""
    return bool(getattr(options, "annotate", hasattr(options, "labels")))


def label_file(
    table: ParticleTable, quantity: str, values: np.ndarray, options: argparse.Namespace, opacity_by: str | None = None
) -> None:
    """Label a quantity of a file, and that of extinction, where the command shows that; in code units, with a note, without unyt.

    Raises:
        UsageError: a unit that does not agree, or that the file does not state.
    """
    if not wanted(options):
        return
    largest = float(np.abs(values).max(initial=0)) if values.size else 1.0
    if quantity.lower().startswith(LOG_PREFIX) and values.size:
        largest = 10.0 ** float(values.max())
    stated = unit_of(table, quantity) is not None or table.units.length is not None
    if stated and not can_name() and options.unit is None and options.length_unit is None:
        say("note", f"code units: {NEEDS}")
    try:
        made = labels_of(table, quantity, largest, unit=options.unit, length_unit=options.length_unit)
        options.labels = dataclasses.replace(made, opacity=opacity_by or made.opacity)
    except ValueError as error:
        raise UsageError(str(error)) from error


def label(quantity: str, options: argparse.Namespace, what: str) -> None:
    """Label a quantity of what states no units, where the command shows that."""
    if not wanted(options):
        return
    if options.unit is not None or options.length_unit is not None:
        name = "unit" if options.unit is not None else "length-unit"
        raise UsageError(f"--{name} is for files that state units, and {what} does not; leave it out")
    options.labels = Labels(quantity)


def save(image: Image, scene: Scene, camera: Camera, options: argparse.Namespace, output: Path) -> None:
    """Write the picture with its key."""
    figure = image_figure(image, scene, camera, labels=options.labels, target=options.target)
    write_figure(figure, output, image)


def write_figure(figure: Any, output: Path, image: Image | None = None) -> None:
    """Write a figure whole or not at all; what an image's file says of how it was made, this says too."""
    said = {} if image is None else {str(name): str(value) for name, value in image.metadata}
    with written_whole(output) as temporary:
        figure.savefig(temporary, metadata=said) if said else figure.savefig(temporary)


def describe(table: ParticleTable) -> None:
    """Say which units a file states."""
    units = table.units
    stated = [*(["positions"] if units.length is not None else []), *units.columns]
    if stated:
        say("units", f"stated for {', '.join(stated)}")
    moment = labels_of(table, "", 1.0).moment
    if moment:
        say("time", moment)
