"""What commands share: what they refuse, and what they tell a person of particles, cameras, pictures and time.

Flow: options, particles, camera, image -> [console] -> lines of text, a progress bar.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib.util
import os
import sys
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.monitoring
import numpy as np

from jaxsph.cli.voice import UsageError, name_of, notice, report, result, say, say_all, tell
from jaxsph.engine.runtime.kept import ENABLED, keep
from jaxsph.engine.runtime.programs import PROGRAMS
from jaxsph.io import ParticleTable, Report
from jaxsph.io.replace import refuse_input
from jaxsph.model.camera.camera import Camera
from jaxsph.model.camera.directions import VIEWS
from jaxsph.model.camera.path import middle
from jaxsph.numerics.checks import Progress

SCENE = "scene:"  # what the name of a built-in scene begins with
MISS = "/jax/compilation_cache/cache_misses"
DARK, BRIGHT, NEARLY_ALL = 0.05, 0.95, 0.99


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


def given_of(options: Any) -> dict[str, Any]:
    """Values that say another thing than where nothing is said, by the names of their options."""
    values = ((one.name, getattr(options, one.name), one.default) for one in dataclasses.fields(options))
    return {name: value for name, value, usual in values if value != usual and (is_given(name, value) or usual is not None)}


def refuse_others(options: Any, known: Collection[str], why: str) -> None:
    """Raise `UsageError` where an option is given that is not `known`."""
    for name in given_of(options):
        if name not in known:
            raise UsageError(f"{name_of(name)} {why}")


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


def stem_of(source: str) -> str:
    """The name of a picture: that of its source, without a suffix; a number behind a point is none, as in `snap.00001`."""
    if source.startswith(SCENE):
        return source.split(":")[1]
    path = Path(source)
    return path.name if path.suffix[1:].isdecimal() else path.stem


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
    """Tell of pictures, (..., 3) in [0, 1] over black, almost all black or white, and what to try; whether it did."""
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
    if not sys.stderr.isatty() or importlib.util.find_spec("tqdm") is None:
        yield None
        return
    from tqdm import tqdm

    with tqdm(desc=what, unit=unit, leave=False, file=sys.stderr) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


def say_report(report: Report, support: Any = None, known: Collection[str] = ()) -> None:
    """Say what was settled of supports, their range where it is known, of volumes and of the kernel; notes but those `known`."""
    say("support", report.support if support is None else f"{span(support)}: {report.support}")
    if report.volume:
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


def units_of(unit: str) -> str:
    """What numbers are in, as it stands behind them: a unit with a number of its own is one of a code."""
    return "" if unit in ("", "1") else f"in units of {unit}" if unit[0].isdigit() else f"in {unit}"


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
        ahead = camera.exact_axes()[2]
        view = said.get("view") or next((name for name, (along, _) in VIEWS.items() if np.array_equal(along, ahead)), None)
        seen = view if isinstance(view, str) else place("view", 0.0 - ahead)
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
