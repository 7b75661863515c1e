"""The command `sweep`: its options, and what it writes and says.

Flow: scene, camera -> sweep -> [sweep] -> table and figures in a folder.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from jaxsph.cli import groups, scene as cli_scene, voice
from jaxsph.cli.console import SCENE, UsageError, progress, stem_of
from jaxsph.cli.groups import OWN, QUALITY, offered, output, settings_of
from jaxsph.cli.voice import say
from jaxsph.io.damage import require
from jaxsph.io.opening import values
from jaxsph.io.opening.options import Look, Source, View, flag, option
from jaxsph.io.replace import refuse_input
from jaxsph.model.settings import INTEGRATORS, Settings
from jaxsph.plot import sweep_figures as figures
from jaxsph.trade.sweep import BASELINES, ESTIMATORS, TABLE, TOLERANCES, Row, baseline, sweep as measured

LIMITS = values.listed(values.read_as("numbers >= 0", lambda text: Settings(tolerance=float(text)).tolerance))
METHODS, COARSER = values.listed(values.one_of(tuple(ESTIMATORS))), values.listed(lambda text: baseline(Settings(), text).method)
_TOLERANCES = ",".join(f"{tolerance:g}" for tolerance in TOLERANCES)


@offered(without="tolerance estimator relax screen draft")
class Sweep(groups.Options, groups.Quality, Look, View, Source):
    """Options of the command."""

    integrator: str | None = option(  # bounds and the pilot keep a tolerance against the full rate of samples
        "samples", "NAME", values.one_of(tuple(INTEGRATORS)), QUALITY, "(default samples)"
    )
    output: Path | None = output("folder for table and figures", "DIR")
    tolerances: Any = option(TOLERANCES, "T,...", LIMITS, OWN, f"what is compared (default {_TOLERANCES})")
    estimators: Any = option(None, "NAME,...", METHODS, OWN, f"of {','.join(ESTIMATORS)} (default: all that suit --integrator)")
    baselines: Any = option(BASELINES, "samples/K,...", COARSER, OWN, f"uniform, K times coarser (default {','.join(BASELINES)})")
    moments: Any = option(None, "K,...", values.listed(values.number), OWN, "a sequence: moments of a built-in scene")
    repeats: int = option(3, "N", values.count(1), OWN, "turns that medians are taken of (default 3)")
    converged: int = option(8, "N", values.count(1), OWN, "samples of the converged image, over --samples (default 8)")
    integral: int = option(1000, "N", values.count(0), OWN, "pixels with errors to the light integral (default 1000)")
    no_figures: bool = flag(OWN, "write the table only")


def sweep(file: Annotated[str, Parameter(help="a file, or scene:NAME")], /, *, asked: Sweep = Sweep()) -> None:
    """Sweep, write DIR/sweep.csv and figures, and say."""
    options = dataclasses.replace(asked, source=file)
    if options.surface is None and options.surface_of is None:  # of a liquid tolerances are compared, which its surface has not
        options = dataclasses.replace(options, surface=False)
    if options.output is None:
        raise UsageError("-o DIR is needed: where should table and figures go?")
    refuse_input(options.output / TABLE)
    settings, moments = settings_of(options), _moments(options)
    if not options.no_figures:
        require("matplotlib", figures.FIGURES, "color")  # before anything is read
    behind = "," if file.count(":") > 1 else ":"
    sources = [file if moment is None else f"{file}{behind}frame={moment!r}" for moment in moments]
    views = [cli_scene.opened_of(dataclasses.replace(options, source=source)) for source in sources]
    scenes, cameras = zip(*((one.scene, one.camera) for one in views), strict=True)
    parts = "tolerances", "estimators", "baselines", "repeats", "converged", "integral"
    chosen = {part: getattr(options, part) for part in parts}
    chosen |= {"name": stem_of(options.source), "folder": options.output}
    voice.release()
    with progress("sweep", " images") as show:
        if moments == [None]:
            rows = measured(scenes[0], cameras[0], settings, **chosen, progress=show)
        else:
            rows = measured(scenes, cameras, settings, **chosen, frames=options.moments, progress=show)
    voice.result(f"{'method':17s} tolerance max error  mean error  to integral      bound  evaluations  seconds  of full rate")
    voice.result("\n".join(map(_line, rows)))
    voice.report(rows=rows)
    written = [options.output / TABLE]
    if not options.no_figures:
        written += figures.draw(rows, options.output)
    for path in written:
        say("file", str(path))
        voice.written(path)


def _moments(options: Any) -> list[float | None]:
    """Moments of a built-in scene, or what is there alone."""
    if options.moments is None:
        return [None]
    if len(set(options.moments)) < len(options.moments):
        raise UsageError(f"--moments must be different numbers, got {','.join(f'{moment:g}' for moment in options.moments)}")
    if not options.source.startswith(SCENE):
        raise UsageError("--moments is for built-in scenes, not for files")
    if "frame=" in options.source:
        raise UsageError("frame of scene:NAME and --moments exclude each other; name all moments after --moments")
    return list(options.moments)


def _line(row: Row) -> str:
    tolerance = "-" if row["tolerance"] is None else f"{row['tolerance']:g}"
    bound, integral = ("-" if row[name] is None else f"{row[name]:.2g}" for name in ("max_bound", "integral_max"))
    share, slower = row["evaluations"] / max(row["evaluations_full"], 1), row["total"] / row["full_total"]
    moment = "" if row["frame"] is None else f"  frame {row['frame']:g}"
    return (
        f"{row['method']:17s} {tolerance:>9s} {row['max_error']:9.2g} {row['mean_error']:11.2g} {integral:>12s} {bound:>10s}"
        f" {share:11.0%} {row['total']:9.3f} {slower:10.2f}{moment}"
    )
