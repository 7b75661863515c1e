"""Files of volumes on the command line: what is shown of them, and what `info` says.

Flow: file, options -> [cli_volume] -> Scene -> cli.
"""

from __future__ import annotations

import argparse

import numpy as np

from jaxsph import io, scenes
from jaxsph.cli import annotate as cli_annotate
from jaxsph.cli import transfer as cli_transfer
from jaxsph.cli.console import ranges, say, span
from jaxsph.engine.media.iso_surface import IsoSurface
from jaxsph.model import Scene, TransferFunction, Volume

ISO_COLOR = 0.85, 0.8, 0.7


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of volumes that share a picture with other parts."""
    add = parser.add_argument_group("volumes beside the source").add_argument
    more = "a volume in the same picture; may be repeated, and be there without a source"
    add("--volume", action="append", metavar="FILE", help=more)
    add("--volume-quantity", metavar="NAME", help="which of its values (default: the first of one number a point)")
    add("--volume-colormap", metavar="NAME", help="(default viridis)")


def scene_of(options: argparse.Namespace) -> tuple[Scene, Volume]:
    """The volume of the source under a colour map, or its iso-surface; and what there is to frame."""
    volume, name = _volume_of_file(options.source, options.quantity)
    cli_annotate.label(name, options, "a volume")
    if options.iso is not None:
        color = ISO_COLOR if options.colormap is None else tuple(scenes.colormap(options.colormap)[-1])
        say("surface", f"where the values are {options.iso:g}")
        return Scene(media=(IsoSurface.from_volume(volume, options.iso, color),)), volume
    return Scene(volume=volume, volume_transfer=cli_transfer.look(volume, options, name)), volume


def beside(options: argparse.Namespace) -> list[tuple[Volume, TransferFunction]]:
    """Volumes besides the source, each with what it looks like."""
    volumes = [_volume_of_file(path, options.volume_quantity)[0] for path in options.volume or ()]
    return [(volume, _transfer(volume, options.volume_colormap or "viridis")) for volume in volumes]


def _transfer(volume: Volume, name: str) -> TransferFunction:
    transfer = scenes.default_volume_transfer(volume, name)
    say("colours", f"{name} over {span(transfer.values)}, extinction {span(transfer.extinction)} per unit length")
    return transfer


def _volume_of_file(path: str, quantity: str | None) -> tuple[Volume, str]:
    """A volume, and the name of its values."""
    table = io.read_volume_table(path)
    say("file", f"{path}: {table.source}, {' x '.join(map(str, table.shape))} points")
    try:
        volume, name = io.volume_from_table(table, quantity)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    say("quantity", f"{name}, {volume.values.dtype}, {span(np.asarray(volume.values))}")
    for note in table.conventions:
        say("note", note)
    return volume, name


def describe(path: str, quantity: str | None) -> Volume:
    """Say what a file of a volume holds, and what of it would be shown."""
    table = io.read_volume_table(path)
    print(f"{path}: {table.source}, {' x '.join(map(str, table.shape))} points")
    for sentence in table.conventions:
        print(f"  {sentence}")
    print()
    for name, values in table.arrays.items():
        columns = values.reshape(-1, *values.shape[3:])
        print(f"  {name}  {' x '.join(map(str, values.shape))}  {values.dtype}  {ranges(columns)}")
    corner, step = (" ".join(f"{number:.6g}" for number in vector) for vector in (table.lower, table.spacing))
    print(f"\nlower corner {corner}, spacing {step}\n\n`jaxsph render` would show")
    say("quantity", table.quantity(quantity)[0])
    return io.volume_from_table(table, quantity)[0]
