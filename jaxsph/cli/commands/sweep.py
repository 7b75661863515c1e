"""The command `sweep`: its options, and what it writes and says.

Flow: scene, camera -> sweep -> [cli_sweep] -> table and figures in a folder.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from jaxsph.cli import scene as cli_scene
from jaxsph.cli import voice
from jaxsph.cli.console import UsageError, progress
from jaxsph.cli.options import groups, values
from jaxsph.cli.options.groups import OWN, flag, option, output
from jaxsph.cli.options.settings import SCENE, settings_of, stem_of
from jaxsph.cli.voice import say
from jaxsph.io.replace import refuse_input
from jaxsph.model import Settings, registry
from jaxsph.plot import sweep_figures as figures
from jaxsph.trade import contenders
from jaxsph.trade.measurement import TABLE, Measurement
from jaxsph.trade.sweep import sweep as measured


def _listed(read: Callable[[str], Any]) -> Callable[[str], tuple[Any, ...]]:
    """Values between commas."""
    return lambda text: tuple(read(one) for one in text.split(",") if one)


def _tolerance(text: str) -> float:
    try:
        return float(Settings(tolerance=float(text)).tolerance)
    except ValueError:
        raise ValueError(f"must be numbers >= 0, got {text!r}") from None


def _baseline(text: str) -> str:
    contenders.baseline(Settings(), text)
    return text


_TOLERANCES = ",".join(f"{tolerance:g}" for tolerance in contenders.TOLERANCES)
_ESTIMATORS = ",".join(contenders.ESTIMATORS)
_BASELINES = ",".join(contenders.BASELINES)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sweep(groups.Options, groups.Quality, groups.SurfaceLook, groups.View, groups.Source):
    """Options of the command."""

    integrator: Annotated[
        str | None,
        option("--integrator", "NAME", values.one_of(tuple(registry.INTEGRATORS)), groups.QUALITY, "(default samples)"),
    ] = "samples"  # whose full rate bounds and the pilot keep a tolerance against
    output: Annotated[Path | None, output("folder for table and figures", "DIR")] = None
    tolerances: Annotated[
        Any, option("--tolerances", "T,...", _listed(_tolerance), OWN, f"what is compared (default {_TOLERANCES})")
    ] = contenders.TOLERANCES
    estimators: Annotated[
        Any,
        option(
            "--estimators",
            "NAME,...",
            _listed(values.one_of(contenders.ESTIMATORS)),
            OWN,
            f"of {_ESTIMATORS} (default: all that suit the --integrator)",
        ),
    ] = None
    baselines: Annotated[
        Any,
        option("--baselines", "samples/K,...", _listed(_baseline), OWN, f"uniform, K times coarser (default {_BASELINES})"),
    ] = contenders.BASELINES
    moments: Annotated[
        Any, option("--moments", "K,...", _listed(values.number), OWN, "a sequence: moments of a built-in scene")
    ] = None
    repeats: Annotated[int, option("--repeats", "N", values.count(1), OWN, "turns that medians are taken of (default 3)")] = 3
    converged: Annotated[
        int, option("--converged", "N", values.count(1), OWN, "samples of the converged image, over --samples (default 8)")
    ] = 8
    integral: Annotated[
        int,
        option("--integral", "N", values.count(0), OWN, "pixels with errors to the light integral (default 1000)"),
    ] = 1000
    no_figures: Annotated[bool, flag("--no-figures", OWN, "write the table only")] = False


def sweep(file: Annotated[str, Parameter(help="a file, or scene:NAME")], /, *, asked: Sweep = Sweep()) -> None:
    """Sweep, write DIR/sweep.csv and figures, and say."""
    options = dataclasses.replace(asked, source=file)
    if options.surface is None:  # of a liquid tolerances are compared, which its surface does not have
        options = dataclasses.replace(options, surface=False)
    if options.output is None:
        raise UsageError("-o DIR is needed: where should table and figures go?")
    refuse_input(options.output / TABLE)
    if options.surface is not False and options.estimators:
        raise UsageError("--surface and --estimators exclude each other: a surface has no tolerance; leave one of them out")
    settings, moments = settings_of(options), _moments(options)
    if not options.no_figures:
        figures.require_matplotlib()  # before anything is read
    views = [cli_scene.scene_of(_at(options, moment))[:2] for moment in moments]
    scenes, cameras = zip(*views, strict=True)
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
    voice.report(rows=[dataclasses.asdict(row) for row in rows])
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


def _at(options: Any, moment: float | None) -> Any:
    """The options at a moment of a built-in scene."""
    if moment is None:
        return options
    behind = "," if options.source.count(":") > 1 else ":"
    return dataclasses.replace(options, source=f"{options.source}{behind}frame={moment!r}")


def _line(row: Measurement) -> str:
    tolerance = "-" if row.tolerance is None else f"{row.tolerance:g}"
    bound, integral = ("-" if value is None else f"{value:.2g}" for value in (row.max_bound, row.integral_max))
    share = row.evaluations / max(row.evaluations_full, 1)
    moment = "" if row.frame is None else f"  frame {row.frame:g}"
    return (
        f"{row.method:17s} {tolerance:>9s} {row.max_error:9.2g} {row.mean_error:11.2g} {integral:>12s} {bound:>10s} {share:11.0%}"
        f" {row.total:9.3f} {row.total / row.full_total:10.2f}{moment}"
    )
