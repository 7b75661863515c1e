"""Transfer functions on the command line: domains, presets, files, and the command `transfer`.

Flow: options, particles or volume -> [cli_transfer] -> TransferFunction -> cli.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph import io, scenes
from jaxsph.cli import annotate as cli_annotate
from jaxsph.cli.annotate import require_figure, write_figure
from jaxsph.cli.console import UsageError, say, span
from jaxsph.io import Labels
from jaxsph.io.quantities import LOG_PREFIX
from jaxsph.model import Camera, Particles, Scene, TransferFunction, Volume
from jaxsph.model.transfer.domains import DOMAINS, Scale, log_departure
from jaxsph.model.transfer.looks import PRESETS
from jaxsph.plot.transfer_figure import transfer_figure

LOOKS = "colormap", "range", "opacity", "transfer", "domain", "preset"
"""Options that say what the source looks like."""


def add_looks(parser: argparse.ArgumentParser) -> None:
    """Options of what the source looks like besides those of every picture."""
    add = parser.add_argument_group("transfer function").add_argument
    add("--transfer", type=Path, metavar="FILE.json", help="a transfer function that was saved; no other of these goes with it")
    more = "; of percentile the --range is in percent" if "percentile" in DOMAINS else ""
    add("--domain", metavar="NAME", help=f"where colours sit: {', '.join(DOMAINS)} (default linear){more}")
    add("--preset", metavar="NAME", help=f"by kind of data: {', '.join(PRESETS)}")


def add_command(parser: argparse.ArgumentParser) -> None:
    """Options of the command `transfer` besides those of its source and picture."""
    add = parser.add_argument
    add("-o", "--output", type=Path, metavar="OUT", help=".png, .pdf or .svg: the figure (default: named after FILE, here)")
    add("--save", type=Path, metavar="FILE.json", help="write the transfer function, for --transfer")
    cli_annotate.add_units(parser, add)
    add("--rays", type=int, default=2000, metavar="N", help="random pixels for the histogram of what they meet (default 2000)")


def asked(options: argparse.Namespace) -> bool:
    """Whether the options say what the source is to look like."""
    return any(getattr(options, name, None) is not None for name in LOOKS)


def look(shown: Particles | Volume, options: argparse.Namespace, quantity: str, ramp: str | None = None) -> TransferFunction:
    """What particles or a volume look like, by the options; and say so. For `ramp` see `scenes.default_transfer`.

    Raises:
        UsageError: options that exclude each other, or that the quantity does not suit.
    """
    _check(options)
    path = getattr(options, "transfer", None)
    if path is not None:
        made = io.read_transfer(path)
        say("colours", f"{path} over {span(made.values)}, extinction {span(made.extinction)} per unit length")
        return made
    try:
        made, name = _made(shown, options, quantity, ramp)
    except ValueError as error:
        raise UsageError(str(error)) from error
    say("colours", f"{name} over {quantity} = {span(made.values)}, extinction {span(made.extinction)} per unit length")
    _say_domain(made, np.asarray(shown.quantity)[np.asarray(shown.valid)] if isinstance(shown, Particles) else shown.values)
    return made


def _check(options: argparse.Namespace) -> None:
    given = [name for name in LOOKS if getattr(options, name, None) is not None]
    if "transfer" in given and len(given) > 1:
        other = next(name for name in given if name != "transfer")
        raise UsageError(f"--transfer and --{other} exclude each other: the file says all; edit it, or leave one out")
    for name, known in (("domain", DOMAINS), ("preset", PRESETS)):
        value = getattr(options, name, None)
        if value is not None and value not in known:
            raise UsageError(f"--{name} must be one of {', '.join(known)}, got {value!r}")


def _made(
    shown: Particles | Volume, options: argparse.Namespace, quantity: str, ramp: str | None
) -> tuple[TransferFunction, str]:
    depth = scenes.appearance.OPTICAL_DEPTH if options.opacity is None else options.opacity
    domain, preset = getattr(options, "domain", None), getattr(options, "preset", None)
    if isinstance(shown, Particles) and shown.extinction_quantity is not None and (preset or domain):
        made, name = _made(dataclasses.replace(shown, extinction_quantity=None), options, quantity, ramp)
        return scenes.opacity_by_second(made, shown, depth), name
    is_log = quantity.lower().startswith(LOG_PREFIX)
    if is_log and domain == "log":
        other = quantity[len(LOG_PREFIX) :]
        raise ValueError(f"{quantity} is a logarithm already: leave out --domain log, or give --quantity {other}")
    if preset is not None:
        own = "linear" if is_log and domain is None and PRESETS[preset].domain == "log" else domain
        more: dict[str, Any] = {"values": options.range, "domain": own, "colormap_name": options.colormap}
        return scenes.preset(preset, shown, **more, optical_depth=depth), f"preset {preset}"
    name = options.colormap or "viridis"
    if domain is not None and domain != "linear":
        return scenes.domain_transfer(shown, domain, name, options.range, depth), f"{name}, {domain},"
    if isinstance(shown, Volume):
        return scenes.default_volume_transfer(shown, name, options.range, depth), name
    return scenes.default_transfer(shown, name, options.range, depth, ramp=ramp), name


def _say_domain(made: TransferFunction, shown: Any) -> None:
    """Of an axis of logarithms: which values have none, and how far colours are from the map's."""
    values = np.asarray(made.values, np.float64)
    if len(values) > 2 and Scale.of(values).name == "log":
        left_out, count = int((np.asarray(shown) <= 0).sum()), int(np.size(shown))
        if left_out and values[0] > 0:
            say(
                "note",
                f"{left_out:,} of {count:,} values are not positive and look as the lowest; see --domain symlog",
            )
        off = log_departure(values, np.asarray(made.colors, np.float64))
        say(
            "",
            f"{len(values)} control points at even logarithms; between them colours are off those of log10 by at most {off:.2g}",
        )


def check_figure(options: argparse.Namespace) -> Path:
    """Where the figure goes; know before the work that it, and the function, can be written there."""
    _check(options)
    stem = Path(str(options.source).rpartition(":")[2]).stem
    output: Path = options.output or Path(f"{stem}_transfer.png")
    require_figure(output, (".png", ".pdf", ".svg"))
    if options.save is not None and options.save.suffix.lower() != ".json":
        raise UsageError(f"--save {options.save}: a transfer function is written as .json")
    if options.rays < 1:
        raise UsageError(f"--rays must be at least 1, got {options.rays}")
    return output


def draw_file(options: argparse.Namespace, output: Path) -> None:
    """The figure of a saved function alone."""
    transfer = io.read_transfer(options.source)
    say("colours", f"{len(transfer.values)} control points over {span(transfer.values)}, extinction {span(transfer.extinction)}")
    write_figure(transfer_figure(transfer, title=Path(options.source).name), output)
    say("figure", str(output))


def draw(scene: Scene, camera: Camera, labels: Labels, options: argparse.Namespace, output: Path) -> None:
    """The figure of a scene's transfer function over what rays meet; and the function as a file where that is asked for."""
    transfer = scene.transfer if scene.transfer is not None else next((made for _, made in scene.volumes), None)
    if transfer is None:
        raise UsageError("a surface has no transfer function; leave out --iso")
    figure = transfer_figure(transfer, scene, camera, labels=labels, title=str(options.source), rays=options.rays)
    write_figure(figure, output)
    say("figure", f"{output}, over what {min(options.rays, camera.width * camera.height)} rays meet")
    if options.save is not None:
        transfer.save(options.save)
        say("saved", f"{options.save}: render with --transfer {options.save}")
