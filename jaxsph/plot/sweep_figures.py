"""Figures of a sweep: error over tolerance, time over error, and both along a sequence of frames.

Flow: rows of a sweep -> [figures] -> error.png, pareto.png, integral.png, frames.png.

Drawn with matplotlib, which is optional. Where a sweep has several frames, errors are the largest and times the means of them.
Times are shares of what full rate took in the same turns, as a busy machine is slow for both.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxsph.io.damage import require
from jaxsph.io.replace import write_figure
from jaxsph.model.settings import estimates
from jaxsph.plot.bars import canvas, ticks_of_decades
from jaxsph.trade.sweep import FULL_RATE, Row

STYLES = {
    "interval": ("#0072b2", "o", 11.0, (0, 7)),
    "interval relaxed": ("#56b4e9", "s", 8.0, (7, -10)),
    "pilot": ("#d55e00", "D", 5.5, (6, 4)),
    "segments": ("#cc79a7", "p", 3.5, (-6, 4)),
}
"""Colours of the estimators (Okabe and Ito's, which all can tell apart), markers and their sizes (what is drawn later is smaller,
so that equal results of two are both seen), and places of labels."""
BASELINE_COLORS = {"samples": "#8a8a8a", "segments": "#7f5a9e", "size": "#a6761d"}
BASELINE_MARKERS = "v^<>PX*h"
DASHES = ("-", "--", ":", "-.")
MIN_SHOWN = 1e-7  # errors below are drawn as this, and labelled 0: a step of float32 near 1
AGAINST_FULL_RATE = {"error": "largest error, against full rate", "away": "largest error, against a converged image"}
AGAINST_INTEGRAL = {
    "mean_integral": "mean error, against the light integral",
    "integral": "largest error, against the light integral",
}
MAX_TICKS = 12
FIGURES = "the figures of a sweep"
SIZE, DOTS_AN_INCH = (9.0, 4.8), 130


def draw(rows: Iterable[Row], folder: str | Path) -> list[Path]:
    """Draw the figures of a sweep of one scene into `folder`; `frames.png` only where there are several frames, `integral.png`
    only where the light integral was taken.

    Returns:
        The paths of what was written.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: nothing to draw, or rows of several scenes.
    """
    require("matplotlib", FIGURES, "color")
    rows = list(rows)
    if len({row["scene"] for row in rows}) != 1:
        found = ", ".join(sorted({row["scene"] for row in rows})) or "nothing"
        raise ValueError(f"`rows` must be of one scene, got {found}; draw each on its own")
    points, title = summary(rows), _title(rows)
    figures = {"error.png": _error(points, title), "pareto.png": _time_over_error(points, title, AGAINST_FULL_RATE)}
    if any(point["integral"] is not None for point in points):
        figures["integral.png"] = _time_over_error(points, title, AGAINST_INTEGRAL)
    if len({row["frame"] for row in rows}) > 1:
        figures["frames.png"] = _frames(rows, _title(rows, summed=False))
    for name, figure in figures.items():
        write_figure(figure, Path(folder) / name)
    return [Path(folder) / name for name in figures]


def summary(rows: Sequence[Row]) -> list[Row]:
    """Of every setting in order, over its frames: largest errors to full rate, to a converged image (`away`) and to the integral,
    largest bound, time over that of full rate; and which of these errors is `kept` within a tolerance.
    """
    points = []
    for method, tolerance in dict.fromkeys((row["method"], row["tolerance"]) for row in rows):
        group = [row for row in rows if (row["method"], row["tolerance"]) == (method, tolerance)]
        of: dict[str, list[Any]] = {name: [row[name] for row in group if row[name] is not None] for name in group[0]}
        point = {"method": method, "tolerance": tolerance, "time": sum(of["total"]) / sum(of["full_total"])}
        point |= {"error": max(of["max_error"]), "away": max(of["max_error_converged"])}
        point |= {"bound": max(of["max_bound"], default=None), "integral": max(of["integral_max"], default=None)}
        point["mean_integral"] = statistics.mean(of["integral_mean"]) if of["integral_mean"] else None
        points.append(point | {"kept": point["integral" if estimates(method) else "error"]})
    return points


def pareto_front(errors: Sequence[float], times: Sequence[float]) -> list[int]:
    """Indices, by error, of what is faster than all that is at most as wrong."""
    front: list[int] = []
    for index in sorted(range(len(errors)), key=lambda i: (errors[i], times[i])):
        if not front or times[index] < times[front[-1]]:
            front.append(index)
    return front


def _title(rows: Sequence[Row], summed: bool = True) -> str:
    first, frames = rows[0], len({row["frame"] for row in rows})
    several = f"{frames} frames, largest error and mean time, " if frames > 1 and summed else ""
    full = float(np.median([row["full_total"] for row in rows]))
    size = "{width} x {height} pixels, {samples} samples".format(**first)
    machine = f"on {first['device']} ({first['cores']} cores), where full rate takes {full:.3g} s a frame"
    return f"{first['scene']}: {first['particles']:,} particles, {size}\n{several}{machine}"


def _canvas(title: str, panels: int, **shared: Any) -> tuple[Any, Any]:
    figure = canvas(SIZE, DOTS_AN_INCH, title)
    axes = np.atleast_1d(figure.subplots(*((panels, 1) if "sharex" in shared else (1, panels)), **shared))
    for axis in axes:
        axis.grid(True, which="major", color="#dddddd", linewidth=0.6)
        axis.set_axisbelow(True)
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _legend(figure: Any, axis: Any, **options: Any) -> None:
    """Outside of the axes, so that it hides nothing."""
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right center", frameon=False, fontsize="small", **options)


def _shown(error: float | None) -> float:
    return max(error or 0.0, MIN_SHOWN)


def _label_zero(axis: Any, errors: Iterable[float | None], which: str) -> None:
    """Name the place where errors that are too small for the scale are drawn."""
    if min((error or 0.0 for error in errors), default=1.0) >= MIN_SHOWN:
        return
    up = which == "y"
    getattr(axis, f"set_{which}lim")(MIN_SHOWN / 2)
    (axis.axhline if up else axis.axvline)(MIN_SHOWN, color="#999999", linewidth=0.8, zorder=0)
    place, turned = ((1.0, MIN_SHOWN), 0) if up else ((MIN_SHOWN, 0.02), 90)
    words: dict[str, Any] = {"ha": "right", "va": "bottom", "rotation": turned, "color": "#777777", "fontsize": "x-small"}
    axis.text(*place, f" at most {MIN_SHOWN:g}", transform=getattr(axis, f"get_{which}axis_transform")(), **words)


def _error(points: Sequence[Row], title: str) -> Any:
    figure, (axis,) = _canvas(title, 1)
    controlled = [point for point in points if point["tolerance"] and point["kept"] is not None]
    tolerances = sorted({point["tolerance"] for point in controlled})
    errors = [point[name] for point in controlled for name in ("kept", "bound")]
    axis.set(xscale="log", yscale="log")  # before its limits: of a linear axis they would start below zero
    if tolerances:
        ends, drawn = (tolerances[0] / 1.5, tolerances[-1] * 1.5), list(map(_shown, errors))
        axis.plot(ends, ends, color="black", linewidth=1, label="error = tolerance")
        top = max(4 * tolerances[-1], 2 * max(drawn))
        axis.fill_between(ends, ends, [top] * 2, color="#f4d9d0", linewidth=0, label="over the tolerance")
        axis.set(xlim=ends, ylim=(min(*drawn, ends[0]) / 2, top))
    for method in STYLES:
        row = sorted((point for point in controlled if point["method"] == method), key=lambda point: point["tolerance"])
        style = {**_look(method, points), "clip_on": False, "linewidth": STYLES[method][2] / 3}
        hollow = {"linestyle": "--", "markerfacecolor": "white"}
        name = "bound" if method == "interval" else "estimate"
        for what, label, how in (("kept", "error", {}), ("bound", name, hollow)) if row else ():
            x, y = ([point["tolerance"] for point in row], [_shown(point[what]) for point in row])
            axis.plot(x, y, label=f"{method}: {label}", **style | how)
    of_others = "\n(segments: the light integral)" if any(estimates(point["method"]) for point in controlled) else ""
    axis.set(xlabel="tolerance", ylabel=f"largest error of a pixel, against full rate{of_others}")
    axis.set_xticks(tolerances, [f"{tolerance:g}" for tolerance in tolerances], minor=False)
    axis.set_xticks([], minor=True)
    _label_zero(axis, errors, "y")
    _legend(figure, axis)
    return figure


def _time_over_error(points: Sequence[Row], title: str, panels: dict[str, str]) -> Any:
    """Two panels: attributes of points, and what each is."""
    figure, axes = _canvas(title, 2, sharey=True)
    for axis, (name, against) in zip(axes, panels.items(), strict=True):
        none = FULL_RATE if name == "error" else None  # which full rate has none of
        shown = [point for point in points if point[name] is not None and point["method"] != none]
        errors = [_shown(point[name]) for point in shown]
        axis.axhline(1, color="black", linewidth=0.8, linestyle=":", label="time of full rate")
        front = pareto_front(errors, [point["time"] for point in shown])
        x, y = [errors[i] for i in front], [shown[i]["time"] for i in front]
        axis.plot(x, y, color="#009e73", linewidth=5, alpha=0.25, drawstyle="steps-post", label="Pareto front", zorder=1)
        for method in dict.fromkeys(point["method"] for point in shown):
            own = [(error, point["time"]) for point, error in zip(shown, errors, strict=True) if point["method"] == method]
            axis.plot(*zip(*own, strict=True), linestyle="none", label=method, **_look(method, points))
        axis.margins(x=0.15)  # room for the labels
        _label_tolerances(axis, shown, errors)
        axis.set(xscale="log", xlabel=against)
        _label_zero(axis, [point[name] for point in shown], "x")
    axes[0].set_ylabel("time of a frame, over that of full rate")
    axes[0].set_ylim(0, 1.1 * max(1.0, *(point["time"] for point in points)))
    ticks_of_decades(axes[1].xaxis, *sorted(axes[1].xaxis.get_view_interval()))
    _legend(figure, axes[1], title="numbers: tolerance")
    return figure


def _label_tolerances(axis: Any, points: Sequence[Row], errors: Sequence[float]) -> None:
    """Write tolerances beside the points, those of one estimator that lie together as one."""
    places: dict[tuple[str, int, int], list[tuple[float, float, str]]] = {}
    for point, error in zip(points, errors, strict=True):
        if point["tolerance"] is not None:
            near = (point["method"], round(4 * np.log10(error)), round(10 * point["time"]))
            places.setdefault(near, []).append((error, point["time"], f"{point['tolerance']:g}"))
    for (method, *_), found in places.items():
        error, time, _ = found[0]
        color, _, _, (right, up) = STYLES[method]
        style: dict[str, Any] = {"fontsize": "x-small", "color": color, "ha": "left" if right > 0 else "center"}
        text = ", ".join(tolerance for *_, tolerance in found)
        axis.annotate(text, (error, time), textcoords="offset points", xytext=(right, up), **style)


def _look(method: str, points: Sequence[Row]) -> dict[str, Any]:
    if method in STYLES:
        return dict(zip(("color", "marker", "markersize"), STYLES[method], strict=False))
    if method == FULL_RATE:
        return {"color": "black", "marker": "o", "markersize": 8}
    baselines = list(dict.fromkeys(p["method"] for p in points if p["method"] not in STYLES and p["method"] != FULL_RATE))
    color = BASELINE_COLORS[method.partition("/")[0]]
    return {"color": color, "markersize": 7, "marker": BASELINE_MARKERS[baselines.index(method) % len(BASELINE_MARKERS)]}


def _frames(rows: Sequence[Row], title: str) -> Any:
    figure, (errors, times) = _canvas(title, 2, sharex=True)
    points = summary(rows)
    tolerances = sorted({row["tolerance"] for row in rows if row["tolerance"] is not None})
    for number, limit in enumerate(tolerances):
        errors.axhline(limit, color="#bbbbbb", linewidth=0.8, linestyle=DASHES[number % len(DASHES)])
    for method, tolerance in dict.fromkeys((row["method"], row["tolerance"]) for row in rows):
        own = [row for row in rows if (row["method"], row["tolerance"]) == (method, tolerance)]
        line = sorted(own, key=lambda row: row["frame"] or 0.0)
        moments = [row["frame"] for row in line]
        style: dict[str, Any] = {"linewidth": 1.2, **_look(method, points)}
        style["markersize"] *= 0.7
        if tolerance is not None:
            style["linestyle"] = DASHES[tolerances.index(tolerance) % len(DASHES)]
        label = method if tolerance is None else f"{method}, {tolerance:g}"
        times.plot(moments, [row["total"] / row["full_total"] for row in line], label=label, **style)
        if method != FULL_RATE:
            errors.plot(moments, [_shown(row["max_error"]) for row in line], **style)
    errors.set(yscale="log", ylabel="largest error")
    times.set(xlabel="frame", ylabel="time, over full rate")
    _label_zero(errors, [row["max_error"] for row in rows if row["method"] != FULL_RATE], "y")
    times.set_ylim(bottom=0)
    shown = sorted({row["frame"] or 0.0 for row in rows})
    if len(shown) <= MAX_TICKS:
        times.set_xticks(shown, [f"{moment:g}" for moment in shown])
    _legend(figure, times)
    return figure
