"""The command `render`: a picture of each file, whole or a part of it, in one go or in stages; or of the field on a plane.

Flow: options -> Scene, Camera, Settings -> [cli_render] -> EXR or PNG, lines of text.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import jaxsph
from jaxsph.analysis import slices
from jaxsph.cli import disk as cli_disk
from jaxsph.cli import look as cli_look
from jaxsph.cli import merge as cli_merge
from jaxsph.cli import scene as cli_scene
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import (
    IMAGES,
    UsageError,
    camera_line,
    error_line,
    progress,
    refuse,
    require_writable,
    say,
    span,
    tell_if_unseen,
    time_line,
    wrong_usage,
)
from jaxsph.cli.options import devices_of, replaced, settings_of, stem_of
from jaxsph.engine.frame.progressive import progressive
from jaxsph.io.images.slices import SUFFIXES
from jaxsph.model import Camera, Image, Scene, Settings
from jaxsph.model.clips.shapes import Plane
from jaxsph.scale import parts as tiles

NAME = "{}"
"""What stands in OUT for the name of a file."""
NOT_OF_SLICES = (
    *("annotate", "eye", "target", "fov", "integrator", "tolerance", "estimator", "screen", "progressive", "relax"),
    "samples",
    *("opacity", "opacity_by", "memory", "devices", "from_disk", "volume", "points", "mix", "iso"),
)
"""Options that do nothing to the picture of a plane."""


def run(options: argparse.Namespace) -> None:
    """A picture of each source that is given, or of the parts that stand for it."""
    render_each(options, _render)


def render_each(options: argparse.Namespace, render: Callable[[argparse.Namespace], None]) -> None:
    """Render each of `options.source`; one that fails keeps none of the others from being done.

    Raises:
        UsageError: OUT is not for several files, or two files have the same name.
        RuntimeError: some failed; the message says which, and why.
    """
    sources = options.source
    if len(sources) < 2:
        render(replaced(options, source=sources[0] if sources else None))
        return
    outputs, failed = outputs_of(sources, options.output), []
    for nth, (source, output) in enumerate(zip(sources, outputs, strict=True), 1):
        say("", f"{nth} of {len(sources)}: {source}")
        output.parent.mkdir(parents=True, exist_ok=True)
        try:
            render(replaced(options, source=source, output=output))
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


def _render(options: argparse.Namespace) -> None:
    """One picture."""
    settings, devices = settings_of(options), devices_of(options)
    options = cli_where.settled(options)
    plane = _plane_of_slice(options)
    if options.progressive and options.screen == "pixels":
        raise UsageError("--progressive casts rays by a quadtree; leave out --screen pixels")
    cli_scene.require_something(options)
    first = options.source or (options.volume or options.points)[0]
    output = options.output or Path(stem_of(first) + cli_merge.suffix(options))
    require_writable(output, "an image must be", IMAGES if plane is None else SUFFIXES)
    cli_look.check_key(options, output)
    cli_merge.check_tile(options, settings, output)
    if options.from_disk is not None:
        cli_disk.render(options, settings).save(output)
        say("image", str(output))
        return
    scene, camera, labels = cli_scene.scene_of(options)
    scene = dataclasses.replace(scene, within=cli_where.clip_of(options))
    if plane is not None:
        _save_slice(scene, plane, camera, options, output)
        return
    say("camera", camera_line(camera, options))
    started = time.perf_counter()
    if options.progressive:
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
    image = dataclasses.replace(image, metadata=(*image.metadata, *cli_where.left_out(options)))
    if options.annotate:
        cli_look.save_with_key(image, scene, camera, labels, options, output)
    else:
        image.save(output)
    say("image", f"{output}, {camera.width} x {camera.height}, {settings.samples} samples a ray")
    if settings.tolerance is not None:
        say("error", f"{error_line(image, settings, options.progressive)}, tolerance {settings.tolerance:g}")
    say("time", time_line(image, elapsed))
    if options.tile is None and (scene.particles is None or scene.particles.num_particles):
        tell_if_unseen(options.command, output, [image.color])


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


def _plane_of_slice(options: argparse.Namespace) -> Plane | None:
    """The plane of `--slice`, beside which options that do nothing are refused: a slice looks straight at its plane."""
    if options.slice is None:
        return None
    with wrong_usage("--slice: "):
        plane = cli_where.plane(options.slice)
    refuse(options, NOT_OF_SLICES, "and --slice exclude each other: a slice casts no rays; leave one out")
    return plane


def _save_slice(scene: Scene, plane: Plane, camera: Camera, options: argparse.Namespace, output: Path) -> None:
    """Make the picture of `--slice`."""
    particles, started = scene.particles, time.perf_counter()
    assert particles is not None
    size = {"width": camera.width, "height": camera.height}
    made = slices.slice(particles, plane, within=scene.within, up=options.up, **size)
    there = np.isfinite(made.values)
    if not there.any():
        ends = cli_where.ends_of(*particles.bounds())
        raise ValueError(f"no particle reaches the plane of --slice; there are particles {ends}")
    made = dataclasses.replace(made, metadata=(*made.metadata, *cli_where.left_out(options)))
    made.save(output, scene.transfer)
    say("slice", f"{span(made.values[there])}, {there.mean():.1%} of the pixels inside of supports")
    say("image", f"{output}, {camera.width} x {camera.height}, {made.pixel_size:.6g} a pixel")
    say("time", f"{time.perf_counter() - started:.2f} s")
