"""Snapshots larger than memory on the command line: `render --from-disk`.

Flow: options -> [disk] -> OnDisk, Image -> render.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from jaxsph.cli import look as cli_look
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import UsageError, camera_line, progress, refuse, span, time_line
from jaxsph.cli.options.settings import SCENE
from jaxsph.cli.voice import say
from jaxsph.io.disk.index import index_path
from jaxsph.model import Camera, Image, Settings
from jaxsph.scale.from_disk import TooLittleMemoryError, render_from_disk
from jaxsph.scale.on_disk import OnDisk

GIB = 2**30
DIGITS = 4
FRACTIONS = 10**DIGITS
"""Of a GiB, to which memory is named."""
OTHERS = ("volume", "points", "iso", "support", "where", "share", "center", "width", "clip")
"""Options of what cannot be rendered part by part."""


def render_options(options: Any, settings: Settings) -> tuple[Image, Camera]:
    """The picture of a snapshot that stays on disk, and its camera.

    Raises `UsageError`: options that need all particles at once.
    """
    if options.source is None or options.source.startswith(SCENE):
        raise UsageError("--from-disk is for a snapshot file")
    refuse(options, OTHERS, "needs all particles at once; leave out --from-disk")
    if options.box != "file":
        raise UsageError("--box-size needs all particles at once; leave out --from-disk")
    if options.progressive or options.screen == "quadtree" or cli_look.has_key(options):
        raise UsageError("--from-disk renders the image pane by pane; leave out --progressive, --screen and --annotate")
    with progress("index", " reads") as show:
        on_disk = OnDisk.open(
            options.source,
            options.color_by,
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
    transfer = cli_look.look(on_disk.sample, options, name)
    camera = cli_where.camera_of(on_disk, cli_where.upward(options))
    say("camera", camera_line(camera))
    started = time.perf_counter()
    try:
        with progress("render", " panes") as show:
            image = render_from_disk(on_disk, transfer, camera, settings, memory=int(options.from_disk * GIB), progress=show)
    except TooLittleMemoryError as error:
        raise ValueError(_too_little(options, error)) from error
    say("panes", f"{image.stats['panes']}, of at most {image.stats['most_particles']:,} particles")
    say("time", time_line(image, time.perf_counter() - started))
    return image, camera


def _too_little(options: Any, error: TooLittleMemoryError) -> str:
    """In words of the command line: the least memory that works, rounded up to what is written of it."""
    option, given = ("--memory", options.memory) if error.name == "settings.memory_limit" else ("--from-disk", options.from_disk)
    least = math.ceil(error.least / GIB * FRACTIONS) / FRACTIONS
    return f"{options.source}: {option} {given:g} is too little: {error.why}; give {option} {least:.{DIGITS}f} or more"
