"""Projection: raw values of an image of integrals along rays, and pictures of them.

Flow: project -> [projection] -> files, notebooks.
"""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Int

from jaxsph.model.image import PLANE, Image, dataset, figure_of, places, png_of
from jaxsph.model.transfer.maps import colormap as colors_of, colors_at, control_values, value_range
from jaxsph.numerics.checks import is_traced
from jaxsph.numerics.names import import_by_name
from jaxsph.numerics.trees import Traceable, kind_of, line_of, span_of, tree

COLORS = 256  # of a map in a picture
NORMS = ("log", "linear", "symlog")
LARGE_SPAN = 10.0  # positive values that span more are shown by their logarithm when nobody chose
SHARES = 0.01, 0.998  # of all that is in an image, what lies in darker pixels than the ends of the colours show
SIGNED = 0.05  # of the largest value, what the smallest must be below zero for values to have both signs
EMPTY = 0  # of a picture, where there is no value
CUT_TOLD = 0.01  # share of what is in a picture that depths may leave out unsaid


@tree(static=("perspective", "name", "unit", "metadata", "length_unit"))
class Projection(Traceable):
    """Integrals along rays. Row 0 is the top, column 0 the left.

    Attributes:
        values: amounts a unit of area; or means, NaN where there is nothing.
        weight: what means are divided by, weights a unit of area: so that means of parts can be put together; None without. In
            float64 where the dtype cannot hold them.
        pixel_area: of a pixel, length units squared; with perspective, at depth 1. In float64 where float32 might not hold it.
        perspective: whether rays spread with depth.
        faults: 0 when all is well, else bits: `fault_messages` has them in words, and `check` raises them.
        name: of the values.
        unit: of the values; empty where it is not known.
        metadata: strings and numbers for the file header.
        length_unit: what the unit of lengths is called; empty where it is not known.
    """

    LAYER, PLANNER = ("values", 2), "plan_projection"
    values: Float[Array, "height width"]
    weight: Float[Array, "height width"] | None
    pixel_area: Float[Array, ""] | np.floating
    perspective: bool
    faults: Int[Array, ""] | int = 0
    name: str = "values"
    unit: str = ""
    metadata: tuple[tuple[str, Any], ...] = ()
    length_unit: str = ""

    def __repr__(self) -> str:
        told = f"{self.name} {span_of(self.values)} {self.unit}".rstrip()
        cut = f"{self.cut:.1%} cut off by depths" if self.cut > CUT_TOLD else None
        return line_of("Projection", kind_of(self.values), told, f"faults {span_of(self.faults)}", cut)

    @property
    def cut(self) -> float:
        """Share of the amounts in the picture, or of the weights, that lies nearer or farther than rays go; 0 from a trace."""
        return float(next((value for name, value in self.metadata if name.endswith(".cut")), 0.0))

    def total(self) -> Float[Array, ""] | np.floating:
        """The amount in the image, such as its mass: the sum of values times the area of a pixel.

        Raises:
            ValueError: of means; and with perspective, where pixels are no areas.
        """
        if self.weight is not None or self.perspective:
            what = "means are not added up" if self.weight is not None else "pixels of a perspective camera have no area"
            raise ValueError(f"{what}: project amounts without `weight`, by an orthographic camera")
        if is_traced(self.values, self.pixel_area):
            return self.values.sum() * self.pixel_area
        return np.asarray(self.values, np.float64).sum() * np.float64(self.pixel_area)  # which float32 might not hold

    def save(self, path: str | os.PathLike[str], **look: Any) -> None:
        """Write to `path`: `.exr`, `.fits` or `.npy` (raw values), or `.png` (a picture; `look` is that of `to_uint8`)."""
        import_by_name("jaxsph.io.images.planes:write_projection")(path, self, **look)  # 310 ms

    def to_xarray(self) -> Any:
        """Values, and weights where there are any, as an `xarray.Dataset` over `row` and `column`; metadata are its attributes.

        With parallel rays there are coordinates `x` and `y`, length units from the middle of the picture.

        Raises:
            ImportError: xarray is not installed.
        """
        told = {"long_name": self.name} | ({"units": self.unit} if self.unit else {})
        layers: dict[str, Any] = {"values": (PLANE, np.asarray(self.values), told)}
        if self.weight is not None:
            layers["weight"] = PLANE, np.asarray(self.weight), {"long_name": "weight"}
        side = math.sqrt(float(self.pixel_area))
        coordinates = {} if self.perspective else places(self.shape, side, (0.0, 0.0), self.length_unit)
        return dataset(layers, coordinates, self.metadata, pixel_area=float(self.pixel_area), faults=int(self.faults))

    def to_uint8(
        self, colormap: str | None = None, norm: str | None = None, range: tuple[float, float] | None = None
    ) -> np.ndarray:
        """(H, W, 3) uint8: a colour map over values or their logarithms; black where there is no value.

        Args:
            colormap: name of a colour map, see `jaxsph.scenes.colormap`; by default viridis, or coolwarm of a range even about 0.
            norm: `"log"`, `"linear"` or `"symlog"`, logarithmic in both directions from zero; by default log for positive
                values that span more than a decade.
            range: values that the colours span; default nearly all, of values of both signs as far below 0 as above.
        """
        return self.image(colormap, norm, range).to_uint8()

    def image(self, colormap: str | None = None, norm: str | None = None, range: tuple[float, float] | None = None) -> Image:
        """The same as an image, opaque wherever there is a value."""
        values: Any = np.asarray(self.as_one("to_uint8").values, np.float64)
        log, (low, high) = self.span(norm, range)
        colors = colors_of(suited(colormap, (low, high)), COLORS)
        there = np.isfinite(values) & ((values > 0) | (not log))
        shown = np.where(there, values, high)
        if log:
            shown, low, high = np.log10(shown), math.log10(low), math.log10(high)
        at = np.linspace(0, 1, len(colors))
        evenly = np.linspace(low, high, COLORS) if norm != "symlog" else control_values(norm, None, None, low, high, None, COLORS)
        share = np.interp(shown, evenly, at)
        picture = colors_at(share, at, colors)
        least = np.isfinite(values) & ~there & bool(log and self.weight is None)  # nothing along a ray: less than is shown least
        filled, picture = there | least, np.where(least[..., None], colors[0], picture)
        nothing, picture = np.zeros(self.shape), np.where(filled[..., None], picture, EMPTY)
        made: Any = picture, np.where(filled, 0.0, 1.0), np.where(filled, 0, np.inf), nothing, nothing, True, 0, {}, self.metadata
        return Image(*made)

    def span(self, norm: str | None = None, range: tuple[float, float] | None = None) -> tuple[bool, tuple[float, float]]:
        """Whether colours are of logarithms, and the values that they span.

        Raises:
            ValueError: an unknown norm, or values that do not ascend or have no logarithm.
        """
        if norm not in (None, *NORMS):
            raise ValueError(f"`norm` must be one of {', '.join(map(repr, NORMS))}, got {norm!r}")
        values: Any = np.asarray(self.values, np.float64)
        finite = values[np.isfinite(values)]
        ends = _ends(finite)
        log = norm == "log" or (norm is None and bool((finite >= 0).all()) and ends[1] > LARGE_SPAN * ends[0])
        if range is None:
            low, high = ends if log else value_range(finite)
            largest = max(-low, high)
            signed = low < (0 if norm == "symlog" else -SIGNED * abs(high)) and high > 0
            return log, ((-largest, largest) if signed else (low, high))
        low, high = (float(value) for value in range)
        if not (math.isfinite(low) and math.isfinite(high) and low < high) or (log and low <= 0):
            more = ", above 0 for logarithms" if log else ""
            raise ValueError(f"`range` must be two finite values that ascend{more}, got ({low}, {high})")
        return log, (low, high)

    def figure(
        self, colormap: str | None = None, norm: str | None = None, range: tuple[float, float] | None = None, **more: Any
    ) -> Any:
        """A figure of matplotlib with a colour bar and a scale bar; the first arguments are those of `to_uint8`.

        `more` are those of `jaxsph.plot.image_figure.image_figure`, such as `axes=True`, `camera`, `labels` and `title`.
        """
        given = self.as_one("figure")
        return figure_of(given, colormap=colormap, norm=norm, range=range, **more)

    def _repr_png_(self) -> bytes:
        return png_of(self.to_uint8())


def suited(colormap: str | None, ends: tuple[float, float]) -> str:
    """The colour map that is asked for, or that suits values between two ends: a diverging one where these are even about 0."""
    return colormap or ("coolwarm" if ends[0] == -ends[1] else "viridis")


def _ends(values: np.ndarray) -> tuple[float, float]:
    """Positive values between which nearly all lies that is in an image: its fringe is faint, and goes down to nothing."""
    positive = np.sort(values[values > 0])
    if not positive.size:
        return 1.0, 2.0
    shares = np.cumsum(positive / positive[-1])
    low, high = (float(positive[np.searchsorted(shares, share * shares[-1])]) for share in SHARES)
    return (low, high) if high > 1.001 * low else (0.5 * high, 2 * high)
