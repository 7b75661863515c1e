"""What commands make: pictures of a file, or of several in one figure; timed, written with a key and a record, and told.

Flow: options, what makes pictures -> [figures: draw, produce] -> a file, voice.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxsph.cli.console import (
    SCENE,
    camera_line,
    is_given,
    refuse,
    require_writable,
    span,
    stem_of,
    tell_if_unseen,
    time_line,
    units_of,
)
from jaxsph.cli.voice import UsageError, hushed, report, say, say_all, written
from jaxsph.io import Labels
from jaxsph.io.damage import require
from jaxsph.io.images.image_files import write_image
from jaxsph.io.images.planes import converted
from jaxsph.io.opening.opened import Opened
from jaxsph.io.replace import write_figure
from jaxsph.io.settle.quantities import LOG_PREFIX, is_log
from jaxsph.io.units import CODE_UNITS, can_name, named
from jaxsph.model.camera.camera import Camera
from jaxsph.model.image import Image
from jaxsph.model.preview.frame import around_all
from jaxsph.model.projection import NORMS, Projection
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import Scale
from jaxsph.plot.bars import STEPS
from jaxsph.plot.image_figure import draw_arrows, image_figure

IMAGES = (".exr", ".png")
VECTORS = (".pdf", ".svg")
FIGURES = (".png", *VECTORS)
UNITS = "unit", "length_unit"
OF_FIGURES = (
    "annotate",
    "axes",
    *UNITS,
    "title",
    "dpi",
    "font_size",
    "panels",
    "contours",
)  # options that draw a key beside a picture
JOURNALS = 300  # pixels an inch of a picture in print
DIVERGING, NEARLY, FAINT = "coolwarm", 99.5, 95  # of a difference; percentiles that it spans, of ratios, large where little is
CONTOURS = 5  # levels


class Made(NamedTuple):
    """What a command has made.

    Attributes:
        what: an image, a slice, a projection, frames, a table; or several pictures, the panels of a figure.
        about: what is said of its file, by its kind.
        said: what is said besides, by its subjects.
        results: of the JSON object.
        stats: seconds by stage, and kernel evaluations.
        look: by which a picture is made of values; None where there is no picture.
        labels: of a figure.
        arrows: over a figure, for each panel components, what they are called, their unit, and by what they are in it.
        contours: values on the same pixels, what they are called, and their unit.
        colors: pictures that are looked at, whether they show anything.
        save: writes it to a file, with what more its metadata hold by then; None by its own method, with its look.
    """

    what: Any
    about: tuple[str, str]
    said: Mapping[str, str] = {}
    results: Mapping[str, Any] = {}
    stats: Mapping[str, Any] = {}
    look: Mapping[str, Any] | None = None
    labels: Labels = Labels()
    arrows: tuple[Any, ...] = ()
    contours: tuple[Any, ...] | None = None
    colors: Sequence[Any] = ()
    save: Callable[[Any, Path], Any] | None = None


def of_files(options: Any, files: Sequence[str]) -> Any:
    """Options with the files, which are as many as can be drawn in one figure."""
    if not (len(files) == 2 if options.difference else len(files) == 1 or (files and options.panels)):
        known = "one, with --panels several, with --difference two, of which the second is shown minus the first"
        raise UsageError(f"FILE must be {known}; got {len(files) or 'none'}")
    return dataclasses.replace(options, source=list(files))


def draw(options: Any, output: Path, opening: Callable[[Any, Opened | None], tuple[Opened, Callable[[], Made]]]) -> None:
    """Draw a file, or several in one figure, all from where the first is seen, as wide as each of them needs.

    `opening` takes options of one file, and how it is to be seen if not by itself; gives how it is, and what makes its picture.
    Raises `UsageError`, `ValueError`: what cannot be drawn; of several files the message says which.
    """
    sources = options.source if isinstance(options.source, list) else [options.source]
    if len(sources) > 1 and options.panels and options.title and options.title.count(";") + 1 != len(sources):
        raise UsageError(f"--title must name each of {len(sources)} panels, with ; between, got {options.title!r}")

    def named(source: str, work: Callable[..., Any], *given: Any) -> Any:
        try:
            return work(*given)
        except (UsageError, ValueError) as error:
            if len(sources) == 1 or source in str(error):
                raise
            raise (UsageError if isinstance(error, UsageError) else ValueError)(f"{source}: {error}") from error

    def opened_of(source: str, like: Opened | None = None, **seen: Any) -> tuple[Opened, Callable[[], Made]]:
        opened, make = named(source, opening, dataclasses.replace(options, source=source, **seen), like)
        if like is not None and opened.measures != like.measures:
            own, first = (", ".join(text or CODE_UNITS for text in one.measures) for one in (opened, like))
            raise ValueError(f"{source}: units must be those of {sources[0]}, {first}; got {own} (--unit has values in one)")
        return opened, functools.partial(named, source, make)

    first, make = opened_of(sources[0])
    if len(sources) > 1 and options.width is None and options.eye is None and not any(one.startswith(SCENE) for one in sources):
        say("frame", "as wide as what each file would show by itself; --center and --width have another")
        axes, center = first.camera.exact_axes(), first.center
        view, up = ("iso", first.up) if first.camera.is_perspective else (-axes[2], axes[1])
        with hushed():
            alone = [first, *(opened_of(one, view=view, up=np.asarray(up, np.float64))[0] for one in sources[1:])]
            camera = around_all([one.camera for one in alone], None if options.center is None else center)
            eye = camera.exact_eye()
            center = None if center is None else eye + (center - eye) @ axes[2] * axes[2]  # as deep as it was
            first, make = opened_of(sources[0], dataclasses.replace(first, camera=camera, center=center))

    def make_all() -> Made:
        made = [make()]
        for nth, source in enumerate(sources[1:], 2):
            say("", f"{nth} of {len(sources)}: {source}, seen as {sources[0]} is")
            made.append(opened_of(source, first)[1]())
        return _joined(made, sources, options)

    produce(options, output, first, make_all)


def _joined(made: Sequence[Made], sources: Sequence[str], options: Any) -> Made:
    """What was made of each file in one figure: panels, called by their times, or where these do not tell them apart by their
    files, or the difference of two; and contours over it, whose levels are said.
    """
    first, found = made[0], [one.contours for one in made if one.contours is not None]
    called = [one.labels.moment for one in made]
    if len(set(called)) < len(made):
        called = ["\n".join(filter(None, pair)) for pair in zip(map(stem_of, sources), called, strict=True)]
    if options.difference:
        first, found = _difference(first, made[1], called, options), found[-1:]
    elif len(made) > 1:
        look = {**_look_of_all(made, options), "title": options.title.split(";") if options.title else called}
        said = {f"{what} {nth}": text for nth, one in enumerate(made, 1) for what, text in one.said.items()}
        results, about = {"panels": [one.results for one in made]}, (first.about[0], f"{len(made)} panels, each {first.about[1]}")
        pictures, arrows = [one.what for one in made], tuple(arrows for one in made for arrows in one.arrows)
        first = first._replace(what=pictures, arrows=arrows, look=look, labels=dataclasses.replace(first.labels, moment=""))
        first = first._replace(about=about, said=said, results=results, stats={})
    if not found:
        return first
    values, (_, name, code) = np.stack([values for values, *_ in found]), found[0]
    log, ends = Projection(values, None, np.float64(1), False).span()  # type: ignore[arg-type]
    factor, unit = (1.0, CODE_UNITS) if code is None or not can_name() else named(code, ends[1])
    even = factor * (np.geomspace if log else np.linspace)(*ends, CONTOURS + 2)[1:-1]
    low, high = factor * np.nanmin(values, initial=np.inf), factor * np.nanmax(values, initial=-np.inf)
    levels = [level for level in sorted({float(f"{level:.2g}") for level in even}) if low < level < high]
    told = f"at {', '.join(f'{level:g}' for level in levels)}" if levels else f"nowhere, as it is all over {low:g}"
    say("contours", f"of {name} {told} {unit}")
    return first._replace(look={**(first.look or {}), "contours": (factor * values, levels)})


def _look_of_all(made: Sequence[Made], options: Any) -> dict[str, Any]:
    """The first's, a transfer function of it over what those of all span, unless it was asked for, or is by its own quantity."""
    look, *_ = looks = [dict(one.look or {}) for one in made]
    is_asked = options.range is not None or options.transfer is not None
    if "transfer" in look and not is_asked and (scale := Scale.of(look["transfer"].values)).name != "even":
        values = [np.asarray(one["transfer"].values, np.float64)[[0, -1]] for one in looks]
        laid = Scale(scale.name, np.array([np.min(values), np.max(values)])).value(scale.place(look["transfer"].values))
        look["transfer"] = dataclasses.replace(look["transfer"], values=laid)
    return look


def _difference(one: Made, other: Made, called: Sequence[str], options: Any) -> Made:
    """The other minus the one, or by logarithms their ratio, in colours about none."""
    what, name, is_ratio = other.what, other.labels.quantity, options.norm == "log"
    before, after = (np.asarray(each.what.values, np.float64) for each in (one, other))
    logs = is_log(name)
    if is_ratio and logs:
        before, after, logs, name = 10.0**before, 10.0**after, False, name[len(LOG_PREFIX) :]
    values = np.where((before > 0) & (after > 0), after / before, np.nan) if is_ratio else after - before
    if not (found := values[np.isfinite(values)]).size:
        raise ValueError("no pixel has values of both files: ask for a --center and a --width in which there are")
    away = np.abs(np.log10(found) if is_ratio else found)
    most = float(np.percentile(away, FAINT if is_ratio else NEARLY)) or float(away.max()) or 1.0
    ends: Any = options.range or ((10.0**-most, 10.0**most) if is_ratio else (-most, most))
    name = f"ratio.{name}" if is_ratio else f"{LOG_PREFIX}ratio.{name[len(LOG_PREFIX) :]}" if logs else f"difference.{name}"
    minus = f" {'over' if is_ratio or logs else 'minus'} ".join(called[::-1]).replace("\n", " ")
    logs = logs or is_ratio
    metadata = *(pair for pair in what.metadata if not (logs and pair[0] == "jaxsph.unit")), ("jaxsph.difference", minus)
    values = converted(values.astype(what.values.dtype), 1)
    changed: dict[str, Any] = {"values": values, "metadata": metadata}
    colormap, norm = options.colormap or DIVERGING, options.norm or "linear"
    if norm not in NORMS:
        raise UsageError(f"--norm {norm} is not for a difference: it must be one of {', '.join(NORMS)}")
    look: dict[str, Any] = {"colormap": colormap, "norm": norm, "range": ends}
    if isinstance(what, Projection):
        changed |= {"name": name, "unit": "" if logs else what.unit}
    else:
        laid = TransferFunction.control_values(norm, low=ends[0], high=ends[1], points=STEPS)
        look = {"transfer": TransferFunction.from_colormap(colormap, laid)}
    unit, factor = ("", 1.0) if logs else (other.labels.unit, other.labels.factor)
    labels = dataclasses.replace(other.labels, quantity=name, moment=minus, unit=unit, factor=factor)
    results, in_words = ends_said(found, labels, "" if logs else other.results["unit"], options)
    about = other.about[0], f"{'log10 of ' * is_log(name)}{minus}: {in_words}"
    return Made(dataclasses.replace(what, **changed), about, {}, results, {}, look, labels, other.arrows)


def produce(options: Any, output: Path | None, opened: Opened, make: Callable[[], Made]) -> None:
    """Say from where it is seen, make it, write it with a record of what was left out of it, and say what it is."""
    line, style = camera_line(opened.camera, options, opened.center), style_of(options)
    if style.get("axes") and opened.camera.is_perspective:
        raise UsageError("--axes is for parallel rays, as of --view z: in perspective leave it out, for a scale bar")
    say("camera", line)
    started = time.perf_counter()
    made = make()
    seconds = time.perf_counter() - started
    if output is not None:
        _write(made, output, opened, options, style)
        say(made.about[0], f"{output}{made.about[1] and ', '}{made.about[1]}")
    say_all(made.said.items())
    say("time", time_line(made.stats, seconds))
    size = [opened.camera.width, opened.camera.height]
    report(camera=line, size=size, seconds={"total": seconds, **made.stats.get("seconds", {})}, **made.results)
    if output is not None:
        written(output)
        tell_if_unseen(options.command, output, made.colors)


def _write(made: Made, output: Path, opened: Opened, options: Any, style: dict[str, Any]) -> None:
    pictures = made.what if isinstance(made.what, list) else [made.what]
    what = pictures[0]
    if hasattr(what, "metadata"):
        clips = " ".join(word.removeprefix("--clip=") for word in options.words if word.startswith("--clip="))
        left_out = {"where": options.where, "share": options.share, "clip": clips}
        told = ((f"jaxsph.{name}", value) for name, value in left_out.items() if value)
        what = dataclasses.replace(what, metadata=(*what.metadata, *told))
    is_picture = made.look is not None and output.suffix.lower() in FIGURES
    if is_picture and has_key(options):
        camera = getattr(what, "camera", opened.camera)  # of a slice its own
        figure = image_figure([what, *pictures[1:]], opened.scene, camera, labels=made.labels, **style | dict(made.look or {}))
        if made.arrows:  # in the unit of the panel whose arrows are longest
            *_, name, unit, factor = min(made.arrows, key=lambda one: one[-1])
            right, up = (factor * np.stack([one[which] for one in made.arrows]) for which in range(2))
            draw_arrows(figure.axes, right, up, name, unit)
        whole, one = {str(name): str(value) for name, value in what.metadata}, {".pdf": "Keywords", ".svg": "Description"}
        named = one.get(output.suffix.lower())
        say("figure", told_of_size(figure, opened.camera))
        write_figure(figure, output, metadata=whole if named is None else {named: "; ".join(map(" = ".join, whole.items()))})
    elif "background" in style and (is_picture or isinstance(what, Image)):
        image = what if isinstance(what, Image) else what.image(**made.look or {})
        write_image(output, image, background=style["background"])
    elif made.save is None:
        look = made.look or {}
        what.save(output, **(look if is_picture or "transfer" in look else {}))
    else:
        made.save(what, output)


def ends_said(values: Any, labels: Labels, unit: str, options: Any) -> tuple[dict[str, Any], str]:
    """Lowest and highest of values and their unit, which is that of a figure's key, or else `unit`: as results, and in words."""
    logs, found = is_log(labels.quantity), np.asarray(values, np.float64)
    if has_key(options):
        found, unit = found + math.log10(labels.factor) if logs else found * labels.factor, labels.unit
    unit = f"log10({unit})" if logs and unit else unit
    ends = {"lowest": found.min(initial=np.inf), "highest": found.max(initial=-np.inf), "unit": unit or "1"}
    return ends, f"{span(found)} {units_of(unit)}".rstrip()


def told_of_size(figure: Any, camera: Camera) -> str:
    """How large a figure is, how many pixels an inch its picture has, and how it has as many as journals ask for."""
    inches, (wide, tall) = figure.axes[0].get_window_extent().width / figure.dpi, figure.get_size_inches()
    said = f"{wide:.2f} x {tall:.2f} inches, {camera.width / inches:.0f} pixels an inch"
    width = math.ceil(JOURNALS * inches)
    height = math.ceil(width * camera.height / camera.width)
    return said if camera.width >= width else f"{said}; --size {width}x{height} has the {JOURNALS} that journals ask for"


def style_of(options: Any) -> dict[str, Any]:
    """What is said of how a figure looks, as `image_figure` takes it."""
    asked = {name: getattr(options, name, None) for name in ("title", "axes", "background", "dpi", "font_size", "target")}
    return {name: value for name, value in asked.items() if value is not None}


def output_of(options: Any, what: str, suffixes: Sequence[str], default: str) -> Path:
    """Where to write, here unless asked; known before the work to be written, and to hold a key where there is one."""
    first = options.source or next(one.file for one in (*options.volume, *options.points))
    shown = next((f"_{one}" for one in ("panels", "difference") if getattr(options, one, False)), "")
    output: Path = options.output or Path(f"{stem_of(first if isinstance(first, str) else first[0])}{shown}{default}")
    require_writable(output, what, suffixes)
    is_figure_file = output.suffix.lower() in FIGURES
    if not is_figure_file and options.background != "transparent":
        why = f"{options.background} is for .png, .pdf and .svg; EXR holds alpha, over which any background can be put"
        refuse(options, ("background",), why)
    if is_figure_file and has_key(options):
        require_figure(output)
    return output


def is_figure(output: Path | None) -> bool:
    """Whether a file is one of lines and letters, whatever else is said."""
    return output is not None and output.suffix.lower() in VECTORS


def has_key(options: Any) -> bool:
    """Whether a key is to be drawn."""
    return is_figure(getattr(options, "output", None)) or any(is_given(name, getattr(options, name, None)) for name in OF_FIGURES)


def require_figure(output: Path, suffixes: tuple[str, ...] = FIGURES) -> None:
    """Know before the work that a figure can be drawn and written."""
    require_writable(output, "a figure is written as", suffixes)
    require("matplotlib", "figures", "color")
