"""Command line: a picture from files of particles, volumes and points in one command.

Flow: file or scene -> [cli] -> render -> EXR or PNG.

Exit codes: 0 done, 1 the work failed, 2 wrong usage, 130 interrupted (SIGINT), 143 asked to end (SIGTERM); one line on stderr
says why.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

import jaxsph
from jaxsph import scenes
from jaxsph.cli import cache as cli_cache
from jaxsph.cli import disk as cli_disk
from jaxsph.cli import look as cli_look
from jaxsph.cli import merge as cli_merge
from jaxsph.cli import movie as cli_movie
from jaxsph.cli import options as cli_options
from jaxsph.cli import parts as cli_parts
from jaxsph.cli import project as cli_project
from jaxsph.cli import render as cli_render
from jaxsph.cli import scene as cli_scene
from jaxsph.cli import sweep as cli_sweep
from jaxsph.cli import where as cli_where
from jaxsph.cli.console import (
    IMAGES,
    UsageError,
    by_option,
    camera_line,
    largest,
    progress,
    refuse,
    require_writable,
    say,
    time_line,
    warnings_in_lines,
)
from jaxsph.model import Camera, Settings
from jaxsph.model.camera.camera import BoundingBox
from jaxsph.trade.contenders import layers_of

DONE, FAILED, WRONG_USAGE, INTERRUPTED, TERMINATED = 0, 1, 2, 130, 143
AGAIN_SECONDS = 0.02
DEMO_TOLERANCE = 0.004
DEMO_CHECK = 64
"""Rows and columns of pixels, about, that `demo` compares with the float64 reference."""


class _Terminated(KeyboardInterrupt):
    """The process is asked to end, by a scheduler of jobs perhaps: all that an interrupt tidies up is tidied up."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; the result is the exit code.

    Args:
        arguments: those of the process if not given. Only then are compiled programs kept for other processes, and SIGTERM
            heard, as a caller may have set up JAX and signals otherwise.
    """
    try:
        options, unknown = _parser().parse_known_args(arguments)
    except SystemExit as stop:  # --help, --version and what argparse refuses
        return int(stop.code or DONE)
    try:
        if unknown:
            raise UsageError(f"unrecognized arguments: {' '.join(unknown)}")
        with _ending_in_order(arguments is None):
            if arguments is None:
                cli_cache.begin(keep=not options.no_cache)
            with warnings_in_lines(options.command, cli_cache.mended):
                options.run(options)
    except _Terminated:
        return _failed(options, "terminated", TERMINATED)
    except KeyboardInterrupt:
        return _failed(options, "interrupted", INTERRUPTED)
    except BrokenPipeError:  # the reader of our output went away, as in `jaxsph info FILE | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except UsageError as error:
        return _failed(options, f"{by_option(str(error))} (see `jaxsph {options.command} --help`)", WRONG_USAGE)
    except Exception as error:
        return _failed(options, _reason(error), FAILED)
    return DONE


@contextlib.contextmanager
def _ending_in_order(own_process: bool) -> Iterator[None]:
    """Have SIGTERM raise in the block, as SIGINT does; not where it is ignored, or is somebody else's to handle."""

    def end(*_: object) -> None:
        raise _Terminated

    def lost(told: Any) -> None:  # what is raised while an object is thrown away goes no further: ask again
        if not isinstance(told.exc_value, _Terminated):
            before(told)
            return
        again = threading.Timer(AGAIN_SECONDS, os.kill, (os.getpid(), signal.SIGTERM))
        again.daemon = True
        asking.append(again)
        again.start()

    mine = own_process and threading.current_thread() is threading.main_thread()
    if not mine or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    asking: list[threading.Timer] = []
    before, sys.unraisablehook = sys.unraisablehook, lost
    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        try:
            for again in asking:  # what is done is not to be asked when nobody hears it any more: that would kill the process
                again.cancel()
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            sys.unraisablehook = before


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
        return by_option(str(error)) or type(error).__name__
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

    render = command("render", cli_render.run, "make an image", "What you do not say is chosen, and said.")
    render.epilog = f"Built-in scenes: {', '.join(cli_options.SCENE + name for name in scenes.names())}."
    cli_options.add_source(render, optional=True, several=True)
    _add_parts(render)
    cli_where.add_places(render)
    cli_disk.add_options(render)
    where = ".exr or .png; of several files a folder, or a name with {} in it"
    render.add_argument("-o", "--output", type=Path, metavar="OUT", help=where)
    cli_options.add_picture(render)
    cli_options.add_control(render)
    cli_look.add_looks(render)
    cli_look.add_key(render)
    cli_options.add_devices(render)
    cli_merge.add_tile(render)
    cli_merge.add_options(command("merge", cli_merge.run, "make one image of its parts", cli_merge.MORE))
    transfer = command("transfer", _transfer, "draw a transfer function over what rays meet", "FILE may be one that was saved.")
    cli_options.add_source(transfer)
    cli_options.add_picture(transfer, means=False)
    cli_look.add_looks(transfer)
    cli_look.add_command(transfer)
    info = command("info", _info, "say what a file holds", "And what `render` would show of it.")
    cli_options.add_source(info, optional=True, surface=False)
    _add_parts(info, mixed=False)
    info.add_argument("--cache", action="store_true", help="say where compiled programs are kept, and how large they are")
    cli_disk.add_sort(command("sort", cli_disk.sort, "order a snapshot in space", "So that parts of it can be read alone."))
    cli_project.add_options(
        command("project", cli_project.run, "integrate along rays: column densities, means", cli_project.MORE)
    )
    more = "Appends to DIR/sweep.jsonl what it does not hold yet, and writes sweep.csv and figures."
    sweep = command("sweep", cli_sweep.run, "measure error against tolerance against time", more)
    cli_options.add_source(sweep)
    cli_options.add_picture(sweep)
    cli_sweep.add_options(sweep)
    sweep.set_defaults(integrator="samples")  # whose full rate bounds and the pilot keep a tolerance against
    movie = command("movie", cli_movie.run, "make a movie", cli_movie.MORE)
    cli_options.add_source(movie, several=True)
    _add_parts(movie)
    cli_look.add_looks(movie)
    cli_options.add_picture(movie)
    cli_options.add_control(movie)
    cli_where.add_places(movie, slices=False)
    cli_movie.add_options(movie)
    demo = command("demo", _demo, "render a built-in scene and measure its error", "Writes an EXR and a PNG.")
    add = demo.add_argument
    add("-o", "--output", type=Path, default=Path("demo"), metavar="STEM", help="path without suffix (default: demo)")
    add("--size", type=cli_options.size, default=(512, 512), metavar="WxH", help="pixels (default 512x512)")
    return parser


def _add_parts(parser: argparse.ArgumentParser, *, mixed: bool = True) -> None:
    cli_where.add_selection(parser)
    cli_parts.add_options(parser, mixed=mixed)


def _transfer(options: argparse.Namespace) -> None:
    output = cli_look.check_figure(options)
    if Path(options.source).suffix.lower() == ".json":
        refuse(options, ("quantity", "save", *cli_look.LOOKS), "is for FILE or scene:NAME, and this is a saved function")
        cli_look.draw_file(options, output)
        return
    source = cli_scene.source_of(options)
    camera = source.camera or cli_scene.camera_of(source.shown, options)
    cli_look.draw(source.scene, camera, source.labels, options, output)


def _info(options: argparse.Namespace) -> None:
    options = cli_where.settled(options)
    if options.cache:
        for what, text in cli_cache.described():
            say(what, text)
        if options.source is None:
            return
    cli_scene.require_something(options, ", or --cache")
    parts, camera = [], None
    if options.source is not None:
        shown, camera = cli_scene.described(options)
        parts.append((options.source, shown))
    parts += [(path, cli_parts.described_volume(path, options.volume_quantity)) for path in options.volume or ()]
    parts += cli_parts.points_of(options, described=True)
    if camera is None or len(parts) > 1:
        camera = Camera.framing(BoundingBox.around(part for _, part in parts))
    say("camera", camera_line(camera))
    cli_parts.warn_apart(parts, options.command)


def _demo(options: argparse.Namespace) -> None:
    width, height = options.size
    outputs = [Path(f"{options.output}{suffix}") for suffix in IMAGES]
    for output in outputs:
        require_writable(output, "an image must be", IMAGES)
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
    error = largest(np.abs(layers_of(image) - layers_of(full)))
    truth, some = truth_of.result(), slice(every // 2, None, every)
    rounding = largest(np.abs(layers_of(full)[some, some] - layers_of(truth)))
    say("scene", f"mixer, {scene.particle_set.num_particles:,} particles")
    for output in outputs:
        say("image", str(output.resolve()))
    say("tolerance", f"{DEMO_TOLERANCE:g}, certified: no pixel can be off by more than {largest(image.error_bound):.2g}")
    say("error", f"{error:.2g}, the largest against full sampling")
    say("", f"{rounding:.2g} of full sampling against float64 brute force at {truth.shape[1]} x {truth.shape[0]} of its pixels")
    say("time", time_line(image, elapsed))
