"""An explanation as a figure: what is along the ray over depth, and the error budget beside it.

Flow: Explanation -> [figure] -> figure of matplotlib's.
"""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np

from jaxsph.io.libraries import require

SIZE, DOTS_AN_INCH = (9.0, 5.4), 110
DARK, GRAY, BLUE, RED = "#222222", "#8a8a8a", "#2b6cb0", "#c05621"
SHARES = 2.6, 1  # of the width: the ray, the budget
LEAST_BARS = 4  # that there is room for
LETTERS = 32  # of a line beside the bars
MARGIN = 1.35  # times the largest share, for its number beside it


def figure_of(made: Any, quantity: str, title: str) -> Any:
    """Of an `Explanation`; see `Explanation.figure`."""
    require("matplotlib", "figures of a pixel", "color")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, dpi=DOTS_AN_INCH, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(3, 2, width_ratios=SHARES)
    upper = figure.add_subplot(grid[0, 0])
    others = [figure.add_subplot(grid[row, 0], sharex=upper) for row in (1, 2)]
    row, column = made.pixel
    figure.suptitle(f"{title}{', ' if title else ''}pixel {row} {column}", x=0.01, ha="left", fontsize="medium")
    _draw_ray(made, (upper, *others), quantity)
    _draw_budget(made, figure.add_subplot(grid[:, 1]))
    return figure


def _draw_ray(made: Any, axes: tuple[Any, ...], quantity: str) -> None:
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
            one.axvline(made.half_depth, color=GRAY, linewidth=0.8, linestyle=":")
    axes[1].set_ylim(0, None)
    for one, label in zip(axes, (quantity, "extinction", "transmittance"), strict=True):
        one.set_ylabel(label)
        one.tick_params(axis="x", labelbottom=one is axes[-1])
    axes[-1].set_xlabel("depth")
    axes[-1].set_xlim(made.depth[0], made.depth[-1])


def _draw_budget(made: Any, axes: Any) -> None:
    """A bar a source, the largest above."""
    known = not np.isnan(made.total)
    kind = "certified" if made.certified else "estimated"
    axes.set_title(f"error bound {made.total:.3g}, {kind}" if known else "error bound unknown", fontsize="medium", loc="left")
    shares = sorted(made.sources.items(), key=lambda one: one[1]) if known else []
    for place, (_, share) in enumerate(shares):
        axes.barh(place, share, height=0.6, color=BLUE)
        axes.text(share, place, f" {share:.2g}", va="center", fontsize="small", color=DARK)
    axes.set_yticks(range(len(shares)), [name for name, _ in shares])
    axes.set_ylim(len(shares) - max(len(shares), LEAST_BARS) - 0.5, len(shares) - 0.5)
    most = max((share for _, share in shares), default=0)
    axes.set_xlim(0, MARGIN * most if most > 0 else 1)
    axes.spines[["top", "right", "bottom"]].set_visible(False)
    axes.set_xticks([])
    if made.note:
        axes.text(0.02, 0.02, textwrap.fill(made.note, LETTERS), fontsize="small", color=GRAY, transform=axes.transAxes)
