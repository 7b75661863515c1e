"""Command line: a picture from files of particles, volumes and points in one command.

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

import jaxsph
from jaxsph import cli_cache, cli_options, cli_particles, cli_points, cli_sweep, cli_volume, cli_where, io, scenes
from jaxsph.cli_progressive import render_in_stages
from jaxsph.console import UsageError, camera_line, error_line, largest, largest_difference, progress, say, span, time_line
from jaxsph.model import Camera, Particles, Scene, Settings
from jaxsph.model.camera import Bounded
from jaxsph.scenes.view import snug, snug_box

SCENE = "scene:"
IMAGE_SUFFIXES = (".exr", ".png")
DONE, FAILED, WRONG_USAGE, INTERRUPTED = 0, 1, 2, 130
DEMO_TOLERANCE = 0.004
DEMO_CHECK = 64
"""Rows and columns of pixels, about, that `demo` compares with the float64 reference."""


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
    cli_options.add_source(render, optional=True)
    _add_parts(render)
    cli_where.add_places(render)
    render.add_argument("-o", "--output", type=Path, metavar="OUT", help=".exr or .png (default: named after FILE, here)")
    cli_options.add_picture(render)
    cli_options.add_control(render)
    info = command("info", _info, "say what a file holds", "And what `render` would show of it.")
    cli_options.add_source(info, optional=True)
    _add_parts(info)
    info.add_argument("--cache", action="store_true", help="say where compiled programs are kept, and how large they are")
    more = "Appends to DIR/sweep.jsonl what it does not hold yet, and writes sweep.csv and figures."
    sweep = command("sweep", _sweep, "measure error against tolerance against time", more)
    cli_options.add_source(sweep)
    cli_options.add_picture(sweep)
    cli_sweep.add_options(sweep)
    sweep.set_defaults(integrator="samples")  # whose full rate bounds and the pilot keep a tolerance against
    demo = command("demo", _demo, "render a built-in scene and measure its error", "Writes an EXR and a PNG.")
    add = demo.add_argument
    add("-o", "--output", type=Path, default=Path("demo"), metavar="STEM", help="path without suffix (default: demo)")
    add("--size", type=cli_options.size, default=(512, 512), metavar="WxH", help="pixels (default 512x512)")
    return parser


def _add_parts(parser: argparse.ArgumentParser) -> None:
    cli_where.add_selection(parser)
    cli_volume.add_options(parser)
    cli_points.add_options(parser)


def _render(options: argparse.Namespace) -> None:
    settings = _settings(options)
    cli_where.settle(options)
    if options.progressive and options.screen == "pixels":
        raise UsageError("--progressive casts rays by a quadtree; leave out --screen pixels")
    _require_something(options)
    first = options.source or (options.volume or options.points)[0]
    output = options.output or Path(Path(first.removeprefix(SCENE)).stem + ".png")
    _require_writable(output, cli_where.suffixes(options, IMAGE_SUFFIXES))
    scene, camera = _scene(options)
    scene = cli_where.shown(scene, options)
    if options.slice is not None:
        cli_where.save_slice(scene, camera, options, output)
        return
    say("camera", camera_line(camera))
    started = time.perf_counter()
    if options.progressive:
        image = render_in_stages(scene, camera, settings, output)
    else:
        with progress("render") as show:
            image = jaxsph.render(scene, camera, settings, progress=show)
    elapsed = time.perf_counter() - started
    image = cli_where.labelled(image, options)
    image.save(output)
    say("image", f"{output}, {camera.width} x {camera.height}, {settings.samples} samples a ray")
    if settings.tolerance is not None:
        say("error", f"{error_line(image, settings, options.progressive)}, tolerance {settings.tolerance:g}")
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
        **{name: getattr(options, name, None) for name in ("integrator", "tolerance", "estimator", "relax", "screen")},
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
    """The source, and what else shares its picture; a camera that frames all of it unless one is asked for."""
    scene, shown, camera = _source(options)
    if options.command == "sweep":
        return scene, camera or _camera(shown, options)
    volumes, points = cli_volume.beside(options), cli_points.points_of(options)
    if volumes or points or options.mix:
        scene = cli_points.with_parts(scene, volumes, [one for _, one in points], options.mix)
    if not volumes and not points:
        return scene, camera or _camera(shown, options)
    named = [] if shown is None else [(options.source, shown)]
    paths = [(path, volume) for path, (volume, _) in zip(options.volume or (), volumes, strict=True)]
    parts = cli_points.Together([*named, *paths, *points])
    cli_points.warn(parts, options.command)
    return scene, _camera(parts, options)


def _source(options: argparse.Namespace) -> tuple[Any, Any, Camera | None]:
    """Scene of the source, what there is to frame, and the camera where it has one."""
    if options.source is None:
        of_source = ("quantity", "support", "kernel", "part_type", "iso", "particles", "frame", "colormap", "range", "opacity")
        _refuse(options, (*of_source, *cli_where.OF_PARTICLES), "is for FILE or scene:NAME, and there is none")
        return None, None, None
    if options.source.startswith(SCENE):
        scene, camera = _scene_of_name(options)
        return scene, scene.particle_set, camera
    return *_scene_of_file(options), None


def _require_something(options: argparse.Namespace, also: str = "") -> None:
    cli_points.check_usage(options)
    if options.source is None and not options.points and not options.volume:
        raise UsageError(f"a particle file, a volume or scene:NAME is needed as FILE, or --points FILE, or --volume FILE{also}")


def _scene_of_name(options: argparse.Namespace) -> tuple[Scene, Camera]:
    of_files = ("quantity", "support", "kernel", "part_type", "iso", *cli_where.OF_FILES)
    _refuse(options, of_files, "is for particle files, not for built-in scenes")
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
            scene = dataclasses.replace(scene, transfer=cli_particles.transfer(particles, options, "concentration"))
        if any(getattr(options, part) is not None for part in ("eye", "target", "up", "fov")):
            camera = _camera(particles, options)
    return scene, camera


def _scene_of_file(options: argparse.Namespace) -> tuple[Scene, Bounded]:
    _refuse(options, ("particles", "frame"), "is for built-in scenes, not for files")
    if io.is_volume(options.source):
        of_particles = ("support", "kernel", "part_type", *cli_where.OF_PARTICLES)
        _refuse(options, of_particles, "is for particles, and this is a volume")
        return cli_volume.scene_of(options)
    _refuse(options, ("iso",), "is for volumes, and this is a particle file")
    return cli_particles.scene_of(options)


def _camera(shown: Bounded, options: argparse.Namespace) -> Camera:
    """The camera asked for; where only a part is given, the rest frames what there is."""
    shown = cli_where.framed(shown, options)
    width, height = options.size
    up, fov = options.up or (0.0, 1.0, 0.0), 45.0 if options.fov is None else options.fov
    if options.target is not None and options.eye is None:
        raise UsageError("--target needs --eye: from where should it be looked at?")
    try:
        if options.eye is None:
            return Camera.framing(shown, up=up, fov_degrees=fov, width=width, height=height)
        lower, upper = shown.bounds()
        target = (lower + upper) / 2 if options.target is None else options.target
        made = Camera.look_at(options.eye, target, up, fov, width, height, near=1e-3, far=1.0)
        return snug(made, shown) if isinstance(shown, Particles) else snug_box(made, lower, upper)
    except ValueError as error:
        raise UsageError(str(error)) from error


def _info(options: argparse.Namespace) -> None:
    cli_where.settle(options)
    if options.cache:
        for what, text in cli_cache.described():
            say(what, text)
        if options.source is None:
            return
    _require_something(options, ", or --cache")
    parts, camera = [], None
    if options.source is not None:
        shown, camera = _described(options)
        parts.append((options.source, shown))
    parts += [(path, cli_volume.describe(path, options.volume_quantity)) for path in options.volume or ()]
    parts += cli_points.describe(options)
    together = cli_points.Together(parts)
    say("camera", camera_line(camera if camera is not None and len(parts) == 1 else Camera.framing(together)))
    cli_points.warn(together, options.command)


def _described(options: argparse.Namespace) -> tuple[Bounded, Camera | None]:
    """Say what the source holds; what there is to frame, and its camera where it has one."""
    if options.source.startswith(SCENE):
        scene, camera = _scene_of_name(options)
        say("quantity", f"concentration, {span(scene.particle_set.to_numpy()['quantity'])}")
        return scene.particle_set, camera
    _refuse(options, ("particles", "frame"), "is for built-in scenes, not for files")
    if io.is_volume(options.source):
        return cli_volume.describe(options.source, options.quantity), None
    return cli_particles.describe(options), None


def _demo(options: argparse.Namespace) -> None:
    width, height = options.size
    outputs = [Path(f"{options.output}{suffix}") for suffix in IMAGE_SUFFIXES]
    for output in outputs:
        _require_writable(output)
    scene, camera = scenes.load("mixer", width=width, height=height)
    settings = Settings(tolerance=DEMO_TOLERANCE, integrator="samples")
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
        if getattr(options, name, None) is not None:
            raise UsageError(f"--{name.replace('_', '-')} {why}")


def _require_writable(path: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> None:
    """Know before the work that the image can be written after it."""
    if path.suffix.lower() not in suffixes:
        raise UsageError(f"{path}: an image must be {' or '.join(suffixes)}")
    folder = path.parent
    if not folder.is_dir():
        raise ValueError(f"{path}: there is no folder {folder} to write it to; make it first")
    if path.is_dir() or not os.access(folder, os.W_OK):
        raise ValueError(f"{path}: cannot be written; choose another place with -o")
