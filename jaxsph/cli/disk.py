"""Snapshots larger than memory on the command line: `render --from-disk`, and the command `sort`.

Flow: options -> [cli_disk] -> OnDisk, Image -> cli.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import numpy as np

from jaxsph.cli import look as cli_look
from jaxsph.cli import scene as cli_scene
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import UsageError, camera_line, progress, refuse, say, span, time_line
from jaxsph.cli.options import SCENE
from jaxsph.io.disk.index import index_path
from jaxsph.io.disk.rows import Snapshot
from jaxsph.io.disk.sort import sort_snapshot
from jaxsph.model import Image, Settings
from jaxsph.scale.from_disk import TooLittleMemoryError, render_from_disk
from jaxsph.scale.on_disk import OnDisk

GIB = 2**30
DIGITS = 4
FRACTIONS = 10**DIGITS
"""Of a GiB, to which memory is named."""
OTHERS = ("volume", "points", "iso", "support", "particles", "frame", *cli_where.CLIPS)
"""Options of what cannot be rendered part by part."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """The option of `render`."""
    more = "leave the particles of a Gadget-like HDF5 snapshot on disk, and keep at most GIB of them and of what is made of them"
    parser.add_argument("--from-disk", type=float, metavar="GIB", help=more)


def render(options: argparse.Namespace, settings: Settings) -> Image:
    """The picture of a snapshot that stays on disk.

    Raises:
        UsageError: options that need all particles at once.
    """
    if not 0 < options.from_disk < 2**20:
        raise UsageError(f"--from-disk must be a positive number of GiB, got {options.from_disk:g}")
    if options.source is None or options.source.startswith(SCENE):
        raise UsageError("--from-disk is for a snapshot file")
    refuse(options, (*OTHERS, *cli_where.OF_PARTICLES), "needs all particles at once; leave out --from-disk")
    if options.progressive or options.screen == "quadtree" or options.annotate:
        raise UsageError("--from-disk renders the image pane by pane; leave out --progressive, --screen and --annotate")
    with progress("index", " reads") as show:
        on_disk = OnDisk.open(
            options.source,
            options.quantity,
            kernel=options.kernel,
            part_type=options.part_type,
            opacity_by=options.opacity_by or "auto",
            progress=show,
        )
    say("file", f"{options.source}: {len(on_disk):,} particles in {len(on_disk.snapshot.files)} files")
    if on_disk.snapshot.first.box_size is not None:
        say("note", "periodic box: supports do not reach across its faces")
    say("index", f"{index_path(on_disk.snapshot)}, {len(on_disk.index.file):,} runs")
    name, values = on_disk.quantities[0], np.asarray(on_disk.sample.quantity)[np.asarray(on_disk.sample.valid)]
    say("quantity", f"{name}, {span(values)} of a sample of {len(values):,}")
    if len(on_disk.quantities) > 1:
        say("opacity", f"by {on_disk.quantities[1]}")
    transfer = cli_look.look(on_disk.sample, options, name, on_disk.ramp)
    camera = cli_scene.camera_of(on_disk, options)
    say("camera", camera_line(camera))
    started = time.perf_counter()
    try:
        with progress("render", " panes") as show:
            image = render_from_disk(on_disk, transfer, camera, settings, memory=int(options.from_disk * GIB), progress=show)
    except TooLittleMemoryError as error:
        raise ValueError(_too_little(options, error)) from error
    say("panes", f"{image.stats['panes']}, of at most {image.stats['most_particles']:,} particles")
    say("time", time_line(image, time.perf_counter() - started))
    return image


def _too_little(options: argparse.Namespace, error: TooLittleMemoryError) -> str:
    """In words of the command line: the least memory that works, rounded up to what is written of it."""
    option, given = ("--memory", options.memory) if error.name == "settings.memory_limit" else ("--from-disk", options.from_disk)
    least = math.ceil(error.least / GIB * FRACTIONS) / FRACTIONS
    return f"{options.source}: {option} {given:g} is too little: {error.why}; give {option} {least:.{DIGITS}f} or more"


def add_sort(parser: argparse.ArgumentParser) -> None:
    """Options of the command `sort`."""
    parser.add_argument("source", metavar="FILE", help="Gadget-like HDF5; any file of a snapshot in several")
    where = "one file, ordered in space; one that is there is replaced only if it was sorted from a FILE of this name"
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT.hdf5", help=where)
    parser.add_argument("--part-type", type=int, metavar="N", help="kind of particles (default: gas, else the first)")


def sort(options: argparse.Namespace) -> None:
    """Order a snapshot in space."""
    with progress("sort", " reads") as show:
        sort_snapshot(options.source, options.output, part_type=options.part_type, progress=show)
    say("sorted", f"{options.output}, {len(Snapshot(options.output, options.part_type)):,} particles")
