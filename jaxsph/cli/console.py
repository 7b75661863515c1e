"""What commands share: what they refuse, how what they made is timed, written with its key and record, and told to a person.

Flow: options, what makes it -> [console: produce] -> a file, voice; particles, camera, image -> lines of text, a progress bar.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.monitoring
import numpy as np

from jaxsph.cli.voice import UsageError, name_of, notice, report, result, say, say_all, tell, written
from jaxsph.engine.runtime.kept import ENABLED, keep
from jaxsph.engine.runtime.programs import PROGRAMS
from jaxsph.io import Labels, ParticleTable, Report
from jaxsph.io.damage import require
from jaxsph.io.images.image_files import write_image
from jaxsph.io.opening.opened import Opened
from jaxsph.io.replace import refuse_input, write_figure
from jaxsph.io.settle.quantities import LOG_PREFIX, is_log
from jaxsph.io.units import CODE_UNITS, can_name, named
from jaxsph.model import Camera, Image, TransferFunction
from jaxsph.model.camera.path import middle
from jaxsph.model.projection import Projection
from jaxsph.model.transfer.maps import Scale
from jaxsph.numerics.checks import Progress, array_of
from jaxsph.plot.image_figure import draw_arrows, image_figure

IMAGES = (".exr", ".png")
VECTORS = (".pdf", ".svg")
FIGURES = (".png", *VECTORS)
UNITS = "unit", "length_unit"
OF_FIGURES = ("annotate", *UNITS, "title", "dpi", "font_size", "panels", "contours")  # options that draw a key beside a picture
SCENE = "scene:"  # what the name of a built-in scene begins with
JOURNALS = 300  # pixels an inch of a picture in print
MISS = "/jax/compilation_cache/cache_misses"
DARK, BRIGHT, NEARLY_ALL = 0.05, 0.95, 0.99
DIVERGING, NEARLY, FAINT = "coolwarm", 99.5, 95  # of a difference; percentiles that it spans, of ratios, large where little is
CONTOURS = 5  # levels


@contextlib.contextmanager
def wrong_usage(before: str = "", of: type[Exception] = ValueError) -> Iterator[None]:
    """What is refused in the block is wrong usage; `before` stands before what is said of it."""
    try:
        yield
    except of as error:
        raise UsageError(f"{before}{error}") from error


def is_given(name: str, value: Any) -> bool:
    """Whether the value of an option says another thing than where nothing is said."""
    return value is not None and value is not False and value != () and (name, value) != ("box", "file")


def refuse(options: Any, names: Sequence[str], why: str) -> None:
    """Raise `UsageError` where an option is given that is for something else."""
    for name in names:
        if is_given(name, getattr(options, name, None)):
            raise UsageError(f"{name_of(name)} {why}")


def require_writable(path: Path, must_be: str, suffixes: Sequence[str]) -> None:
    """Know before the work that its result can be written after it."""
    if path.suffix.lower() not in suffixes:
        raise UsageError(f"{path}: {must_be} {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: there is no folder {path.parent} to write it to; make it first")
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        raise ValueError(f"{path}: cannot be written; choose another place with -o")
    with wrong_usage():
        refuse_input(path)


@contextlib.contextmanager
def warnings_in_lines(command: str, hushed: Callable[[str], bool]) -> Iterator[None]:
    """Warnings as lines of the command's own, but for those that are `hushed`.

    NumPy's on arithmetic are left out: what comes of it is checked, and refused by name.
    """

    def told(message: Any, *_: Any, **__: Any) -> None:
        if not hushed(str(message)):
            tell(command, str(message))

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = told
        yield


def tell_of_compiling(*, no_cache: bool) -> None:
    """Say once, on stderr, that programs are being compiled; and have them kept for the next command, if that is wanted."""
    if no_cache:
        jax.config.update(ENABLED, False)
    kept, why = keep(), "--no-cache: " if no_cache else ""
    more = "once, as it is kept for the next command" if kept else f"{why}the next command will compile it again"
    told = functools.cache(lambda: notice(f"compiling for frames of this kind: {more}"))
    if kept:
        jax.monitoring.register_event_listener(lambda event, **_: told() if event == MISS else None)
    else:
        PROGRAMS.on_compile = told


def tell_if_unseen(command: str, output: Any, colors: Sequence[Any]) -> bool:
    """Tell of pictures, (..., 3) in [0, 1] over black, that are almost all black, or almost all white, and what to try.

    Returns whether it did.
    """
    told = False
    shown = [np.asarray(color, np.float64).reshape(-1, 3) for color in colors]
    dark = [float((color.max(-1) < DARK).mean()) for color in shown if len(color)]
    bright = [float((color.min(-1) > BRIGHT).mean()) for color in shown if len(color)]
    for shares, what, remedy in (
        (dark, f"nearly black, darker than {DARK:.0%}", "a larger --exposure, --opacity-by log10:NAME, or another camera"),
        (bright, f"nearly white, brighter than {BRIGHT:.0%}", "a smaller --exposure, or another --range or --colormap"),
    ):
        if shares and min(shares) >= NEARLY_ALL:
            share = f"{min(shares):.4g}"
            tell(command, f"{output}: {'all' if share == '1' else share} of the pixels are {what}; try {remedy}")
            told = True
    return told


def largest(layer: Any) -> float:
    """Largest number of a layer, 0 of none."""
    return float(np.asarray(layer).max(initial=0))


@contextlib.contextmanager
def progress(what: str, unit: str = " bands") -> Iterator[Progress | None]:
    """A progress bar on stderr where a person watches and tqdm is there, else `None`."""
    try:
        from tqdm import tqdm
    except ImportError:
        yield None
        return
    if not sys.stderr.isatty():
        yield None
        return
    with tqdm(desc=what, unit=unit, leave=False, file=sys.stderr) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def say_report(report: Report, support: Any = None, known: Collection[str] = ()) -> None:
    """Say what was settled of supports, their range where it is known, of volumes and of the kernel; notes but those `known`."""
    say("support", report.support if support is None else f"{span(support)}: {report.support}")
    say("volume", report.volume)
    say("kernel", report.kernel)
    say_notes(note for note in report.notes if note not in known)


def say_notes(notes: Iterable[str]) -> None:
    """A line for each."""
    say_all(("note", note) for note in notes)


def span(values: Any) -> str:
    """Range of numbers as text."""
    values = np.asarray(values, np.float64)
    if not values.size:
        return "nothing"
    low, high = values.min(), values.max()
    return f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"


def ranges(column: np.ndarray) -> str:
    """Range of a scalar, or of each component of a vector; what is not finite is counted, not hidden."""
    columns = np.atleast_2d(column.T).astype(np.float64)
    finite = [part[np.isfinite(part)] for part in columns]
    odd = columns.size - sum(part.size for part in finite)
    return " | ".join(span(part) for part in finite) + (f" ({odd} not finite)" if odd else "")


def attributes(table: ParticleTable) -> None:
    """Say the columns of a table: name, shape, type and range."""
    for sentence in table.conventions:
        result(f"  {sentence}")
    result("")
    rows = [("attribute", "shape", "type", "range")]
    for name, column in (("position", table.position), *table.columns.items()):
        rows.append((name, " x ".join(map(str, column.shape)), str(column.dtype), ranges(column)))
    report(attributes=[dict(zip(rows[0], row, strict=True)) for row in rows[1:]], particles=len(table))
    widths = [max(len(row[i]) for row in rows) for i in range(3)]
    for row in rows:
        result("  " + "  ".join(cell.ljust(width) for cell, width in zip(row, (*widths, 0), strict=True)).rstrip())


def camera_line(camera: Camera, options: Any = None, center: Any = None) -> str:
    """The options that give this camera again, as they were given, or with its `center`, and its depths; of parallel rays, where
    they are.
    """
    said = {} if options is None else vars(options)

    def place(name: str, found: Any = None) -> str:
        given = said.get(name)
        if given is None or isinstance(given, str):
            return ",".join(f"{value:.{5 if camera.is_perspective else 6}g}" for value in found)
        return ",".join(f"{value:.12g}" for value in given)

    if camera.is_perspective:
        fov = 2 * np.degrees(np.arctan(float(camera.half_height)))
        how = f"--eye {place('eye', camera.exact_eye())} --target {place('target', middle(camera))} --fov {fov:.4g}"
    else:
        wide = 2 * float(camera.half_height) * camera.width / camera.height
        view = "z" if said.get("view") is None else said["view"]
        seen = view if isinstance(view, str) else place("view")
        how = f"--view {seen} --center {place('center', middle(camera) if center is None else center)} --width {wide:.6g}"
    up = "" if said.get("up") is None else f" --up {place('up')}"
    return f"{how}{up}, depths {float(camera.near):.5g} to {float(camera.far):.5g}"


def time_line(stats: Mapping[str, Any], elapsed: float) -> str:
    """Seconds by stage, and kernel evaluations where these were counted."""
    parts = ", ".join(f"{name} {value:.2f}" for name, value in stats.get("seconds", {}).items() if value > 0)
    line = f"{elapsed:.2f} s" + (f" ({parts})" if parts else "")
    if "evaluations" not in stats:
        return line
    spent, full = float(stats["evaluations"]), float(stats["evaluations_full"])
    of = "" if spent == full else f" of {full / 1e6:,.1f} M"
    return f"{line}; {spent / 1e6:,.1f} M{of} kernel evaluations"


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
        arrows: that are drawn over a figure, for each panel.
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
    """Draw a file, or several in one figure, each seen as the first is.

    `opening` takes options of one file, and how it is to be seen if not by itself; gives how it is, and what makes its picture.

    Raises:
        UsageError, ValueError: what cannot be drawn; of several files the message says which.
    """
    sources = options.source if isinstance(options.source, list) else [options.source]
    if len(sources) > 1 and options.panels and options.title and options.title.count(";") + 1 != len(sources):
        raise UsageError(f"--title must name each of {len(sources)} panels, with ; between, got {options.title!r}")

    def opened_of(source: str, like: Opened | None) -> tuple[Opened, Callable[[], Made]]:
        try:
            opened, make = opening(dataclasses.replace(options, source=source), like)
            if like is not None and opened.measures != like.measures:
                own, first = (", ".join(text or CODE_UNITS for text in one.measures) for one in (opened, like))
                raise ValueError(f"units must be those of {sources[0]}, {first}; got {own} (--unit has values in one)")
        except (UsageError, ValueError) as error:
            if len(sources) == 1 or source in str(error):
                raise
            raise (UsageError if isinstance(error, UsageError) else ValueError)(f"{source}: {error}") from error
        return opened, make

    opened, make = opened_of(sources[0], None)

    def make_all() -> Made:
        made = [make()]
        for nth, source in enumerate(sources[1:], 2):
            say("", f"{nth} of {len(sources)}: {source}, seen as {sources[0]} is")
            made.append(opened_of(source, opened)[1]())
        return _joined(made, sources, options)

    produce(options, output, opened, make_all)


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
    levels = factor * (np.geomspace if log else np.linspace)(*ends, CONTOURS + 2)[1:-1]
    levels = np.unique([float(f"{level:.2g}") for level in levels])
    say("contours", f"of {name} at {', '.join(f'{level:g}' for level in levels)} {unit}")
    return first._replace(look={**(first.look or {}), "contours": (factor * values, levels)})


def _look_of_all(made: Sequence[Made], options: Any) -> dict[str, Any]:
    """The first's, a transfer function of it over what those of all span, unless it was asked for, or is by its own quantity."""
    look, *_ = looks = [dict(one.look or {}) for one in made]
    is_asked = options.range is not None or options.transfer is not None
    if "transfer" in look and not is_asked and (scale := Scale.of(look["transfer"].values)).name != "even":
        values = [np.asarray(one["transfer"].values, np.float64)[[0, -1]] for one in looks]
        laid = Scale(scale.name, np.array([np.min(values), np.max(values)])).value(scale.place(look["transfer"].values))
        look["transfer"] = dataclasses.replace(look["transfer"], values=array_of(laid, look["transfer"].values.dtype))
    return look


def _difference(one: Made, other: Made, called: Sequence[str], options: Any) -> Made:
    """The other minus the one, or by logarithms their ratio, in colours about none."""
    what, name, is_ratio = other.what, other.labels.quantity, options.norm == "log"
    before, after = (np.asarray(each.what.values, np.float64) for each in (one, other))
    if is_ratio:
        before, after = (np.log10(np.where(values > 0, values, np.nan)) for values in (before, after))
    values, logs = after - before, is_ratio or is_log(name)
    if not (found := values[np.isfinite(values)]).size:
        raise ValueError("no pixel has values of both files: ask for a --center and a --width in which there are")
    most = float(np.percentile(np.abs(found), FAINT if is_ratio else NEARLY)) or float(np.abs(found).max()) or 1.0
    ends = tuple(map(float, (-most, most) if options.range is None else np.log10(options.range) if is_ratio else options.range))
    name = f"{LOG_PREFIX}ratio.{name.removeprefix(LOG_PREFIX)}" if logs else f"difference.{name}"
    minus = f" {'over' if logs else 'minus'} ".join(called[::-1]).replace("\n", " ")
    metadata = *(pair for pair in what.metadata if not (logs and pair[0] == "jaxsph.unit")), ("jaxsph.difference", minus)
    changed, colormap = {"values": values.astype(what.values.dtype), "metadata": metadata}, options.colormap or DIVERGING
    look: dict[str, Any] = {"colormap": colormap, "norm": "linear", "range": ends}
    if isinstance(what, Projection):
        changed |= {"name": name, "unit": "" if logs else what.unit}
    else:
        look = {"transfer": TransferFunction.from_colormap(colormap, ends, 1.0)}
    unit, factor = ("", 1.0) if logs else (other.labels.unit, other.labels.factor)
    labels = dataclasses.replace(other.labels, quantity=name, moment=minus, unit=unit, factor=factor)
    results, about = {"lowest": found.min(), "highest": found.max()}, f"{minus}: {span(10.0**found if logs else found)}"
    return Made(dataclasses.replace(what, **changed), (other.about[0], about), {}, results, {}, look, labels, other.arrows)


def produce(options: Any, output: Path | None, opened: Opened, make: Callable[[], Made]) -> None:
    """Say from where it is seen, make it, write it with a record of what was left out of it, and say what it is."""
    line, style = camera_line(opened.camera, options, opened.center), style_of(options)
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
        for axes, arrows in zip(figure.axes, made.arrows, strict=False):
            draw_arrows(axes, *arrows)
        whole, one = {str(name): str(value) for name, value in what.metadata}, {".pdf": "Keywords", ".svg": "Description"}
        named = one.get(output.suffix.lower())
        say("figure", told_of_size(figure, opened.camera))
        write_figure(figure, output, metadata=whole if named is None else {named: "; ".join(map(" = ".join, whole.items()))})
    elif is_picture and "background" in style:
        image = what if isinstance(what, Image) else what.image(**made.look or {})
        write_image(output, image, background=style["background"])
    elif made.save is None:
        look = made.look or {}
        what.save(output, **(look if is_picture or "transfer" in look else {}))
    else:
        made.save(what, output)


def told_of_size(figure: Any, camera: Camera) -> str:
    """How large a figure is, how many pixels an inch its picture has, and how it has as many as journals ask for."""
    inches, (wide, tall) = figure.axes[0].get_window_extent().width / figure.dpi, figure.get_size_inches()
    said = f"{wide:.2f} x {tall:.2f} inches, {camera.width / inches:.0f} pixels an inch"
    width = math.ceil(JOURNALS * inches)
    height = math.ceil(width * camera.height / camera.width)
    return said if camera.width >= width else f"{said}; --size {width}x{height} has the {JOURNALS} that journals ask for"


def style_of(options: Any) -> dict[str, Any]:
    """What is said of how a figure looks, as `image_figure` takes it."""
    asked = {name: getattr(options, name, None) for name in ("title", "background", "dpi", "font_size", "target")}
    return {name: value for name, value in asked.items() if value is not None}


def output_of(options: Any, what: str, suffixes: Sequence[str], default: str, *, of_pictures: str = "") -> Path:
    """Where to write, known before the work to be possible: as asked for, else called as what is shown, here.

    Raises `UsageError`: a file that cannot hold what is asked for, as options of figures and those that are `of_pictures`.
    """
    first = options.source or next(one.file for one in (*options.volume, *options.points))
    shown = next((f"_{one}" for one in ("panels", "difference") if getattr(options, one, False)), "")
    output: Path = options.output or Path(f"{stem_of(first if isinstance(first, str) else first[0])}{shown}{default}")
    require_writable(output, what, suffixes)
    if output.suffix.lower() not in FIGURES:
        refuse(options, of_pictures.split(), "is for a picture: name one with -o OUT.png")
        if options.background != "transparent":
            why = f"{options.background} is for .png, .pdf and .svg; EXR holds alpha, over which any background can be put"
            refuse(options, ("background",), why)
    if has_key(options) and (not of_pictures or output.suffix.lower() in FIGURES):
        require_figure(output)
    return output


def stem_of(source: str) -> str:
    """The name of a picture: that of its source, without a suffix; a number behind a point is none, as in `snap.00001`."""
    if source.startswith(SCENE):
        return source.split(":")[1]
    path = Path(source)
    return path.name if path.suffix[1:].isdecimal() else path.stem


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
