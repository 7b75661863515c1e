"""Files of volumes on the command line: what is shown of them, and what `info` says.

Flow: file, options -> [cli_volume] -> Scene, Camera -> cli.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np

from jaxsph import io, scenes
from jaxsph.console import camera_line, ranges, say, span
from jaxsph.field.iso_surface import IsoSurface
from jaxsph.model import Camera, Scene, Volume

ISO_COLOR = 0.85, 0.8, 0.7


def scene_of(options: argparse.Namespace, camera_of: Callable[[Volume, argparse.Namespace], Camera]) -> tuple[Scene, Camera]:
    """The volume of a file under a colour map, or its iso-surface."""
    volume = _volume_of_file(options)
    camera = camera_of(volume, options)
    if options.iso is not None:
        color = ISO_COLOR if options.colormap is None else tuple(scenes.colormap(options.colormap)[-1])
        say("surface", f"where the values are {options.iso:g}")
        return Scene(media=(IsoSurface.from_volume(volume, options.iso, color),)), camera
    name = options.colormap or "viridis"
    depth = scenes.appearance.OPTICAL_DEPTH if options.opacity is None else options.opacity
    transfer = scenes.default_volume_transfer(volume, name, options.range, depth)
    say("colours", f"{name} over {span(transfer.values)}, extinction {span(transfer.extinction)} per unit length")
    return Scene(volume=volume, volume_transfer=transfer), camera


def _volume_of_file(options: argparse.Namespace) -> Volume:
    table = io.read_volume_table(options.source)
    say("file", f"{options.source}: {table.source}, {' x '.join(map(str, table.shape))} points")
    try:
        volume, name = io.volume_from_table(table, options.quantity)
    except ValueError as error:
        raise ValueError(f"{options.source}: {error}") from error
    say("quantity", f"{name}, {volume.values.dtype}, {span(np.asarray(volume.values))}")
    for note in table.conventions:
        say("note", note)
    return volume


def describe(options: argparse.Namespace) -> None:
    """Say what a file of a volume holds, and how it would be looked at."""
    table = io.read_volume_table(options.source)
    print(f"{options.source}: {table.source}, {' x '.join(map(str, table.shape))} points")
    for sentence in table.conventions:
        print(f"  {sentence}")
    print()
    for name, values in table.arrays.items():
        columns = values.reshape(-1, *values.shape[3:])
        print(f"  {name}  {' x '.join(map(str, values.shape))}  {values.dtype}  {ranges(columns)}")
    corner, step = (" ".join(f"{number:.6g}" for number in vector) for vector in (table.lower, table.spacing))
    print(f"\nlower corner {corner}, spacing {step}\n\n`jaxsph render` would show")
    say("quantity", table.quantity(options.quantity)[0])
    say("camera", camera_line(Camera.framing(io.volume_from_table(table, options.quantity)[0])))
