"""A pixel explained as a figure: what is along the ray over depth, and the error budget beside it.

Flow: Explanation -> [pixel_figure] -> figure of matplotlib's.
"""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np

from jaxsph.io.damage import require
from jaxsph.plot.bars import canvas, in_lines, symbol

SIZE, DOTS_AN_INCH = (9.0, 5.4), 110
DARK, GRAY, BLUE, RED = "#222222", "#6b6b6b", "#2b6cb0", "#c05621"
SHARES = 2.4, 1  # of the width: the ray, the budget
LEAST_BARS, PARTICLES = 4, 10  # that there is room for
LETTERS = 40  # of a line beside the bars
MARGIN = 1.35  # times the largest share, for its number beside it


def pixel_figure(made: Any, quantity: str, title: str) -> Any:
    """Of an `Explanation`; see `Explanation.figure`."""
    require("matplotlib", "figures of a pixel", "color")
    row, column = made.pixel
    figure = canvas(SIZE, DOTS_AN_INCH, f"{title}{', ' if title else ''}pixel {row} {column}, alpha {made.alpha:.3f}")
    halves: Any = figure.subfigures(1, 2, width_ratios=SHARES)
    _draw_ray(made, halves[0].subplots(3, 1, sharex=True), quantity)
    upper, lower = halves[1].subplots(2, 1, height_ratios=(1, 2))
    known, kind = not np.isinf(made.total), "certified" if made.certified else "estimated"
    told = f"error bound {made.total:.2g},\n{kind}" if known else "error bound:\nno estimate"
    _draw_bars(upper, told, sorted(made.sources.items(), key=lambda one: -one[1]) if known else [], LEAST_BARS)
    note = textwrap.fill(made.note, LETTERS)
    upper.text(0.02, 0.04, note, fontsize="x-small", color=GRAY, va="bottom", transform=upper.transAxes)
    most = np.argsort(-made.added, kind="stable")[:PARTICLES]
    shares = [(f"{made.particles[which]}", float(made.added[which])) for which in most]
    told = f"{len(made.particles):,} particles met; of alpha,\nthese add most" if shares else "no particles met"
    _draw_bars(lower, told, shares, PARTICLES)
    return figure


def _draw_ray(made: Any, axes: Any, quantity: str) -> None:
    """Three panels over depth."""
    axes[0].plot(made.depth, made.quantity, color=BLUE, linewidth=1.2, label="of colour")
    if made.extinction_quantity is not None:
        axes[0].plot(made.depth, made.extinction_quantity, color=RED, linewidth=1.2, label="of extinction")
        axes[0].legend(frameon=False, fontsize="small")
    axes[1].plot(made.depth, made.extinction, color=DARK, linewidth=1.2)
    axes[1].fill_between(made.depth, made.extinction, color=GRAY, alpha=0.3, linewidth=0)
    axes[2].plot(made.depth, made.transmittance, color=DARK, linewidth=1.2)
    axes[2].set_ylim(-0.03, 1.03)
    if np.isfinite(made.half_depth):
        for one in axes:
            one.axvline(made.half_depth, color=GRAY, linewidth=0.8, linestyle=":", label="half of the light is gone")
        axes[2].legend(frameon=False, fontsize="small")
    axes[1].set_ylim(0, None)
    for one, label in zip(axes, (quantity, "extinction", "transmittance"), strict=True):
        one.set_ylabel(in_lines(symbol(label), LETTERS // 2))
    axes[0].figure.align_ylabels(axes)
    axes[-1].set_xlabel("depth")
    axes[-1].set_xlim(made.depth[0], made.depth[-1])


def _draw_bars(axes: Any, title: str, bars: list[tuple[str, float]], room: int) -> None:
    """Bars with their names and numbers, the first above; `room` for so many at least."""
    axes.set_title(title, fontsize="small", loc="left")
    names, lengths = [name for name, _ in bars], np.array([length for _, length in bars])
    axes.barh(range(len(bars)), lengths, height=0.6, color=BLUE)
    for place, length in enumerate(lengths):
        axes.text(length, place, f" {length:.2g}", va="center", fontsize="small", color=DARK)
    axes.set_yticks(range(len(bars)), names, fontsize="small")
    axes.set_ylim(max(len(bars), room) - 0.5, -0.5)
    axes.set_xlim(0, MARGIN * max(lengths.max(initial=0), np.finfo(float).tiny))
    axes.set_xticks([])
    axes.tick_params(axis="y", length=0)
    axes.spines[:].set_visible(False)
