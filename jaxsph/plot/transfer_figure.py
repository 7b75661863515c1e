"""A figure of a transfer function: colours and extinction, over the histogram of what rays really meet.

Flow: TransferFunction, scene, camera -> met -> [transfer_figure] -> figure of matplotlib's.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxsph.analysis.visibility import VisibilityHistogram, visibility_histogram
from jaxsph.io.damage import require
from jaxsph.io.units import Labels
from jaxsph.model.camera.camera import Camera
from jaxsph.model.preview.glimpse import extinction_at
from jaxsph.model.scene import Scene
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.plot.bars import STEPS, Axis, canvas

SIZE, DOTS_AN_INCH = (8.0, 5.0), 110
DARK, GRAY = "#222222", "#8a8a8a"
MARGIN = 0.02  # of the axis, beyond the first and last value shown
ABOVE_AXIS = 1.13  # of the height of the axes, where there are numbers above them
MARKED = 32  # control points that are marked one by one


def transfer_figure(
    transfer: TransferFunction,
    scene: Scene | None = None,
    camera: Camera | None = None,
    *,
    labels: Labels | str = "quantity",
    title: str = "",
    rays: int = 2000,
    bins: int = 96,
) -> Any:
    """Draw a transfer function; with a scene and a camera, over the histogram of what rays meet.

    Bars are light that is absorbed, in the colours of the values that absorb it, so that a bar that is not seen stands for what
    is not seen in the picture. The gray line is the path length itself, whatever hides it: where it is high and the bars are
    low, values are there, but transparent or hidden. Both are told as shares of their sum.

    Args:
        transfer: one of the scene's own, or another for its particles (without particles, its first volume).
        scene, camera: see `jaxsph.visibility_histogram`; without them the function alone is drawn.
        labels: see `jaxsph.io.labels_of`; or the name of the quantity, in code units.
        title: above the figure.
        rays, bins: of the histogram.

    Returns:
        A `matplotlib.figure.Figure` (no display is needed): `figure.savefig("transfer.png")`.

    Raises:
        ImportError: matplotlib is not installed.
        ValueError: a scene without a camera, or what `jaxsph.visibility_histogram` refuses.
    """
    require("matplotlib", "figures of transfer functions", "color")
    if (scene is None) != (camera is None):
        raise ValueError("`scene` and `camera` go together; give both, or neither for the function alone")
    found = None if scene is None or camera is None else _met(transfer, scene, camera, rays, bins)
    labels = Labels.of(labels)
    axis = Axis(transfer, labels.quantity, labels.unit, labels.factor)
    figure = canvas(SIZE, DOTS_AN_INCH, title)
    upper, strip = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (9, 1)})
    low, high = _limits(axis, found)
    axis.apply(strip, "x", low, high)
    _draw_strip(strip, axis, low, high)
    if found is not None:
        _draw_histogram(upper, axis, found)
    right = upper if found is None else upper.twinx()
    if scene is not None and scene.particles is not None and len(scene.particle_set.quantities) > 1:
        right = _draw_extinction_alone(right, Axis(transfer.parts()[-1], labels.opacity))
    else:
        _draw_extinction(right, axis, low, high)
    _legend(upper, right, found is not None, ABOVE_AXIS if right.xaxis.get_label_text() else 1)
    return figure


def _met(transfer: TransferFunction, scene: Scene, camera: Camera, rays: int, bins: int) -> VisibilityHistogram:
    """Of the part that has this function; of the first part under it where none has."""
    looks = scene.looks
    number = next((number for number, look in enumerate(looks) if look is transfer), None)
    if number is not None:
        return visibility_histogram(scene, camera, rays=rays, bins=bins, part=number)
    if scene.transfer is not None:
        return visibility_histogram(dataclasses.replace(scene, transfer=transfer), camera, rays=rays, bins=bins)
    if not looks:
        raise ValueError("`scene` must have particles or a volume for a histogram; leave out `scene` and `camera`")
    shown = transfer if len(looks) == 1 else (transfer, *looks[1:])
    return visibility_histogram(dataclasses.replace(scene, volume_transfer=shown), camera, rays=rays, bins=bins)


def _limits(axis: Axis, found: VisibilityHistogram | None) -> tuple[float, float]:
    """What the axis reaches over: all that is drawn, and a margin."""
    scale = axis.scale
    ends = scale.values[[0, -1]] if found is None else axis.shown(found.edges[[0, -1]])
    low, high = scale.place(ends)
    if scale.name == "even":
        return float(ends[0]), float(ends[1])
    margin = MARGIN * (high - low)
    low, high = scale.value(np.array([low - margin, high + margin]))
    return float(low), float(high)


def _places(axis: Axis, low: float, high: float) -> np.ndarray:
    """Edges of steps, numbers on the axis."""
    first, last = axis.scale.place(np.array([low, high]))
    return axis.scale.value(np.linspace(first, last, STEPS + 1))


def _draw_strip(strip: Any, axis: Axis, low: float, high: float) -> None:
    edges = _places(axis, low, high)
    strip.pcolormesh(edges, [0, 1], axis.colors((edges[1:] + edges[:-1]) / 2)[None], rasterized=True)
    strip.set_yticks([])
    strip.set_xlabel(axis.title)
    values = axis.shown(np.asarray(axis.transfer.values))
    if len(values) <= MARKED:
        strip.plot(values, np.full(len(values), 1.0), "v", color=DARK, markersize=4, clip_on=False, zorder=3)


def _draw_histogram(upper: Any, axis: Axis, found: VisibilityHistogram) -> None:
    edges = axis.shown(found.edges)
    middles = axis.shown(found.middles)
    absorbed, there = (share / max(share.sum(), np.finfo(float).tiny) for share in (found.absorbed, found.there))
    colors = axis.colors(middles)
    upper.bar(edges[:-1], absorbed, np.diff(edges), align="edge", color=colors, edgecolor=DARK, linewidth=0.3)
    upper.stairs(there, edges, color=GRAY, linewidth=1.3, label="there: path length")
    upper.set_ylabel("share")
    upper.set_ylim(0, 1.08 * max(float(absorbed.max()), float(there.max()), float(np.finfo(float).tiny)))


def _draw_extinction(right: Any, axis: Axis, low: float, high: float) -> None:
    shown = np.union1d(_places(axis, low, high), axis.shown(np.asarray(axis.transfer.values)))
    extinction = extinction_at(axis.transfer, axis.quantity(shown))
    right.plot(shown, extinction, color=DARK, linewidth=1.6, label="extinction")
    right.set_ylim(0, 1.08 * max(float(extinction.max()), float(np.finfo(float).tiny)))
    right.set_ylabel("extinction, per length unit")
    right.tick_params(axis="x", labelbottom=False)


def _draw_extinction_alone(right: Any, axis: Axis) -> Any:
    """Over the quantity that it is looked up by, on an axis above, whose axes are returned."""
    above = right.twiny()
    low, high = (float(end) for end in axis.scale.values[[0, -1]])
    axis.apply(above, "x", low, high)
    _draw_extinction(above, axis, low, high)
    right.set_ylabel(above.get_ylabel())
    above.set_xlabel(f"extinction by {axis.title}")
    above.tick_params(axis="x", labelbottom=False, labeltop=True)
    return above


def _legend(upper: Any, right: Any, with_bars: bool, height: float) -> None:
    """Above the axes, so that it hides nothing."""
    from matplotlib.patches import Patch

    handles, labels = right.get_legend_handles_labels()
    if with_bars:
        more, names = upper.get_legend_handles_labels()
        bars = Patch(facecolor="#c8c8c8", edgecolor=DARK, linewidth=0.5)
        handles, labels = [bars, *more, *handles], ["seen: light absorbed, in its colours", *names, *labels]
    upper.legend(handles, labels, loc="lower left", bbox_to_anchor=(0, height), ncols=3, frameon=False, fontsize="small")
