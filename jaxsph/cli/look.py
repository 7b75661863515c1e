"""What is shown looks like on the command line: transfer functions, their figures, and pictures with a key.

Flow: options, particles or volume -> [cli_look] -> TransferFunction, Labels -> picture with a key, figure.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph import io, scenes
from jaxsph.cli.console import UsageError, refuse, require_writable, say, span, wrong_usage
from jaxsph.io import Labels, ParticleTable, labels_of
from jaxsph.io.libraries import require
from jaxsph.io.replace import written_whole
from jaxsph.io.settle.labels import NEEDS, can_name
from jaxsph.io.settle.quantities import LOG_PREFIX
from jaxsph.io.settle.unit_names import unit_of
from jaxsph.model import Camera, Image, Particles, Scene, TransferFunction, Volume
from jaxsph.model.transfer.domains import DOMAINS, Scale, log_departure
from jaxsph.model.transfer.looks import PRESETS
from jaxsph.plot.image_figure import image_figure
from jaxsph.plot.transfer_figure import transfer_figure

LOOKS = "colormap", "range", "opacity", "transfer", "domain", "preset"
"""Options that say what the source looks like."""
UNITS = "unit", "length_unit"


def add_looks(parser: argparse.ArgumentParser) -> None:
    """Options of what the source looks like besides those of every picture."""
    add = parser.add_argument_group("transfer function").add_argument
    add("--transfer", type=Path, metavar="FILE.json", help="a transfer function that was saved; no other of these goes with it")
    more = "; of percentile the --range is in percent" if "percentile" in DOMAINS else ""
    add("--domain", metavar="NAME", help=f"where colours sit: {', '.join(DOMAINS)} (default linear){more}")
    add("--preset", metavar="NAME", help=f"by kind of data: {', '.join(PRESETS)}")


def add_key(parser: argparse.ArgumentParser) -> None:
    """Options of a picture's key."""
    add = parser.add_argument_group("key").add_argument
    add("--annotate", action="store_true", help="with colour bar, scale bar, axes, outline and time (a .png)")
    _add_units(add)


def add_command(parser: argparse.ArgumentParser) -> None:
    """Options of the command `transfer` besides those of its source and picture."""
    add = parser.add_argument
    add("-o", "--output", type=Path, metavar="OUT", help=".png, .pdf or .svg: the figure (default: named after FILE, here)")
    add("--save", type=Path, metavar="FILE.json", help="write the transfer function, for --transfer")
    _add_units(add)
    add("--rays", type=int, default=2000, metavar="N", help="random pixels for the histogram of what they meet (default 2000)")


def _add_units(add: Any) -> None:
    add("--unit", metavar="UNIT", help="of the quantity on its axis, as Msun/kpc**3 (default: by what the file states)")
    add("--length-unit", metavar="UNIT", help="of lengths, as kpc")


def asked(options: argparse.Namespace) -> list[str]:
    """The options that say what the source is to look like."""
    return [name for name in LOOKS if getattr(options, name, None) is not None]


def look(shown: Particles | Volume, options: argparse.Namespace, quantity: str, ramp: str | None = None) -> TransferFunction:
    """What particles or a volume look like, by the options; and say so. For `ramp` see `scenes.default_transfer`.

    Raises:
        UsageError: options that exclude each other, or that the quantity does not suit.
    """
    check_looks(options)
    path = getattr(options, "transfer", None)
    if path is not None:
        made = io.read_transfer(path)
        _say_colours(f"{path} over", made)
        return made
    with wrong_usage():
        made, name = _made(shown, options, quantity, ramp)
    _say_colours(f"{name} over {quantity} =", made)
    _say_domain(made, np.asarray(shown.quantity)[np.asarray(shown.valid)] if isinstance(shown, Particles) else shown.values)
    return made


def look_of_volume(volume: Volume, name: str) -> TransferFunction:
    """What a volume beside the source looks like, by a colour map."""
    made = scenes.default_volume_transfer(volume, name)
    _say_colours(f"{name} over", made)
    return made


def _say_colours(over: str, made: TransferFunction) -> None:
    say("colours", f"{over} {span(made.values)}, extinction {span(made.extinction)} per unit length")


def check_looks(options: argparse.Namespace) -> None:
    """Raise `UsageError` where options exclude each other, or name what there is not."""
    other = next((name for name in asked(options) if name != "transfer"), None)
    if getattr(options, "transfer", None) is not None and other is not None:
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
        more: dict[str, Any] = {"range": options.range, "norm": own, "colormap": options.colormap}
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
            say("note", f"{left_out:,} of {count:,} values are not positive and look as the lowest; see --domain symlog")
        off = f"{log_departure(values, np.asarray(made.colors, np.float64)):.2g}"
        say("", f"{len(values)} control points at even logarithms; between them colours are off those of log10 by at most {off}")


def check_key(options: argparse.Namespace, output: Path) -> None:
    """Know before the work that the key can be drawn."""
    if options.annotate:
        _require_figure(output, (".png",))
        if options.progressive:
            raise UsageError("--annotate draws on the finished picture; leave out --progressive")
    else:
        refuse(options, UNITS, "goes with --annotate")


def _require_figure(output: Path, suffixes: tuple[str, ...]) -> None:
    require_writable(output, "a figure is written as", suffixes)
    require("matplotlib", "figures", "color")


def _labels_are_shown(options: argparse.Namespace) -> bool:
    return bool(getattr(options, "annotate", hasattr(options, "unit")))


def label_file(
    table: ParticleTable, quantity: str, values: np.ndarray, options: argparse.Namespace, opacity_by: str | None = None
) -> Labels:
    """Labels of a quantity of a file, where the command shows them; in code units, with a note, without unyt.

    Raises:
        UsageError: a unit that does not agree, or that the file does not state.
    """
    if not _labels_are_shown(options):
        return Labels()
    largest = float(np.abs(values).max(initial=0)) if values.size else 1.0
    if quantity.lower().startswith(LOG_PREFIX) and values.size:
        largest = 10.0 ** float(values.max())
    stated = unit_of(table, quantity) is not None or table.units.length is not None
    if stated and not can_name() and options.unit is None and options.length_unit is None:
        say("note", f"code units: {NEEDS}")
    with wrong_usage():
        made = labels_of(table, quantity, largest, unit=options.unit, length_unit=options.length_unit)
        return dataclasses.replace(made, opacity=opacity_by or made.opacity)


def label(quantity: str, options: argparse.Namespace, what: str) -> Labels:
    """Labels of a quantity of what states no units, where the command shows them."""
    if not _labels_are_shown(options):
        return Labels()
    refuse(options, UNITS, f"is for files that state units, and {what} does not; leave it out")
    return Labels(quantity)


def say_units(table: ParticleTable) -> None:
    """Say which units a file states."""
    stated = [*(["positions"] if table.units.length is not None else []), *table.units.columns]
    if stated:
        say("units", f"stated for {', '.join(stated)}")
    moment = labels_of(table, "", 1.0).moment
    if moment:
        say("time", moment)


def save_with_key(image: Image, scene: Scene, camera: Camera, labels: Labels, options: argparse.Namespace, output: Path) -> None:
    """Write the picture with its key; what an image's file says of how it was made, this says too."""
    figure = image_figure(image, scene, camera, labels=labels, target=options.target)
    _write_figure(figure, output, metadata={str(name): str(value) for name, value in image.metadata})


def _write_figure(figure: Any, output: Path, **more: Any) -> None:
    with written_whole(output) as temporary:
        figure.savefig(temporary, **more)


def check_figure(options: argparse.Namespace) -> Path:
    """Where the figure goes; know before the work that it, and the function, can be written there."""
    check_looks(options)
    stem = Path(str(options.source).rpartition(":")[2]).stem
    output: Path = options.output or Path(f"{stem}_transfer.png")
    _require_figure(output, (".png", ".pdf", ".svg"))
    if options.save is not None and options.save.suffix.lower() != ".json":
        raise UsageError(f"--save {options.save}: a transfer function is written as .json")
    if options.rays < 1:
        raise UsageError(f"--rays must be at least 1, got {options.rays}")
    return output


def draw_file(options: argparse.Namespace, output: Path) -> None:
    """The figure of a saved function alone."""
    transfer = io.read_transfer(options.source)
    say("colours", f"{len(transfer.values)} control points over {span(transfer.values)}, extinction {span(transfer.extinction)}")
    _write_figure(transfer_figure(transfer, title=Path(options.source).name), output)
    say("figure", str(output))


def draw(scene: Scene, camera: Camera, labels: Labels, options: argparse.Namespace, output: Path) -> None:
    """The figure of a scene's transfer function over what rays meet; and the function as a file where that is asked for."""
    if not scene.looks:
        raise UsageError("a surface has no transfer function; leave out --iso")
    transfer = scene.looks[0]
    figure = transfer_figure(transfer, scene, camera, labels=labels, title=str(options.source), rays=options.rays)
    _write_figure(figure, output)
    say("figure", f"{output}, over what {min(options.rays, camera.width * camera.height)} rays meet")
    if options.save is not None:
        transfer.save(options.save)
        say("saved", f"{options.save}: render with --transfer {options.save}")
