"""What a value looks like, as a strip of colours with its axis: units, logarithms, ticks.

Flow: TransferFunction, label, unit -> [bars] -> axes of matplotlib.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.io.settle.quantities import LOG_PREFIX
from jaxsph.io.units import CODE_UNITS
from jaxsph.model.transfer.function import TransferFunction
from jaxsph.model.transfer.maps import Scale
from jaxsph.reference.image import interpolated

STEPS = 256
MAX_TICKS = 7
POWER = re.compile(r"\^(-?[\d./]+)")


@dataclasses.dataclass(frozen=True, eq=False)
class Axis:
    """An axis of a quantity as people read it: a quantity `log10:NAME` is shown as NAME on a logarithmic axis.

    Attributes:
        transfer: what the values look like.
        label: name of the quantity, as `jaxsph.io` calls it.
        unit: what numbers on the axis are in; powers as in `g cm^-3`.
        factor: numbers on the axis, over those of the quantity.
    """

    transfer: TransferFunction
    label: str = "quantity"
    unit: str = CODE_UNITS
    factor: float = 1.0

    @property
    def is_logarithm(self) -> bool:
        """Whether the quantity is the logarithm of what the axis shows."""
        return self.label.lower().startswith(LOG_PREFIX)

    @property
    def title(self) -> str:
        """Label and unit, with powers as matplotlib writes them."""
        name = self.label[len(LOG_PREFIX) :] if self.is_logarithm else self.label
        return f"{name} ({raised(self.unit)})" if self.unit else name

    @property
    def scale(self) -> Scale:
        """Of the numbers shown."""
        return Scale.of(self.shown(np.asarray(self.transfer.values, np.float64)))

    def shown(self, quantity: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Numbers on the axis of values of the quantity."""
        quantity = np.asarray(quantity, np.float64)
        return self.factor * (10.0**quantity if self.is_logarithm else quantity)

    def quantity(self, shown: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Values of the quantity of numbers on the axis."""
        value = np.asarray(shown, np.float64) / self.factor
        return np.log10(value) if self.is_logarithm else value

    def colors(self, shown: Float[np.ndarray, "..."]) -> Float[np.ndarray, "... 3"]:
        """Of numbers on the axis."""
        return look_up(self.transfer, self.quantity(shown))[0]

    def apply(self, axes: Any, which: str, low: float, high: float) -> None:
        """Set scale, limits and ticks of the x or y axis of `axes`."""
        from matplotlib import ticker

        scale, axis = self.scale, getattr(axes, f"{which}axis")
        if scale.name == "even":
            getattr(axes, f"set_{which}scale")("function", functions=(scale.place, scale.value))
            axis.set_major_locator(ticker.FixedLocator(even_ticks(scale).tolist()))
            axis.set_minor_locator(ticker.NullLocator())
            axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:.3g}"))
        elif scale.name == "log":
            getattr(axes, f"set_{which}scale")("log")
            ticks_of_decades(axis, low, high)
        else:
            axis.set_major_locator(ticker.MaxNLocator(MAX_TICKS - 1))
        getattr(axes, f"set_{which}lim")(low, high)


def canvas(size: tuple[float, float], dots: int, title: str) -> Any:
    """A figure of so many inches and dots an inch, that needs no display, under a title."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=dots, layout="constrained")
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize="medium")
    return figure


def look_up(transfer: TransferFunction, quantity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colours and extinction of values of one quantity, float64; of two, extinction is of values of the second."""
    own = transfer.values if transfer.extinction_values is None else transfer.extinction_values
    extinction = interpolated(own, np.asarray(transfer.extinction)[:, None], quantity)[..., 0]
    return interpolated(transfer.values, transfer.colors, quantity), extinction


def raised(unit: str) -> str:
    """A unit with its powers raised."""
    return POWER.sub(r"$^{\\mathregular{\1}}$", unit)


def even_ticks(scale: Scale) -> np.ndarray:
    """Values at about even places, rounded to two digits where these tell them apart."""
    values = scale.value(np.linspace(0, 1, MAX_TICKS))
    rounded = np.array([float(f"{value:.2g}") for value in values])
    rounded[[0, -1]] = values[[0, -1]]
    inside = (np.diff(rounded) > 0).all()
    return rounded if inside else values


def ticks_of_decades(axis: Any, low: float, high: float) -> None:
    """Decades, and numbers between where there are few."""
    from matplotlib import ticker

    decades = np.log10(high / low)
    if decades >= 2:
        axis.set_major_locator(ticker.LogLocator(numticks=MAX_TICKS))
        axis.set_major_formatter(ticker.LogFormatterMathtext())
    else:
        axis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5) if decades > 0.7 else (1, 1.5, 2, 3, 4, 5, 6, 8)))
        axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:.3g}"))
    axis.set_minor_formatter(ticker.NullFormatter())
