"""Figures of `convergence.py`: error against rays, estimated against true error, and the iterations of a real image."""

from __future__ import annotations

import pathlib
from typing import Any

import numpy as np

COLORS = {"uniform": "#0072b2", "corner_variance": "#e69f00", "hierarchical": "#d55e00"}
LABELS = {"uniform": "uniform grid", "corner_variance": "variance of corners (Levoy)", "hierarchical": "hierarchical"}
MARKERS = {"uniform": "s", "corner_variance": "^", "hierarchical": "o"}
DOTS_AN_INCH = 110


def draw(found: dict[str, Any], images: dict[str, np.ndarray], folder: pathlib.Path) -> None:
    """All of them into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, figure in (("rays", _rays(found, images)), ("leaves", _leaves(found)), ("iterations", _iterations(found))):
        figure.savefig(folder / f"{name}.png", dpi=DOTS_AN_INCH)


def _figure(rows: int, columns: int, width: float, height: float, **shared: Any) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, **shared)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _rays(found: dict[str, Any], images: dict[str, np.ndarray]) -> Any:
    """Error against rays of every field, with its image above."""
    records = found["fields"]
    figure, axes = _figure(2, len(records), 3.4 * len(records), 6.2, height_ratios=(1, 1.3))
    for (above, below), record in zip(axes.T, records, strict=True):
        above.imshow(np.clip(images[record["field"]], 0, 1))
        above.set_axis_off()
        above.set_title(record["field"])
        for kind, stages in record["curves"].items():
            style = {"color": COLORS[kind], "marker": MARKERS[kind], "markersize": 3.5, "linewidth": 1.3, "label": LABELS[kind]}
            below.loglog([stage["rays"] for stage in stages], [stage["error"] for stage in stages], **style)
        below.axhline(found["goal"], color="0.6", linewidth=0.8, linestyle=":")
        below.grid(True, which="major", color="#dddddd", linewidth=0.6)
        below.set(xlabel="rays")
    axes[1, 0].set_ylabel("relative L2 error")
    size = records[0]["size"]
    figure.suptitle(f"Error of colours against rays, {size} x {size} pixels, {found['samples']} samples a ray")
    figure.legend(*axes[1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure


def _leaves(found: dict[str, Any]) -> Any:
    """Estimated over true error of leaves."""
    records = [record for record in found["fields"] if record["leaves"]]
    figure, axes = _figure(1, len(records), 3.2 * len(records), 3.6, sharey=True)
    for axis, record in zip(axes[0], records, strict=True):
        said, true = np.asarray(record["leaves"]["sample"]).T
        axis.loglog(true, np.maximum(said, true.min() / 30), ".", markersize=2, color=COLORS["hierarchical"], rasterized=True)
        ends = true.min(), true.max()
        axis.plot(ends, ends, color="black", linewidth=1)
        axis.set(title=f"{record['field']}\nrank correlation {record['leaves']['spearman']:.2f}", xlabel="true norm of a leaf")
        axis.grid(True, which="major", color="#dddddd", linewidth=0.6)
    axes[0, 0].set_ylabel("estimated")
    return figure


def _iterations(found: dict[str, Any]) -> Any:
    """A real progressive image: error against rays beside the simulation, against time, and where time goes."""
    timed = found["timed"]
    figure, axes = _figure(1, 3, 13.5, 4)
    stages, rays, clock, shares = timed["stages"], *axes[0]
    for of, label, style in ((timed["on_paper"], "simulated", "--"), (stages, "rendered", "-")):
        more = [stage["rays"] - of[0]["rays"] for stage in of]
        rays.plot(more, [stage["error"] for stage in of], style, marker="o", markersize=3, label=f"{label}: true error")
    more = [stage["rays"] - stages[0]["rays"] for stage in stages]
    rays.plot(more, [stage["estimated"] for stage in stages], ":", label="rendered: estimated")
    rays.set(
        xlabel="rays after the first lattice",
        ylabel="relative L2 error",
        yscale="log",
        title=f"{timed['size']} x {timed['size']} pixels",
    )
    rays.legend(frameon=False, fontsize="small")
    spent = np.cumsum([stage["seconds"] for stage in stages])
    clock.plot(spent, [stage["error"] for stage in stages], "-o", markersize=3, label="progressive")
    clock.axvline(timed["every_pixel"], color="black", linewidth=1, label="every pixel")
    clock.set(xlabel="seconds", yscale="log", title="time", xlim=(0, None))
    clock.legend(frameon=False, fontsize="small")
    last = {stage: seconds for stage, seconds in stages[-1]["spent"].items() if seconds > 0}
    shares.barh(list(last), list(last.values()), color=COLORS["hierarchical"])
    shares.set(xlabel="seconds in all", title="where it goes")
    for axis in (rays, clock):
        axis.axhline(found["goal"], color="0.6", linewidth=0.8, linestyle=":")
    return figure
