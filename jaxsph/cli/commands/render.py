"""The command `render`: a picture of each file, whole or a part of it, in one go or in stages.

Flow: options -> Scene, Camera, Settings -> [render] -> EXR or PNG, its path on stdout, prose on stderr.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

import jaxsph
from jaxsph.cli import look as cli_look
from jaxsph.cli import scene as cli_scene
from jaxsph.cli import voice
from jaxsph.cli import where as cli_where
from jaxsph.cli.commands import merge
from jaxsph.cli.console import (
    IMAGES,
    UsageError,
    camera_line,
    error_line,
    largest,
    progress,
    refuse,
    require_writable,
    span,
    tell_if_unseen,
    time_line,
)
from jaxsph.cli.options import groups, values, words
from jaxsph.cli.options.groups import MEANS, OUTPUT, QUALITY, flag, option, output
from jaxsph.cli.options.settings import SCENE, SETTINGS, as_medium, devices_of, settings_of, stem_of
from jaxsph.cli.voice import say
from jaxsph.engine.frame.progressive import progressive
from jaxsph.io.disk.index import index_path
from jaxsph.io.images.image_files import write_image
from jaxsph.model import Image, Scene, Settings
from jaxsph.model.camera.camera import Camera
from jaxsph.scale import parts as tiles
from jaxsph.scale.from_disk import TooLittleMemoryError, render_from_disk
from jaxsph.scale.on_disk import OnDisk

NAME = "{}"
"""What stands in OUT for the name of a file."""
WHERE = ".exr or .png; of several files a folder, or a name with {} in it (default: after FILE, here)"
DIGITS = 4
FRACTIONS = 10**DIGITS
"""Of a GiB, to which memory is named."""
OTHERS = ("volume", "points", "iso", "support", "where", "share", "center", "width", "clip")
"""Options of what cannot be rendered part by part."""
OF_SURFACE = "surfaces of particles are in their place to rounding; what is thinner than a sample may be missed, see --samples"
SEEN = 0.013, 0.065
"""99.9 % errors of 256 point samples against the light integral, over the built-in scenes (`benchmarks/truth.py`)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Render(groups.Options, groups.Draft, groups.Key, groups.SurfaceLook, groups.View, groups.Mixed, groups.Source):
    """Options of the command."""

    output: Annotated[Path | None, output(WHERE)] = None
    background: Annotated[
        str | None,
        option("--background", "COLOR", values.background, OUTPUT, "white, #rrggbb, R,G,B, or transparent (default black)"),
    ] = None
    annotate: Annotated[bool, flag("--annotate", OUTPUT, "with colour bar, scale bar, axes, outline and time (a .png)")] = False
    progressive: Annotated[bool, flag("--progressive", QUALITY, "by a quadtree, in stages: OUT is rewritten at each")] = False
    devices: Annotated[
        Any, option("--devices", "all|N", values.devices, MEANS, "share the picture among devices (default: one)")
    ] = None
    tile: Annotated[
        Any,
        option("--tile", "I/N", values.tile, MEANS, "part I of N alone, as EXR; `jaxsph merge` puts parts together"),
    ] = None
    from_disk: Annotated[
        float | None,
        option("--from-disk", "GIB", values.memory, MEANS, "leave a Gadget-like HDF5 snapshot on disk, and read so much at once"),
    ] = None


def render(
    *files: Annotated[str, Parameter(help="files of particles or of volumes, or scene:NAME[:particles=N,frame=K]")],
    asked: Render = Render(),
) -> None:
    """Make a picture of each source that is given, or of the parts that stand for it."""
    render_each(dataclasses.replace(asked, source=list(files)), _render)


def render_each(options: Any, render: Callable[[Any], None]) -> None:
    """Render each of `options.source`; one that fails keeps none of the others from being done.

    Raises:
        UsageError: OUT is not for several files, or two files have the same name.
        RuntimeError: some failed; the message says which, and why.
    """
    sources = options.source
    if len(sources) < 2:
        render(dataclasses.replace(options, source=sources[0] if sources else None))
        return
    outputs, failed = outputs_of(sources, options.output), []
    voice.release()
    for nth, (source, place) in enumerate(zip(sources, outputs, strict=True), 1):
        say("", f"{nth} of {len(sources)}: {source}")
        place.parent.mkdir(parents=True, exist_ok=True)
        try:
            render(dataclasses.replace(options, source=source, output=place))
        except (ValueError, OSError, RuntimeError) as error:
            failed.append(f"{source}: {error}")
            say("failed", str(error))
    if failed:
        raise RuntimeError(f"{len(failed)} of {len(sources)} failed: {'; '.join(failed)}")


def outputs_of(sources: Sequence[str], output: Path | None) -> list[Path]:
    """Where the picture of each goes: into a folder, or by a name with `{}` in it; here without."""
    names = [stem_of(source) for source in sources]
    if len(set(names)) < len(names):  # equal names in two folders
        names = [f"{Path(source).parent.name}_{name}".strip("_") for source, name in zip(sources, names, strict=True)]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UsageError(f"two pictures would be called {twice}: render these files one by one, with -o")
    if output is None:
        return [Path(f"{name}.png") for name in names]
    if NAME in output.name:
        return [output.with_name(output.name.replace(NAME, name)) for name in names]
    if output.suffix.lower() in IMAGES:
        raise UsageError(f"-o {output} is one picture, but there are {len(sources)}; give a folder, or a name with {{}} in it")
    return [output / f"{name}.png" for name in names]


def _render(options: Any) -> None:
    """One picture."""
    settings, devices = settings_of(options), devices_of(options)
    if options.progressive and options.screen == "pixels":
        raise UsageError("--progressive casts rays by a quadtree; leave out --screen pixels")
    cli_scene.require_something(options)
    first = options.source or (options.volume or options.points)[0].file
    output = options.output or Path(stem_of(first) + merge.suffix(options))
    require_writable(output, "an image must be", IMAGES)
    cli_look.check_key(options, output)
    merge.check_tile(options, settings, output)
    _check_background(options, output)
    if options.from_disk is not None:
        refuse(options, ("surface", "surface_of"), "is for particles that are in memory; leave out --from-disk")
        image, camera = _from_disk(options, settings)
        image = dataclasses.replace(image, metadata=(*image.metadata, words.header("render", options.words, part=False)))
        _save(image, options, output)
        _say_written(output, image, camera, settings, options)
        tell_if_unseen(options.command, output, [image.color])
        return
    scene, camera, labels = cli_scene.scene_of(as_medium(options, settings))
    say("camera", camera_line(camera, options))
    started = time.perf_counter()
    if options.progressive:
        voice.release()
        image = _in_stages(scene, camera, settings, output)
    else:
        with progress("render") as show:
            if options.tile is None:
                image = jaxsph.render(scene, camera, settings, progress=show, devices=devices)
            else:
                image = tiles.render_tile(scene, camera, settings, *options.tile, progress=show)
                first_row = dict(image.metadata)[tiles.FIRST_ROW]
                say("part", f"{options.tile}, rows {first_row} to {first_row + image.shape[0] - 1} of {camera.height}")
    elapsed = time.perf_counter() - started
    told = words.header("render", options.words, part=options.tile is not None)
    image = dataclasses.replace(image, metadata=(*image.metadata, *cli_where.left_out(options), told))
    if cli_look.has_key(options):
        cli_look.save_with_key(_over(image, options), scene, camera, labels, options, output)
    else:
        _save(image, options, output)
    say("image", f"{output}, {camera.width} x {camera.height}, {settings.samples} samples a ray")
    say("error", OF_SURFACE if scene.surface is not None else _how_wrong(image, settings))
    say("time", time_line(image, elapsed))
    _say_written(output, image, camera, settings, options)
    if options.tile is None and (scene.particles is None or scene.particles.num_particles):
        tell_if_unseen(options.command, output, [image.color])


def _from_disk(options: Any, settings: Settings) -> tuple[Image, Camera]:
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
    name, quantity = on_disk.quantities[0], np.asarray(on_disk.sample.quantity)[np.asarray(on_disk.sample.valid)]
    say("quantity", f"{name}, {span(quantity)} of a sample of {len(quantity):,}")
    if len(on_disk.quantities) > 1:
        say("opacity", f"by {on_disk.quantities[1]}")
    transfer = cli_look.look(on_disk.sample, options, name)
    camera = cli_where.camera_of(on_disk, cli_where.upward(options))
    say("camera", camera_line(camera))
    started = time.perf_counter()
    try:
        with progress("render", " panes") as show:
            memory = int(options.from_disk * values.GIB)
            image = render_from_disk(on_disk, transfer, camera, settings, memory=memory, progress=show)
    except TooLittleMemoryError as error:
        raise ValueError(_too_little(options, error)) from error
    say("panes", f"{image.stats['panes']}, of at most {image.stats['most_particles']:,} particles")
    say("time", time_line(image, time.perf_counter() - started))
    return image, camera


def _too_little(options: Any, error: TooLittleMemoryError) -> str:
    """In words of the command line: memory that should do, rounded up to what is written of it."""
    option, given = ("--memory", options.memory) if error.name == "settings.memory_limit" else ("--from-disk", options.from_disk)
    least = math.ceil(error.least / values.GIB * FRACTIONS) / FRACTIONS
    return f"{options.source}: {option} {given:g} is too little: {error.why}; give {option} {least:.{DIGITS}f} or more"


def _how_wrong(image: Image, settings: Settings) -> str:
    """What is known of the picture's error."""
    if settings.tolerance is not None:
        return f"{error_line(image, settings)}, tolerance {settings.tolerance:g}"
    remedy = "--tolerance 0.01 keeps and tells it"
    if settings.integrator_used != "samples" or settings.samples != Settings().samples:
        return f"not estimated; {remedy}"
    low, high = SEEN
    return f"not estimated: of built-in scenes one pixel in a thousand is off by {low:g} to {high:g} with these samples; {remedy}"


def _say_written(output: Path, image: Image, camera: Camera, settings: Settings, options: Any) -> None:
    """The path on stdout, and what a program wants to know."""
    voice.written(
        output,
        camera=camera_line(camera, options),
        size=[camera.width, camera.height],
        settings={name: getattr(settings, name) for name in SETTINGS} | {"integrator": settings.integrator_used},
        stats={name: value for name, value in image.stats.items() if name != "seconds"},
        seconds=image.stats.get("seconds", {}),
        error={"bound": largest(image.error_bound), "certified": bool(image.certified)},
    )


def _check_background(options: Any, output: Path) -> None:
    """Refuse what a format cannot hold."""
    if options.background not in (None, "transparent") and output.suffix.lower() == ".exr":
        raise UsageError(
            f"--background {options.background} is for .png; EXR holds alpha, over which any background can be put: leave it out"
        )
    if options.background is not None and options.progressive:
        raise UsageError("--background is put behind the finished picture; leave out --progressive")


def _over(image: Image, options: Any) -> Image:
    """The picture in front of its background."""
    if options.background in (None, "transparent"):
        return image
    color: Any = image.over(options.background)
    return dataclasses.replace(image, color=color, transmittance=image.transmittance * 0)


def _save(image: Image, options: Any, output: Path) -> None:
    """Write the picture, in front of its background or none."""
    if output.suffix.lower() == ".exr" or options.background is None:
        image.save(output)
    else:
        write_image(output, image, background=options.background)


def _in_stages(scene: Scene, camera: Camera, settings: Settings, output: Path) -> Image:
    """The last image; `output` is rewritten at each stage, whole or not at all, and keeps the last when interrupted."""
    shown: Image | None = None
    try:
        for image in progressive(scene, camera, settings):
            image.save(output)
            shown, stats = image, image.stats
            errors = f"estimated error {stats['max_error']:.2g} at most, {100 * stats['l2_error']:.2g} % in L2"
            rays = f"{stats['rays']:,} rays cast, {stats['rays_left']:,} left at most"
            say(f"stage {stats['stage']}", f"{errors}; {rays}; {sum(stats['seconds'].values()):.2f} s")
    except KeyboardInterrupt:
        if shown is not None:
            say("stopped", f"{output} holds stage {shown.stats['stage']}")
        raise
    assert shown is not None
    return shown
