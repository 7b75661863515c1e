"""What is shown looks like on the command line: transfer functions of what is no single file, and labels of a key.

Flow: options, particles or a volume -> [look] -> TransferFunction, Labels -> commands.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph import io
from jaxsph.cli.console import is_given, refuse, require_writable, span, wrong_usage
from jaxsph.cli.voice import say
from jaxsph.io import Labels, ParticleTable
from jaxsph.io.libraries import require
from jaxsph.io.opening.looks import look_of
from jaxsph.io.opening.opened import Loaded
from jaxsph.io.replace import write_figure
from jaxsph.io.settle.labels import NEEDS, can_name
from jaxsph.io.settle.quantities import LOG_PREFIX
from jaxsph.io.settle.unit_names import unit_of
from jaxsph.model import Camera, Image, Particles, Scene, TransferFunction, Volume
from jaxsph.model.transfer.domains import Scale
from jaxsph.model.transfer.looks import scaled
from jaxsph.plot.image_figure import image_figure

UNITS = "unit", "length_unit"
FIGURES = (".png", ".pdf", ".svg")


def is_looked(options: Any) -> bool:
    """Whether any option says what the source is to look like."""
    return bool(options.said) or options.transfer is not None or options.exposure != 0


def look(shown: Particles | Volume, options: Any, quantity: str) -> TransferFunction:
    """What particles or a volume look like, by the options, with the extinction of typical columns; and say so.

    Raises `UsageError`: options that the quantity does not suit.
    """
    with wrong_usage():
        made, called = look_of(shown, quantity, options)
    if options.exposure:
        made = scaled(made, 2.0**options.exposure)
    say("colours", f"{called} over {quantity} = {span(made.values)}, extinction {span(made.extinction)} per unit length")
    return made


def say_left_out(made: TransferFunction, shown: Any) -> None:
    """Of an axis of logarithms: which values have none."""
    values = np.asarray(made.values, np.float64)
    if len(values) > 2 and Scale.of(values).name == "log":
        left_out, count = int((np.asarray(shown) <= 0).sum()), int(np.size(shown))
        if left_out and values[0] > 0:
            say("note", f"{left_out:,} of {count:,} values are not positive and look as the lowest; see --norm symlog")


def values_of(shown: Particles | Volume) -> np.ndarray:
    """The values that colours are looked up by."""
    return np.asarray(shown.quantity)[np.asarray(shown.valid)] if isinstance(shown, Particles) else np.asarray(shown.values)


def has_key(options: Any) -> bool:
    """Whether a key is to be drawn: units are of a key."""
    return any(is_given(name, getattr(options, name, None)) for name in ("annotate", *UNITS))


def require_figure(output: Path, suffixes: tuple[str, ...] = FIGURES) -> None:
    """Know before the work that a figure can be drawn and written."""
    require_writable(output, "a figure is written as", suffixes)
    require("matplotlib", "figures", "color")


def labels_of(loaded: Loaded, options: Any) -> Labels | None:
    """Labels by the units that were asked for; None leaves them to the file. In code units, with a note, without unyt.

    Raises `UsageError`: a unit that does not agree, or that is not stated.
    """
    if loaded.table is None:
        refuse(options, UNITS, f"is for files that state units, and {loaded.path} does not; leave it out")
        return Labels(loaded.quantity)
    if not has_key(options):
        return Labels() if hasattr(options, "unit") else None
    table, values = loaded.table, np.asarray(values_of(loaded.shown), np.float64)
    largest = float(np.abs(values).max(initial=0)) if values.size else 1.0
    if loaded.quantity.lower().startswith(LOG_PREFIX) and values.size:
        largest = 10.0 ** float(values.max())
    stated = unit_of(table, loaded.quantity) is not None or table.units.length is not None
    if stated and not can_name() and options.unit is None and options.length_unit is None:
        say("note", f"code units: {NEEDS}")
    with wrong_usage():
        made = io.labels_of(table, loaded.quantity, largest, unit=options.unit, length_unit=options.length_unit)
    return dataclasses.replace(made, opacity=loaded.opacity_by or made.opacity)


def say_units(table: ParticleTable) -> None:
    """Say which units a file states."""
    stated = [*(["positions"] if table.units.length is not None else []), *table.units.columns]
    if stated:
        say("units", f"stated for {', '.join(stated)}")
    if moment := io.labels_of(table, "", 1.0).moment:
        say("time", moment)


def require_key(options: Any, output: Path) -> None:
    """Know before the work that the key can be drawn, where there is one."""
    if has_key(options):
        require_figure(output, (".png",))


def save_with_key(image: Image, scene: Scene, camera: Camera, labels: Labels, options: Any, output: Path) -> None:
    """Write the picture in front of its background, with its key, and what its file says of how it was made."""
    if getattr(options, "background", None) is not None:
        color: Any = image.over(options.background)
        image = dataclasses.replace(image, color=color, transmittance=image.transmittance * 0)
    figure = image_figure(image, scene, camera, labels=labels, target=options.target)
    write_figure(figure, output, metadata={str(name): str(value) for name, value in image.metadata})
