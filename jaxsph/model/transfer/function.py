"""Transfer function: what a quantity looks like.

Flow: [transfer] -> cast -> image.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.model.json_form import WithJson
from jaxsph.model.particles.particles import Particles
from jaxsph.model.transfer.maps import POINTS, control_values, numbers, of_colormap, of_matplotlib
from jaxsph.model.transfer.presets import OPTICAL_DEPTH, opaque_factor, preset_map
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import (
    array_of,
    as_usual,
    is_traced,
    product,
    require_finite,
    require_shape,
    rounded_into,
    typed,
)
from jaxsph.numerics.compiled import clamped, lesser, ratio
from jaxsph.numerics.names import import_by_name
from jaxsph.numerics.trees import line_of, on_host, span_of, tree

SECOND = "extinction_values"


@tree()
class TransferFunction(WithJson):
    """Piecewise linear map of a quantity Q to colour and extinction, clamped at its ends.

    Two equal neighbours in `values` make a jump; the later point holds at the jump itself.

    Attributes:
        values: ascending control points, in units of the quantity.
        colors: RGB in [0, 1] at the control points.
        extinction: >= 0 at the control points, per length unit.
        extinction_values: ascending control points of extinction, where those are others; None where both have the same. Of
            particles that carry two quantities, these are in units of the second.
    """

    values: Float[Array, " points"]
    colors: Float[Array, "points 3"]
    extinction: Float[Array, " points_of_extinction"]
    extinction_values: Float[Array, " points_of_extinction"] | None = None

    def __repr__(self) -> str:
        shape, second = getattr(self.values, "shape", ()), self.extinction_values
        return line_of(
            "TransferFunction",
            f"{shape[-1]} points" if shape else None,
            f"values {span_of(self.values)}",
            f"extinction {span_of(self.extinction)}",
            None if second is None else f"over {span_of(second)}",
        )

    @classmethod
    @as_usual()
    def from_points(cls, values: Any, colors: Any, extinction: Any, extinction_values: Any = None) -> TransferFunction:
        """Check and pack control points.

        All are numbers: which unit a scene's quantities and lengths have is not known here, so arrays that carry units are
        refused.

        Args:
            values: (K,) ascending (equal neighbours allowed), K >= 1, units of the quantity.
            colors: (K, 3) in [0, 1].
            extinction: (K,) >= 0, per length unit; (M,) where `extinction_values` are given.
            extinction_values: (M,) ascending, M >= 1: control points of extinction alone. Of particles with two quantities
                (`Particles.from_arrays(..., quantity=(A, B))`) colour is then a function of A, extinction one of B; of what
                carries one quantity, both are functions of that, each with its own control points.

        Raises:
            ValueError: wrong shapes, non-finite values, values that descend, colours outside [0, 1], extinction < 0 (by
                more than rounding, which is taken back), values that the dtype cannot hold apart.
        """
        given = {"values": values, "colors": colors, "extinction": extinction, "extinction_values": extinction_values}
        given = {name: numbers(name, value) for name, value in given.items() if value is not None or name != SECOND}
        control: list[str] = [name for name in ("values", "extinction_values") if name in given]
        for name in control:
            require_shape(name, given[name], (None,), "one number a control point")
            if given[name].shape[0] < 1:
                raise ValueError(f"`{name}` must hold at least one control point, got none")
        points, others = (given[name].shape[0] for name in (control[0], control[-1]))
        require_shape("colors", given["colors"], (points, 3), f"one RGB row for each of the {points} values")
        require_shape("extinction", given["extinction"], (others,), f"one number for each of the {others} {control[-1]}")
        if not is_traced(*given.values()):
            for name, value in given.items():
                require_finite(name, value)
            given["colors"] = rounded_into("colors", given["colors"], (0, 1), "colours lie in [0, 1]")
            darkest = "extinction is a loss of light, never a gain"
            given["extinction"] = rounded_into("extinction", given["extinction"], (0, np.inf), darkest)
            for name in control:
                descents = np.flatnonzero(np.diff(np.asarray(given[name])) < 0)
                if descents.size:
                    ends = [f"{name}[{i}] = {given[name][i]}" for i in (descents[0], descents[0] + 1)]
                    raise ValueError(f"`{name}` must ascend, but {ends[0]} > {ends[1]}; sort the control points")
        dtype = jnp.promote_types(jax.dtypes.canonicalize_dtype(jnp.result_type(*given.values())), jnp.float32)
        packed = {name: array_of(value, dtype) for name, value in given.items()}
        if not is_traced(*given.values()):
            for name, value in packed.items():
                require_finite(name, value, f"it overflows {dtype}: rescale it, or use float64 under jax.enable_x64")
            for name in control:
                _require_apart(name, np.asarray(given[name], np.float64), packed[name])
        return cls(**packed)

    @classmethod
    def from_colormap(cls, colors: Any, values: Any, extinction: Any = 1.0) -> TransferFunction:
        """A transfer function whose colours are those of a map, evenly placed over its control values.

        Args:
            colors: name of a colour map, or (M, 3) colours from low to high.
            values: (K,) control values, as `control_values` lays them; or two ends, between which 16 are evenly spaced.
            extinction: per length unit: a number, or any number of them from the low end to the high, evenly placed.

        Raises:
            ValueError: an unknown colour map, or what `from_points` refuses.
        """
        return cls.from_points(*of_colormap(colors, values, extinction))

    @classmethod
    @typed
    def from_matplotlib(
        cls,
        cmap: Any,
        norm: Any = None,
        *,
        low: float | None = None,
        high: float | None = None,
        extinction: Any = 1.0,
        points: int = POINTS,
    ) -> TransferFunction:
        """A transfer function of a colour map of matplotlib's, as a figure made with the same map and norm shows a quantity.

        Args:
            cmap: a `Colormap`, or its name. Extinction is multiplied by its alpha.
            norm: such as `Normalize`, `LogNorm`, `SymLogNorm`, with its `vmin` and `vmax`; `None` is linear from `low` to `high`.
                Of a `BoundaryNorm` the colours jump at its boundaries.
            low, high: ends, where the norm does not have them.
            extinction: per length unit: a number, or any number of them from the low end to the high, evenly placed.
            points: control points; at these the colours are the map's.

        Raises:
            ImportError: `cmap` is a name, and matplotlib is not installed.
            ValueError: an unknown name, a norm without its ends or without an inverse.
        """
        return cls.from_points(*of_matplotlib(cmap, norm, low, high, extinction, points))

    @staticmethod
    @typed
    def control_values(
        norm: str,
        quantity: Any = None,
        *,
        low: float | None = None,
        high: float | None = None,
        weights: Any = None,
        width: float | None = None,
        points: int = POINTS,
    ) -> Float[np.ndarray, " points"]:
        """Values at which a map of evenly placed colours has its control points (host side, float64).

        Args:
            norm: one of `jaxsph.model.transfer.maps.DOMAINS`: matplotlib's word for a domain.
            quantity: values of the particles or of a volume, any shape; needed where an end is not given, and by `percentile` and
                `equalised`.
            low, high: ends; `None` is the quantity's own without its tails, of `log` without what is not positive. Of
                `percentile` these are percentages, 0.5 and 99.5 if not given; `equalised` counts only what lies between.
            weights: of the quantity, by which `percentile` and `equalised` count: volumes, or what rays met
                (`jaxsph.visibility_histogram`); `None` counts all alike.
            width: of `symlog` alone: what is smaller than this is about linear; `None` is a thousandth of the largest.
            points: how many; up to 16 are looked up by comparisons, which is faster than any search.

        Returns:
            (points,) ascending; `equalised` counts values that many share once.

        Raises:
            ValueError: an unknown domain, a `log` of what is not positive, ends that do not ascend, a quantity that is needed.
        """
        return control_values(norm, quantity, weights, low, high, width, points)

    @classmethod
    @on_host
    @typed
    def preset(cls, name: str, shown: Any, *, optical_depth: Any = OPTICAL_DEPTH, **more: Any) -> TransferFunction:
        """A transfer function that suits a kind of data.

        Args:
            name: `"fluid"`, `"density"`, `"temperature"`, `"velocity"`, `"speed"`, `"magnetic"` or `"scan"`.
            shown: particles or a volume; or (low, high) of a quantity, for a peak of extinction of 1 a length unit.
            optical_depth: of typical columns; larger is more opaque.
            more: any of `range`, `norm`, `colormap` and `points`.
            range: ends of the colours, see `control_values`; `None` chooses them by the quantity.
            norm: other than the preset's own.
            colormap: other than the preset's own.
            points: control points.

        Raises:
            ValueError: an unknown preset, domain or colour map; ends that do not suit the domain.
        """
        made = cls.from_colormap(*preset_map(name, shown, **more))
        return fitted(made, shown, optical_depth) if isinstance(shown, Particles | Volume) else made

    def figure(self, scene: Any = None, camera: Any = None, **more: Any) -> Any:
        """A figure of matplotlib's: colours and extinction, over the histogram of what rays of `camera` meet in `scene`.

        See `jaxsph.plot.transfer_figure.transfer_figure` for `more`.
        """
        return import_by_name("jaxsph.plot.transfer_figure:transfer_figure")(self, scene, camera, **more)  # 390 ms

    @as_usual()
    def __call__(
        self, quantity: Float[Array, "..."], extinction_quantity: Float[Array, "..."] | None = None
    ) -> tuple[Float[Array, "... 3"], Float[Array, "..."]]:
        """Colour and extinction of `quantity` (any shape): `colour(Q)` (..., 3), `extinction(Q)` (...) per length unit.

        Args:
            quantity: that of colours.
            extinction_quantity: that of extinction; by default, the same.
        """
        other = quantity if extinction_quantity is None else extinction_quantity
        parts, quantities = self.parts(), [jnp.asarray(value, self.values.dtype) for value in (quantity, other)]
        channels = look_up(parts[0].segments(), quantities[0])
        of_other = channels if len(parts) == 1 and other is quantity else look_up(parts[-1].segments(), quantities[1])
        return jnp.stack(channels[:3], -1), of_other[3]

    def parts(self) -> tuple[TransferFunction, ...]:
        """One function for each quantity: itself, or one of the colours (with extinction 1) and one of extinction (in black)."""
        if self.extinction_values is None:
            return (self,)
        black = jnp.zeros((*self.extinction.shape, 3), self.colors.dtype)
        return (
            TransferFunction(self.values, self.colors, jnp.ones_like(self.values)),
            TransferFunction(self.extinction_values, black, self.extinction),
        )

    def joined(self) -> TransferFunction:
        """The same functions of one quantity, both given at the control points of either.

        Between neighbours of all control points both functions are linear, so that nothing changes but for rounding. At a jump of
        either, the first of equal points has what lies before it, the others what lies behind.

        Differentiation:
            By all numbers of the transfer function.
        """
        if self.extinction_values is None:
            return self
        values = jnp.sort(jnp.concatenate([self.values, self.extinction_values]))
        first = jnp.append(True, values[1:] > values[:-1])[:, None]
        tables = (self.values, self.colors), (self.extinction_values, self.extinction[:, None])
        sides = ([_one_sided(*table, values, side) for side in ("left", "right")] for table in tables)
        colors, extinction = (jnp.where(first, left, right) for left, right in sides)
        return TransferFunction(values, colors, extinction[:, 0])

    def segments(self) -> Segments:
        """The tables that `look_up` reads, of what has no `extinction_values`: made once, outside of loops."""
        table = jnp.concatenate([self.colors, self.extinction[:, None]], 1).T
        change = jnp.append(table[:, 1:] - table[:, :-1], jnp.zeros((4, 1), table.dtype), 1)
        width = jnp.append(self.values[1:] - self.values[:-1], 0)
        largest = jnp.finfo(width.dtype).max
        inverse = lesser(ratio(1.0, width), largest)
        buckets = BUCKETS_PER_POINT * self.values.shape[0]
        extent = self.values[-1] - self.values[0]
        rate = lesser(ratio(float(buckets), extent), largest)
        inside = _bucket(self.values, self.values[0], rate, buckets)
        below = jnp.searchsorted(inside, jnp.arange(buckets + 1, dtype=jnp.int32)).astype(jnp.int32)
        fullest = (below[1:] - below[:-1]).max()
        even = jnp.linspace(self.values[0], self.values[-1], self.values.shape[0])
        off = jnp.abs(self.values - even) <= EVEN * jnp.finfo(width.dtype).eps * jnp.maximum(jnp.abs(even[0]), jnp.abs(even[-1]))
        return Segments(self.values, inverse, table, change, below, rate, fullest, off.all() & (extent > 0))


def _one_sided(
    points: Float[Array, " points"], table: Float[Array, "points channels"], at: Float[Array, " places"], side: str
) -> Float[Array, "places channels"]:
    """What a table has at places, at a jump that of its left or right side."""
    last = points.shape[0] - 1
    above = jnp.searchsorted(lax.stop_gradient(points), lax.stop_gradient(at), side=side)
    before, after = jnp.clip(above - 1, 0, last), jnp.clip(above, 0, last)
    width = points[after] - points[before]
    part = ratio(at - points[before], width)[:, None]
    return table[before] * (1 - part) + table[after] * part


def _require_apart(name: str, given: np.ndarray, packed: Array) -> None:
    """Refuse values that rounding moves by too much of what they span, if that is not one value, or nearly makes zero."""
    span, largest = given[-1] - given[0], np.abs(given).max()
    moved, smallest = np.abs(given - np.asarray(packed, np.float64)).max(), MIN_NORMALS * np.finfo(packed.dtype).tiny
    if span > 0 and moved > MOVED * span:
        raise ValueError(
            f"`{name}` = {given[0]:.9g} .. {given[-1]:.9g} span {span:.3g}, and {packed.dtype} moves them by up to {moved:.3g}; "
            "subtract an offset from values and quantity, or use float64 under jax.enable_x64"
        )
    if 0 < largest < smallest:
        raise ValueError(
            f"`{name}` must reach at least {smallest:.3g} in {packed.dtype} unless all are 0, but the largest is {largest:.3g}; "
            "multiply values and quantity by the same number"
        )


MOVED = 2.0**-12  # of the span of its values that a transfer function's values may be moved by rounding
MIN_NORMALS = 2.0**16  # smallest normal numbers that values must reach: quantities among them are then not taken for zero


@tree()
class Segments:
    """A transfer function cut into segments; the last reaches to infinity and is constant.

    Attributes:
        start: where each segment begins.
        inverse: 1 / its width, 0 for jumps and for the last.
        base, change: red, green, blue and extinction at its beginning, and how much they change over it.
        below: number of control points before each of a number of uniform buckets; `rate` is buckets a unit.
        fullest: most control points in a bucket.
        even: whether the points are evenly spaced but for rounding.
    """

    start: Float[Array, " points"]
    inverse: Float[Array, " points"]
    base: Float[Array, "4 points"]
    change: Float[Array, "4 points"]
    below: Int[Array, " buckets_and_one"]
    rate: Float[Array, ""]
    fullest: Int[Array, ""]
    even: Bool[Array, ""]


EVEN = 4  # eps of the largest value that evenly spaced points may be off, as rounded tables are
BUCKETS_PER_POINT = 2
SELECT_ALL = 16  # up to this many control points a chain of selects vectorises, and beats any gather


def look_up(segments: Segments, quantity: Float[Array, "..."]) -> list[Float[Array, "..."]]:
    """The channels of the tables at `quantity`, each of its shape: of a transfer function red, green, blue and extinction.

    A segment is evaluated as base + part * change from its own beginning, so control points are met exactly (evenly spaced
    ones to a few eps of the whole range).
    """
    return read(segments, find(segments, quantity))


def find(segments: Segments, quantity: Float[Array, "..."]) -> tuple[Array, ...]:
    """Where `quantity` lies in the tables, for `read`: found once, read for one channel or another.

    Segment and place within it; or just the quantity, if control points are so few that comparing it again costs nothing.
    """
    return (quantity,) if segments.start.shape[0] <= SELECT_ALL else locate(segments, quantity)


def read(segments: Segments, place: tuple[Array, ...], channels: slice = slice(None)) -> list[Float[Array, "..."]]:
    """Some of the channels at a `place` that was found."""
    bases, changes = (list(table)[channels] for table in (segments.base, segments.change))
    if len(place) == 2:
        i, part = place
        return [at(base, i) + part * at(change, i) for base, change in zip(bases, changes, strict=True)]
    rows = [segments.start, segments.inverse, *bases, *changes]
    start, inverse, *found = _selected(rows, segments.start, place[0])
    part = clamped((place[0] - start) * inverse, 0, 1)
    return [base + part * change for base, change in zip(found[: len(bases)], found[len(bases) :], strict=True)]


def locate(segments: Segments, quantity: Float[Array, "*any"]) -> tuple[Int[Array, "*any"], Float[Array, "*any"]]:
    """Segment that holds `quantity`, and how far along it the quantity is, in [0, 1]."""
    if segments.start.shape[0] > SELECT_ALL:
        return lax.cond(segments.even, _evenly, _scattered, segments, quantity)
    each = jnp.arange(segments.start.shape[0], dtype=jnp.int32)
    segment, start, inverse = _selected([each, segments.start, segments.inverse], segments.start, quantity)
    return segment, clamped((quantity - start) * inverse, 0, 1)


def _selected(rows: list[Array], start: Array, quantity: Array) -> list[Array]:
    """Of each of `rows`, the entry of the segment that holds `quantity`."""
    found = [row[0] for row in rows]
    for k in range(1, start.shape[0]):
        past = quantity >= start[k]
        found = [jnp.where(past, row[k], value) for row, value in zip(rows, found, strict=True)]
    return found


def at(row: Array, i: Array) -> Array:
    """`row[i]` for indices known to be in range: a clamped gather is a third slower."""
    return row.at[i].get(mode="promise_in_bounds")


def _bucket(value: Array, lowest: Array, rate: Array, buckets: int) -> Array:
    """Uniform bucket of a value; monotone in floating point, as every step is. In range even for NaN."""
    return jnp.clip(jnp.clip((value - lowest) * rate, 0, buckets - 1).astype(jnp.int32), 0, buckets - 1)


def _scattered(segments: Segments, quantity: Array) -> tuple[Array, Array]:
    """Segment and place within it, for any control points: a bucket says which are near, bisection finds the last <= it."""
    count, buckets = segments.start.shape[0], segments.below.shape[0] - 1
    bucket = _bucket(quantity, segments.start[0], segments.rate, buckets)

    def halve(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = (low + high) // 2
        past = (low < high) & (quantity >= at(segments.start, jnp.minimum(middle, count - 1)))
        return jnp.where(past, middle + 1, low), jnp.where(past | (low >= high), high, middle)

    steps = 32 - lax.clz(segments.fullest)
    not_above = lax.fori_loop(0, steps, halve, (at(segments.below, bucket), at(segments.below, bucket + 1)))[0]
    i = jnp.maximum(not_above - 1, 0)
    return i, clamped((quantity - at(segments.start, i)) * at(segments.inverse, i), 0, 1)


@jax.custom_jvp
def _evenly(segments: Segments, quantity: Array) -> tuple[Array, Array]:
    """The same for control points that are evenly spaced but for rounding: no tables, no search."""
    last = segments.start.shape[0] - 1
    place = clamped((quantity - segments.start[0]) * (last / (segments.start[-1] - segments.start[0])), 0, last)
    i = jnp.clip(place.astype(jnp.int32), 0, last)
    return i, place - i.astype(place.dtype)


@_evenly.defjvp
@as_usual()
def _evenly_moved(primals: tuple[Segments, Array], tangents: tuple[Any, Array]) -> tuple[Any, Any]:
    """Control points that move one by one are evenly spaced no more, so the place within a segment changes as in any other."""
    (segments, quantity), (segments_dot, quantity_dot) = primals, tangents
    i, part = _evenly(segments, quantity)
    start, inverse = at(segments.start, i), at(segments.inverse, i)
    change = (quantity_dot - at(segments_dot.start, i)) * inverse + (quantity - start) * at(segments_dot.inverse, i)
    inside = (quantity >= segments.start[0]) & (quantity < segments.start[-1])
    return (i, part), (np.zeros(i.shape, jax.dtypes.float0), jnp.where(inside, change, 0))


def fitted(transfer: TransferFunction, shown: Particles | Volume, optical_depth: float = OPTICAL_DEPTH) -> TransferFunction:
    """The same colours with extinction scaled such that typical columns of particles or of a volume have an optical depth.

    Args:
        transfer: of which only the ratios of extinction count.
        shown: columns of which are looked at, along three axes; see `default_transfer`.
        optical_depth: 3 lets 5 % of the light behind through; larger is more opaque.

    Raises:
        ValueError: an optical depth that is not positive.
    """
    own = transfer.values if transfer.extinction_values is None else transfer.extinction_values
    values, extinction = np.asarray(own, np.float64), np.asarray(transfer.extinction, np.float64)
    return scaled(transfer, opaque_factor(shown, values, extinction, optical_depth))


def scaled(transfer: TransferFunction, factor: float) -> TransferFunction:
    """With so many times the extinction."""
    return dataclasses.replace(transfer, extinction=product(transfer.extinction, np.asarray(factor, transfer.extinction.dtype)))
