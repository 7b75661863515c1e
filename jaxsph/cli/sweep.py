"""The command `sweep`: its options, and what it writes and says.

Flow: scene, camera -> sweep -> [cli_sweep] -> table and figures in a folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from jaxsph.cli import scene as cli_scene
from jaxsph.cli.console import UsageError, progress, say
from jaxsph.cli.options import SCENE, replaced, settings_of
from jaxsph.model import Settings
from jaxsph.plot import sweep_figures as figures
from jaxsph.trade import contenders
from jaxsph.trade.measurement import JOURNAL, TABLE, Measurement
from jaxsph.trade.sweep import sweep


def add_options(parser: argparse.ArgumentParser) -> None:
    """Options of the command besides those of its source and picture."""
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", required=True, help="folder for table and figures")
    add = parser.add_argument_group("what is compared").add_argument
    baselines = contenders.BASELINES
    tolerances = " ".join(f"{tolerance:g}" for tolerance in contenders.TOLERANCES)
    add("--tolerances", nargs="*", type=_tolerance, default=contenders.TOLERANCES, metavar="T", help=f"(default {tolerances})")
    add("--estimators", nargs="*", choices=contenders.ESTIMATORS, help="(default: all that suit the --integrator of full rate)")
    uniform = f"uniform points, segments or images that are K times coarser (default {' '.join(baselines)})"
    add("--baselines", nargs="*", type=_baseline, default=baselines, metavar="samples/K|segments/K|size/K", help=uniform)
    add("--frames", nargs="+", type=float, metavar="K", help="a sequence: moments of a built-in scene")
    add = parser.add_argument_group("how it is measured").add_argument
    add("--repeats", type=_count, default=3, metavar="N", help="turns that medians are taken of (default 3)")
    add("--converged", type=_count, default=8, metavar="N", help="samples of the converged image, over --samples (default 8)")
    pixels = "pixels at which errors to the light integral are taken; 0 for none (default 1000)"
    add("--integral", type=_number, default=1000, metavar="N", help=pixels)
    add("--no-figures", action="store_true", help="write the table only")


def run(options: argparse.Namespace) -> None:
    """Sweep, write, and say."""
    settings = settings_of(options)
    if options.frames is not None and options.frame is not None:
        raise UsageError("--frame and --frames exclude each other; name all moments after --frames")
    if options.frames is not None and len(set(options.frames)) < len(options.frames):
        raise UsageError(f"--frames must be different numbers, got {' '.join(f'{moment:g}' for moment in options.frames)}")
    if not options.no_figures:
        figures.require_matplotlib()  # before anything is read
    moments = options.frames or [options.frame]
    views = [cli_scene.scene_of(replaced(options, frame=moment))[:2] for moment in moments]
    scenes, cameras = zip(*views, strict=True)
    parts = "tolerances", "estimators", "baselines", "repeats", "converged", "integral"
    chosen = {part: getattr(options, part) for part in parts}
    chosen |= {"name": Path(options.source.removeprefix(SCENE)).stem, "folder": options.output}
    with progress("sweep", " images") as show:
        if moments == [None]:
            rows = sweep(scenes[0], cameras[0], settings, **chosen, progress=show)
        else:
            rows = sweep(scenes, cameras, settings, **chosen, frames=moments, progress=show)
    print(f"\n{'method':17s} tolerance max error  mean error  to integral      bound  evaluations  seconds  of full rate")
    print("\n".join(map(_line, rows)) + "\n")
    written = [options.output / JOURNAL, options.output / TABLE]
    if not options.no_figures:
        written += figures.draw(rows, options.output)
    for path in written:
        say("file", str(path))


def _line(row: Measurement) -> str:
    tolerance = "-" if row.tolerance is None else f"{row.tolerance:g}"
    bound, integral = ("-" if value is None else f"{value:.2g}" for value in (row.max_bound, row.integral_max))
    share = row.evaluations / max(row.evaluations_full, 1)
    moment = "" if row.frame is None else f"  frame {row.frame:g}"
    return (
        f"{row.method:17s} {tolerance:>9s} {row.max_error:9.2g} {row.mean_error:11.2g} {integral:>12s} {bound:>10s} {share:11.0%}"
        f" {row.total:9.3f} {row.total / row.full_total:10.2f}{moment}"
    )


def _tolerance(text: str) -> float:
    try:
        return float(Settings(tolerance=float(text)).tolerance)
    except ValueError:
        raise argparse.ArgumentTypeError(f"a tolerance must be a number >= 0, got {text!r}") from None


def _count(text: str, least: int = 1) -> int:
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"must be an integer of at least {least}, got {text!r}")
    return int(text)


def _number(text: str) -> int:
    return _count(text, 0)


def _baseline(text: str) -> str:
    try:
        contenders.baseline(Settings(), text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return text
