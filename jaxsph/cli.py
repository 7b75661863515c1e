"""Command line: a picture from a file of particles or of a volume in one command.

Flow: file or scene -> [cli] -> render -> EXR or PNG.

Exit codes: 0 done, 1 the work failed, 2 wrong usage; one line on stderr says why.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

import jaxsph
from jaxsph import cli_cache, cli_sweep, cli_volume, io, scenes
from jaxsph.cli_progressive import render_in_stages
from jaxsph.console import camera_line, largest, largest_difference, progress, ranges, say, span, time_line
from jaxsph.model import Camera, Particles, Scene, Settings, Volume
from jaxsph.scenes.view import snug, snug_box

SCENE = "scene:"
IMAGE_SUFFIXES = (".exr", ".png")
DONE, FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130
DEMO_TOLERANCE = 0.004
DEMO_CHECK = 64
"""Rows and columns of pixels, about, that `demo` compares with the float64 reference."""


class UsageError(Exception):
    """The command line asks for something that makes no sense."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the result is the exit code.

    Args:
        arguments: those of the process if not given. Only then are compiled programs kept for other processes, as a caller
            may have set up JAX otherwise.
    """
    try:
        options = _parser().parse_args(arguments)
    except SystemExit as stop:  # --help, --version and what argparse refuses
        return int(stop.code or DONE)
    try:
        if arguments is None:
            cli_cache.begin(keep=not options.no_cache)
        options.run(options)
    except KeyboardInterrupt:
        return _failed(options, "interrupted", INTERRUPTED)
    except BrokenPipeError:  # the reader of our output went away, as in `jaxsph info FILE | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except UsageError as error:
        return _failed(options, f"{error} (see `jaxsph {options.command} --help`)", WRONG_USAGE)
    except Exception as error:
        return _failed(options, _reason(error), FAILED)
    return DONE


def _failed(options: argparse.Namespace, reason: str, code: int) -> int:
    if options.debug:
        import traceback

        traceback.print_exc()
    print(f"jaxsph {options.command}: {' '.join(reason.split())}", file=sys.stderr)
    return code


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror or type(error).__name__}"
    if isinstance(error, MemoryError):
        return f"out of memory ({error}); try a smaller --size, fewer --samples or a lower --memory"
    if isinstance(error, ValueError | OSError | ImportError | RuntimeError):
        return str(error) or type(error).__name__
    return f"unexpected {type(error).__name__}: {error}; --debug shows where"


class _Parser(argparse.ArgumentParser):
    """argparse, with its errors in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(WRONG_USAGE, f"{self.prog}: {message} (see `{self.prog} --help`)\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="jaxsph", description="Render SPH particles as a volume.")
    parser.add_argument("--version", action="version", version=f"jaxsph {jaxsph.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    common = _Parser(add_help=False)
    common.add_argument("--debug", action="store_true", help="show where an error comes from")
    common.add_argument("--no-cache", action="store_true", help="keep no compiled programs for the next command")

    def command(name: str, run: Callable[[argparse.Namespace], None], text: str, more: str) -> argparse.ArgumentParser:
        made = commands.add_parser(name, parents=[common], help=text, description=f"{text[0].upper()}{text[1:]}. {more}")
        made.set_defaults(run=run)
        return made

    render = command("render", _render, "make an image", "What you do not say is chosen, and said.")
    render.epilog = f"Built-in scenes: {', '.join(SCENE + name for name in scenes.names())}."
    _add_source(render)
    render.add_argument("-o", "--output", type=Path, metavar="OUT", help=".exr or .png (default: named after FILE, here)")
    _add_picture(render)
    _add_control(render)
    info = command("info", _info, "say what a file holds", "And what `render` would show of it.")
    _add_source(info, optional=True)
    info.add_argument("--cache", action="store_true", help="say where compiled programs are kept, and how large they are")
    more = "Appends to DIR/sweep.jsonl what it does not hold yet, and writes sweep.csv and figures."
    sweep = command("sweep", _sweep, "measure error against tolerance against time", more)
    _add_source(sweep)
    _add_picture(sweep)
    cli_sweep.add_options(sweep)
    demo = command("demo", _demo, "render a built-in scene and measure its error", "Writes an EXR and a PNG.")
    add = demo.add_argument
    add("-o", "--output", type=Path, default=Path("demo"), metavar="STEM", help="path without suffix (default: demo)")
    add("--size", type=_size, default=(512, 512), metavar="WxH", help="pixels (default 512x512)")
    return parser


def _add_source(parser: argparse.ArgumentParser, *, optional: bool = False) -> None:
    number: dict[str, Any] = {"nargs": "?"} if optional else {}
    parser.add_argument("source", metavar="FILE|scene:NAME", help="file of particles or of a volume, or built-in scene", **number)
    add = parser.add_argument_group("particles of a file").add_argument
    add("--quantity", metavar="NAME", help="an attribute, density, speed, x, y, z, or log10:NAME of any of these")
    add("--support", type=float, metavar="H", help="support radius (default: the file's, or from neighbours)")
    add("--kernel", choices=("poly6", "cubic_spline", "wendland_c2"), help="smoothing kernel (default poly6)")
    add("--part-type", type=int, metavar="N", help="of a Gadget-like file (default: gas, else the first)")
    add = parser.add_argument_group("volume of a file").add_argument
    add("--iso", type=float, metavar="LEVEL", help="show the surface on which its values are LEVEL (--quantity: which values)")
    add = parser.add_argument_group("particles of a built-in scene").add_argument
    add("--particles", type=int, metavar="N", help="how many")
    add("--frame", type=float, metavar="K", help="moment of the scene")


def _add_picture(parser: argparse.ArgumentParser) -> None:
    maps, depth = ", ".join(scenes.appearance.COLORMAPS), scenes.appearance.OPTICAL_DEPTH
    add = parser.add_argument_group("picture").add_argument
    add("--size", type=_size, default=(512, 512), metavar="WxH", help="pixels (default 512x512)")
    add("--samples", type=int, default=256, metavar="N", help="samples along a ray (default 256)")
    add("--colormap", metavar="NAME", help=f"{maps}, or any of matplotlib's (default viridis)")
    add(
        "--range",
        nargs=2,
        type=float,
        metavar=("LOW", "HIGH"),
        help="values that the colours span (default: nearly all)",
    )
    add("--opacity", type=float, metavar="DEPTH", help=f"typical optical depth (default {depth:g})")
    add = parser.add_argument_group("camera", "default: one that frames the particles").add_argument
    place: dict[str, Any] = {"nargs": 3, "type": float, "metavar": ("X", "Y", "Z")}
    add("--eye", **place, help="where the eye is")
    add("--target", **place, help="what it looks at (default: the middle of the particles)")
    add("--up", **place, help="upward direction (default 0 1 0)")
    add("--fov", type=float, metavar="DEG", help="vertical field of view (default 45)")
    add = parser.add_argument_group("means").add_argument
    add("--memory", type=float, metavar="GIB", help="working memory (default 4)")


def _add_control(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument_group("error control").add_argument
    add("--tolerance", type=float, metavar="T", help="largest error of any channel of any pixel (default: none)")
    add("--estimator", choices=("interval", "pilot"), help="how the error is known")
    add("--screen", choices=("pixels", "quadtree"), help="whether pixels are interpolated where the tolerance allows it")
    add("--progressive", action="store_true", help="by a quadtree, in stages: OUT is rewritten at each")
    add("--relax", type=float, metavar="R", help="0 is certified, 1 takes neighbouring rays for alike")


def _size(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    try:
        width, height = (int(part) for part in (parts if len(parts) == 2 else parts * 2))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; write it as 640x480") from None
    if len(parts) > 2 or width < 1 or height < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a size; both edges must be at least 1 pixel, as in 640x480")
    return width, height


def _render(options: argparse.Namespace) -> None:
    settings = _settings(options)
    if options.progressive and options.screen == "pixels":
        raise UsageError("--progressive casts rays by a quadtree; leave out --screen pixels")
    output = options.output or Path(Path(options.source.removeprefix(SCENE)).stem + ".png")
    _require_writable(output)
    scene, camera = _scene(options)
    say("camera", camera_line(camera))
    started = time.perf_counter()
    if options.progressive:
        image = render_in_stages(scene, camera, settings, output)
    else:
        with progress("render") as show:
            image = jaxsph.render(scene, camera, settings, progress=show)
    elapsed = time.perf_counter() - started
    image.save(output)
    say("image", f"{output}, {camera.width} x {camera.height}, {settings.samples} samples a ray")
    if settings.tolerance is not None:
        known = "certified" if image.certified else "estimated"
        say("error", f"at most {largest(image.error_bound):.2g} ({known}), tolerance {settings.tolerance:g}")
    say("time", time_line(image, elapsed))


def _sweep(options: argparse.Namespace) -> None:
    settings = _settings(options)
    if options.frames is not None and options.frame is not None:
        raise UsageError("--frame and --frames exclude each other; name all moments after --frames")
    if options.frames is not None and len(set(options.frames)) < len(options.frames):
        raise UsageError(f"--frames must be different numbers, got {' '.join(f'{moment:g}' for moment in options.frames)}")
    views = []
    for moment in options.frames or [options.frame]:
        options.frame = moment
        views.append((moment, *_scene(options)))
    cli_sweep.run(views, settings, Path(options.source.removeprefix(SCENE)).stem, options)


def _settings(options: argparse.Namespace) -> Settings:
    """Settings from the options given; what this version's `Settings` does not know, or refuses, is wrong usage."""
    if options.memory is not None and not 0 < options.memory < 2**30:
        raise UsageError(f"--memory must be a positive number of GiB, got {options.memory:g}")
    given = {
        "samples": options.samples,
        **{name: getattr(options, name, None) for name in ("tolerance", "estimator", "relax", "screen")},
        "memory_limit": None if options.memory is None else int(options.memory * 2**30),
    }
    given = {name: value for name, value in given.items() if value is not None}
    missing = sorted(set(given) - {field.name for field in dataclasses.fields(Settings)})
    if missing:
        raise UsageError(f"--{missing[0]} is not available in this version")
    try:
        return Settings(**given)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _scene(options: argparse.Namespace) -> tuple[Scene, Camera]:
    return _scene_of_name(options) if options.source.startswith(SCENE) else _scene_of_file(options)


def _scene_of_name(options: argparse.Namespace) -> tuple[Scene, Camera]:
    _refuse(options, ("quantity", "support", "kernel", "part_type", "iso"), "is for particle files, not for built-in scenes")
    name = options.source.removeprefix(SCENE)
    width, height = getattr(options, "size", (512, 512))
    try:
        scene, camera = scenes.load(name, options.particles, options.frame, width=width, height=height)
    except ValueError as error:
        raise UsageError(str(error)) from error
    particles = scene.particle_set
    say("scene", f"{name}, {particles.num_particles:,} particles, support {span(particles.to_numpy()['support'])}")
    if options.command != "info":
        if any(value is not None for value in (options.colormap, options.range, options.opacity)):
            scene = dataclasses.replace(scene, transfer=_transfer(particles, options, "concentration"))
        if any(getattr(options, part) is not None for part in ("eye", "target", "up", "fov")):
            camera = _camera(particles, options)
    return scene, camera


def _scene_of_file(options: argparse.Namespace) -> tuple[Scene, Camera]:
    _refuse(options, ("particles", "frame"), "is for built-in scenes, not for files")
    if io.is_volume(options.source):
        _refuse(options, ("support", "kernel", "part_type"), "is for particles, and this is a volume")
        return cli_volume.scene_of(options, _camera)
    _refuse(options, ("iso",), "is for volumes, and this is a particle file")
    if options.support is not None and not (np.isfinite(options.support) and options.support > 0):
        raise UsageError(f"--support must be > 0, got {options.support:g}")
    particles, quantity = _particles_of_file(options)
    return Scene(particles=particles, transfer=_transfer(particles, options, quantity)), _camera(particles, options)


def _particles_of_file(options: argparse.Namespace) -> tuple[Particles, str]:
    table = io.read_table(options.source, part_type=options.part_type, progress=sys.stderr.isatty())
    say("file", f"{options.source}: {table.source}, {len(table):,} particles")
    particles, report = io.particles_from_table(table, options.quantity, options.support, options.kernel or "poly6")
    columns = particles.to_numpy()
    say("support", f"{span(columns['support'])}: {report.support}")
    say("volume", report.volume)
    say("quantity", f"{report.quantity}, {span(columns['quantity'])}")
    for note in report.notes:
        say("note", note)
    return particles, report.quantity


def _transfer(particles: Particles, options: argparse.Namespace, quantity: str) -> Any:
    name = options.colormap or "viridis"
    depth = scenes.appearance.OPTICAL_DEPTH if options.opacity is None else options.opacity
    try:
        transfer = scenes.default_transfer(particles, name, options.range, depth)
    except ValueError as error:
        raise UsageError(str(error)) from error
    colors, extinction = f"{name} over {quantity} = {span(transfer.values)}", span(transfer.extinction)
    say("colours", f"{colors}, extinction {extinction} per unit length")
    return transfer


def _camera(particles: Particles | Volume, options: argparse.Namespace) -> Camera:
    """The camera asked for; where only a part is given, the rest frames the particles or the volume."""
    width, height = options.size
    up, fov = options.up or (0.0, 1.0, 0.0), 45.0 if options.fov is None else options.fov
    if options.target is not None and options.eye is None:
        raise UsageError("--target needs --eye: from where should it be looked at?")
    try:
        if options.eye is None:
            return Camera.framing(particles, up=up, fov_degrees=fov, width=width, height=height)
        lower, upper = particles.bounds()
        target = (lower + upper) / 2 if options.target is None else options.target
        made = Camera.look_at(options.eye, target, up, fov, width, height, near=1e-3, far=1.0)
        return snug_box(made, lower, upper) if isinstance(particles, Volume) else snug(made, particles)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _info(options: argparse.Namespace) -> None:
    if options.cache:
        for what, text in cli_cache.described():
            say(what, text)
        if options.source is None:
            return
    if options.source is None:
        raise UsageError("a particle file or scene:NAME is needed, or --cache")
    if options.source.startswith(SCENE):
        scene, camera = _scene_of_name(options)
        say("quantity", f"concentration, {span(scene.particle_set.to_numpy()['quantity'])}")
        say("camera", camera_line(camera))
        return
    _refuse(options, ("particles", "frame"), "is for built-in scenes, not for files")
    if io.is_volume(options.source):
        cli_volume.describe(options)
        return
    table = io.read_table(options.source, part_type=options.part_type, progress=sys.stderr.isatty())
    print(f"{options.source}: {table.source}, {len(table):,} particles")
    for sentence in table.conventions:
        print(f"  {sentence}")
    print()
    rows = [("attribute", "shape", "type", "range")]
    for name, column in (("position", table.position), *table.columns.items()):
        rows.append((name, " x ".join(map(str, column.shape)), str(column.dtype), ranges(column)))
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    for row in rows:
        print("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, (*widths, 0), strict=True)).rstrip())
    print("\n`jaxsph render` would show")
    particles, report = io.particles_from_table(table, options.quantity, options.support, options.kernel or "poly6")
    columns = particles.to_numpy()
    say("quantity", f"{report.quantity}, {span(columns['quantity'])}")
    say("support", f"{span(columns['support'])}: {report.support}")
    say("volume", report.volume)
    say("camera", camera_line(Camera.framing(particles)))


def _demo(options: argparse.Namespace) -> None:
    width, height = options.size
    outputs = [Path(f"{options.output}{suffix}") for suffix in IMAGE_SUFFIXES]
    for output in outputs:
        _require_writable(output)
    scene, camera = scenes.load("mixer", width=width, height=height)
    settings = Settings(tolerance=DEMO_TOLERANCE)
    exact = dataclasses.replace(settings, tolerance=None)
    every = max(min(width, height) // DEMO_CHECK, 1)
    with ThreadPoolExecutor(1) as beside, progress("render") as show:  # NumPy has time while XLA compiles
        truth_of = beside.submit(jaxsph.reference.render, scene, camera, exact, every=every)
        started = time.perf_counter()
        image = jaxsph.render(scene, camera, settings, progress=show)
        elapsed = time.perf_counter() - started
    for output in outputs:
        image.save(output)
    full = jaxsph.render(scene, camera, exact)
    error = largest_difference(image, full)
    truth, some = truth_of.result(), slice(every // 2, None, every)
    seen = dataclasses.replace(full, color=full.color[some, some], transmittance=full.transmittance[some, some])
    rounding = largest_difference(seen, truth)
    say("scene", f"mixer, {scene.particle_set.num_particles:,} particles")
    for output in outputs:
        say("image", str(output.resolve()))
    say("tolerance", f"{DEMO_TOLERANCE:g}, certified: no pixel can be off by more than {largest(image.error_bound):.2g}")
    say("error", f"{error:.2g}, the largest against full sampling")
    say("", f"{rounding:.2g} of full sampling against float64 brute force at {truth.shape[1]} x {truth.shape[0]} of its pixels")
    say("time", time_line(image, elapsed))


def _refuse(options: argparse.Namespace, names: Sequence[str], why: str) -> None:
    for name in names:
        if getattr(options, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} {why}")


def _require_writable(path: Path) -> None:
    """Know before the work that the image can be written after it."""
    if path.suffix.lower() not in IMAGE_SUFFIXES:
        raise UsageError(f"{path}: an image must be .exr or .png")
    folder = path.parent
    if not folder.is_dir():
        raise ValueError(f"{path}: there is no folder {folder} to write it to; make it first")
    if path.is_dir() or not os.access(folder, os.W_OK):
        raise ValueError(f"{path}: cannot be written; choose another place with -o")
