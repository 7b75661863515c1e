"""What a value looks like, as a strip of colours with its axis: units, logarithms, ticks.

Flow: TransferFunction or colour map, label, unit -> [bars] -> axes of matplotlib.
"""

from __future__ import annotations

import dataclasses
import re
import textwrap
from types import SimpleNamespace
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxsph.io.settle.quantities import LOG_PREFIX
from jaxsph.io.table import ROLES, plain
from jaxsph.io.units import CODE_UNITS, Labels, factors
from jaxsph.model.transfer.maps import Scale, colormap, colors_at, control_values

STEPS = 256
MAX_TICKS = 7
EVEN = 2.0  # steepest over least steep of a scale that is about linear
DECADES = 100.0  # from which ratio on powers of ten stand at an axis
PLAIN = 1e-2, 1e4  # between which the largest number of an axis is written without a power of ten
STYLE: Any = {"font.family": ["STIXGeneral", "DejaVu Sans"], "mathtext.fontset": "stix"}
SAVED: Any = {"pdf.fonttype": 42, "ps.fonttype": 42, "svg.fonttype": "none"}
"""Letters as journals have them, and text as text in files."""
SYMBOLS = {name: symbol for role, symbol in (
    ("density", r"\rho"), ("mass", "m"), ("velocity", "v"), ("temperature", "T"), ("internal_energy", "u")
) for name in map(plain, ROLES[role])}  # fmt: skip
SYMBOLS |= {"pressure": "P", "pressures": "P", "speed": "|v|", "magneticfield": "B", "bxyz": "B", "b": "B", "metallicity": "Z"}
SYMBOLS |= dict(zip("xyz", "xyz", strict=True)) | dict.fromkeys(("columnmass", "columndensity"), r"\Sigma")
SYMBOLS |= {"columnnumber": "N", "columnvolume": r"\ell"}
"""Of names without case and punctuation."""
ALONG_RAYS = {"column": r"$\int${} d$\ell$", "mean": r"$\langle${}$\rangle$", "emission": "emission of {}"}
ALONG_RAYS |= {"difference": r"$\Delta$ {}", "ratio": "ratio of {}"}
SUN = {f"{name}sun": rf"$\mathrm{{{name.upper()}}}_{{\odot}}$" for name in "mrlz"} | {"um": "µm", "angstrom": "Å", "au": "au"}


@dataclasses.dataclass(frozen=True, eq=False)
class Axis:
    """An axis of a quantity as people read it: a quantity `log10:NAME` is shown as NAME on a logarithmic axis.

    Attributes:
        transfer: what the values look like.
        label: name of the quantity, as `jaxsph.io` calls it.
        unit: what numbers on the axis are in; powers as in `g cm^-3`.
        factor: numbers on the axis, over those of the quantity.
        weight: by what a mean is weighted.
    """

    transfer: Any
    label: str = "quantity"
    unit: str = CODE_UNITS
    factor: float = 1.0
    weight: str = ""

    @classmethod
    def over(cls, name: str, norm: str, ends: tuple[float, float], labels: Labels) -> Axis:
        """Of a colour map between two values, laid by a domain."""
        values = control_values(norm, None, None, *ends, None, STEPS)
        shown = SimpleNamespace(values=values, colors=colormap(name, STEPS))
        return cls(shown, labels.quantity, labels.unit, labels.factor, labels.weight)

    @property
    def is_logarithm(self) -> bool:
        """Whether the quantity is the logarithm of what the axis shows."""
        return self.label.lower().startswith(LOG_PREFIX)

    @property
    def title(self) -> str:
        """Symbol and unit as matplotlib writes them, with the power of ten that numbers are in."""
        name = symbol(self.label[len(LOG_PREFIX) :] if self.is_logarithm else self.label)
        power = f"$10^{{{self.power}}}$" if self.power else ""
        unit = f"{power} {raised(self.unit)}".strip()
        by = "mass" if SYMBOLS.get(plain(self.weight)) == "m" else self.weight
        return f"{name}{f' by {by}' if by else ''}{f' ({unit})' if unit else ''}"

    @property
    def power(self) -> int:
        """Of ten, that numbers on the axis are in: 0 for those of an ordinary size, and where decades stand at the axis."""
        low, high = self.scale.values[[0, -1]]
        most = max(abs(low), abs(high))
        decades = self.scale.name == "log" and high >= DECADES * low
        return 0 if decades or not most or PLAIN[0] <= most < PLAIN[1] else int(np.floor(np.log10(most)))

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
        return colors_at(self.quantity(shown), self.transfer.values, np.asarray(self.transfer.colors))

    def apply(self, axes: Any, which: str, low: float, high: float, most: int = MAX_TICKS) -> None:
        """Set scale, limits and ticks, about `most` of them, of the x or y axis of `axes`."""
        from matplotlib import ticker

        scale, axis = self.scale, getattr(axes, f"{which}axis")
        if scale.name == "even":
            getattr(axes, f"set_{which}scale")("function", functions=(scale.place, scale.value))
            axis.set_minor_locator(ticker.NullLocator())
            set_ticks(axis, even_ticks(scale, most), self.power)
        elif scale.name == "log":
            getattr(axes, f"set_{which}scale")("log")
            ticks_of_decades(axis, low, high, most, self.power)
        else:
            set_ticks(axis, round_ticks(low, high, most), self.power)
        getattr(axes, f"set_{which}lim")(low, high)


def canvas(size: tuple[float, float], dots: float, title: str, layout: Any = "constrained") -> Any:
    """A figure of so many inches and dots an inch, that needs no display, under a title; its files hold text as text."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class Saved(Figure):
        def savefig(self, *given: Any, **options: Any) -> None:
            with rc_context(SAVED):
                super().savefig(*given, **options)

    figure = Saved(figsize=size, dpi=dots, layout=layout)
    FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, x=0.01, ha="left", fontsize="medium")
    return figure


def symbol(name: str) -> str:
    """What a quantity is called in a figure: by its symbol where it has one, as matplotlib writes it."""
    if (known := SYMBOLS.get(plain(name))) is not None:
        return f"${known}$"
    first, _, rest = name.partition(".")
    if rest and first in ALONG_RAYS:
        return ALONG_RAYS[first].format(symbol(rest))
    if "*" in name or "/" in name:  # an expression
        power = r"\*\*(?:\((-?[\d./]+)\)|(-?\d[\d.]*))"
        words = re.sub(power, lambda found: f"$^{{{found[1] or found[2]}}}$", name).replace("*", " ")
        return re.sub(r"(?<![\w$^{}])[^\W\d][\w.]*", lambda word: symbol(word[0]), words)
    base, _, component = name.rpartition(".")
    if base and component.isalnum():
        under = component if len(component) == 1 else rf"\mathrm{{{component}}}"
        return f"${SYMBOLS[plain(base)]}_{under}$" if plain(base) in SYMBOLS else f"{symbol(base)}$_{under}$"
    return name.replace("_", " ").replace("$", r"\$")


def in_lines(text: str, width: int) -> str:
    """Broken into lines of so many letters, between words, and not inside of what matplotlib reads as mathematics."""
    kept = re.sub(r"\$[^$]*\$", lambda found: found[0].replace(" ", "\0"), text)
    return textwrap.fill(kept, width, break_long_words="$" not in text, break_on_hyphens=False).replace("\0", " ")


def measured(number: float, unit: str) -> str:
    """A number with its unit, as matplotlib writes it; one of a unit that is called by a plural has its singular."""
    name = "code unit" if number == 1 and unit == CODE_UNITS else raised(unit)
    return f"{number:g} {name}".strip()


def raised(unit: str) -> str:
    """A unit as matplotlib writes it: the Sun as a sign, powers raised, and lengths that grow with the universe as `ckpc`."""
    if "$" in unit:
        return unit
    found = factors(unit)
    left, own = ([one for one in found if (one[0] in ("a", "h")) == which] for which in (True, False))
    lengths = [nth for nth, (name, power) in enumerate(own) if name.endswith("pc") and ("a", power) in left]
    if len(lengths) == 1:
        name, power = own[lengths[0]]
        own[lengths[0]] = f"c{name}", power
        left.remove(("a", power))
    words = [(f"${name}$", power) for name, power in sorted(left, reverse=True)]
    words += [(SUN.get(name.lower(), name), power) for name, power in own]
    return " ".join(f"{name}$^{{{power}}}$".replace("$$", "") if power != "1" else name for name, power in words)


def even_ticks(scale: Scale, most: int) -> np.ndarray:
    """Values at about even places, rounded to two digits where these tell them apart; round ones of about a linear scale."""
    values = scale.value(np.linspace(0, 1, most))
    if np.diff(values).max() < EVEN * np.diff(values).min():
        return round_ticks(values[0], values[-1], most)
    rounded = np.array([float(f"{value:.2g}") for value in values])
    rounded[[0, -1]] = values[[0, -1]]
    inside = (np.diff(rounded) > 0).all()
    return rounded if inside else values


def round_ticks(low: float, high: float, most: int) -> np.ndarray:
    """Round values from one to another, evenly spaced, about as many as are asked for and no more."""
    from matplotlib import ticker

    found = (ticker.MaxNLocator(max(1, bins), steps=(1, 2, 2.5, 5, 10)).tick_values(low, high) for bins in (most, most - 1))
    inside = [ticks[(ticks >= low) & (ticks <= high)] for ticks in map(np.asarray, found)]
    return inside[len(inside[0]) > most]


def set_ticks(axis: Any, values: Any, power: int = 0) -> None:
    """Ticks with their numbers over a power of ten, with as many decimals as tell them apart."""
    shown = np.asarray(values, np.float64) / 10.0**power
    decimals = max((len(f"{one:.5f}".rstrip("0").partition(".")[2]) for one in np.round(shown, 5)), default=0)
    texts = [f"{one:.{decimals}f}" if decimals <= 3 else f"{one:.3g}" for one in shown]
    axis.set_ticks(values, [text.replace("-", "\N{MINUS SIGN}") for text in texts])


def ticks_of_decades(axis: Any, low: float, high: float, most: int = MAX_TICKS, power: int = 0) -> None:
    """Decades, and numbers between where there are few."""
    from matplotlib import ticker

    axis.set_minor_formatter(ticker.NullFormatter())
    if high >= DECADES * low:
        axis.set_major_locator(ticker.LogLocator(numticks=most))
        axis.set_major_formatter(ticker.LogFormatterMathtext())
        return
    tens = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1)
    for steps in ((1, 1.5, 2, 3, 4, 5, 6, 8), (1, 2, 5), (1, 3), (1,)):
        ticks = np.outer(tens, steps).ravel()
        ticks = ticks[(ticks >= low) & (ticks <= high)]
        if 2 <= len(ticks) <= most:
            return axis.set_ticks(ticks, [f"{tick / 10.0**power:g}" for tick in ticks])
    return set_ticks(axis, round_ticks(low, high, max(3, most)), power)
