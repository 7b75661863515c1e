r"""Points: stars, galaxies, tracers, spray: each with a radius, a colour and an extinction of its own; and their profiles.

Flow: files, arrays -> [points] -> field -> cast -> image.

A profile f says how extinction falls off from a point's centre. In profiles lengths are in radii of the point: a ray passes the
centre at the distance b, and t counts from there, so that f meets it at $\sqrt{b^2 + t^2}$. A point ends where its radius does,
whatever its profile is there.
"""

from __future__ import annotations

import abc
import functools
import math
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsph.model.particles.particles import PaddedSet, Particles, columns_of, packed
from jaxsph.numerics import checks
from jaxsph.numerics.checks import array_of, at_hand, is_traced, module_for
from jaxsph.numerics.compiled import lesser
from jaxsph.numerics.trees import count_of, line_of, span_of, tree

FALLOFF = 4.5  # of the Gaussian: its radius is three standard deviations
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Of either half of a chord: all of a Gaussian is met to 1e-6, of an exponential decay, which has a cusp at the centre, to 1e-3,
and a table to about its steps over their number."""
SPREADS = "chords", "feet", "centres"
MAIN = "position", "radius", "color", "extinction"
LEAST = {"radius": "give the radius of every point, where its light ends"}
LEAST |= dict.fromkeys(("extinction", "opacity"), "points can only take light away or emit it")


class Chord(NamedTuple):
    """Where a ray passes a point, in radii.

    Attributes:
        foot: from the centre to the nearest point of the ray, along the axes of the world.
        direction: of the ray, of length 1, along the axes of the world.
        attributes: of the point, by name.
    """

    foot: tuple[Array, Array, Array]
    direction: tuple[Array, Array, Array]
    attributes: dict[str, Array]


class Profile(abc.ABC):
    """How much of a point's extinction is left, as a function of the offset from its centre; finite, >= 0."""

    @abc.abstractmethod
    def at_square(self, square: Float[Array, "..."]) -> Float[Array, "..."]:
        """At a squared distance in [0, 1]."""

    def along(self, square: Float[Array, "..."], start: Float[Array, "..."], end: Float[Array, "..."]) -> Float[Array, "..."]:
        """Integral over t from `start` to `end`, both inside, at the squared distance b^2; by Gauss-Legendre quadrature."""
        return _quadrature(lambda t: self.at_square(square + t**2), start, end)

    def through_centre(self) -> Float[Array, ""]:
        """The integral along a whole ray through the centre."""
        return self.along(jnp.zeros(()), -jnp.ones(()), jnp.ones(()))


@tree()
class Gaussian(Profile):
    r"""$f(q) = \exp(-4.5 q^2)$, which the radius cuts off at three standard deviations (Kaehler et al. 2007, section 3.2)."""

    def at_square(self, square: Float[Array, "..."]) -> Float[Array, "..."]:
        """See `Profile`."""
        return jnp.exp(-FALLOFF * square)

    def along(self, square: Float[Array, "..."], start: Float[Array, "..."], end: Float[Array, "..."]) -> Float[Array, "..."]:
        """In closed form, by the error function."""
        scale = math.sqrt(FALLOFF)
        between = jax.lax.erf(scale * end) - jax.lax.erf(scale * start)
        return (0.5 * math.sqrt(math.pi) / scale) * self.at_square(square) * between


@tree()
class Ball(Profile):
    """f(q) = 1: the same everywhere inside."""

    def at_square(self, square: Float[Array, "..."]) -> Float[Array, "..."]:
        """See `Profile`."""
        return jnp.ones_like(square)

    def along(self, square: Float[Array, "..."], start: Float[Array, "..."], end: Float[Array, "..."]) -> Float[Array, "..."]:
        """The length."""
        return jnp.broadcast_to(end - start, jnp.broadcast_shapes(square.shape, start.shape, end.shape))


@tree()
class Table(Profile):
    """Numbers at distances evenly spaced from the centre to the radius, linear between.

    Attributes:
        values: >= 0; an image can be differentiated by them.
    """

    values: Float[Array, " distances"]

    def at_square(self, square: Float[Array, "..."]) -> Float[Array, "..."]:
        """See `Profile`."""
        last = self.values.shape[0] - 1
        solid = square > 0
        place = lesser(jnp.where(solid, jnp.sqrt(jnp.where(solid, square, 1)), 0) * last, last)
        whole = jnp.minimum(place.astype(jnp.int32), max(last - 1, 0))
        low, high = self.values[whole], self.values[jnp.minimum(whole + 1, last)]
        return low + (place - whole) * (high - low)

    def through_centre(self) -> Float[Array, ""]:
        """Exactly: along such a ray it is linear between its numbers."""
        return (self.values[:-1] + self.values[1:]).sum() / (self.values.shape[0] - 1)


@tree(static=("function",))
class Shaped(Profile):
    """Any function of the offset, not necessarily the same in all directions.

    Attributes:
        function: `function(offset, attributes)` with x, y and z of the offset in radii, along the axes of the world, and the
            attributes of the point by name, all of one shape; returns what is left of the extinction, >= 0. It must be
            made of `jax.numpy`, and is a part of what is compiled: give the same object again, not a new lambda each time.
    """

    function: Callable[[tuple[Array, Array, Array], dict[str, Array]], Array]

    def at_square(self, square: Float[Array, "..."]) -> Float[Array, "..."]:
        """Not known by the distance alone."""
        raise ValueError("`profile` is a function of the offset: it has no value at a distance; give `extinction`, not `opacity`")

    def along_chord(self, chord: Chord, start: Float[Array, "..."], end: Float[Array, "..."]) -> Float[Array, "..."]:
        """Integral over t from `start` to `end`, by Gauss-Legendre quadrature."""

        def value(t: Array) -> Array:
            x, y, z = (at + t * step for at, step in zip(chord.foot, chord.direction, strict=True))
            x, y, z = jnp.broadcast_arrays(x, y, z)
            return self.function((x, y, z), {name: jnp.broadcast_to(one, x.shape) for name, one in chord.attributes.items()})

        return _quadrature(value, start, end)


BY_NAME: dict[str, Profile] = {"gaussian": Gaussian(), "ball": Ball()}


def profile_of(given: Any, dtype: Any) -> Profile:
    """A profile by name, from a table of numbers or from a function of the offset.

    Raises `ValueError`: another name, or a table that is not a row of at least two finite numbers >= 0.
    """
    if isinstance(given, Profile):
        return given
    if isinstance(given, str):
        if given not in BY_NAME:
            known = ", ".join(repr(name) for name in BY_NAME)
            raise ValueError(f"`profile` must be {known}, a table of numbers or a function of the offset, got {given!r}")
        return BY_NAME[given]
    if callable(given):
        return Shaped(given)
    values = checks.require_real("profile", checks.plain("profile", given, "it is a share of the extinction"))
    checks.require_shape("profile", values, (None,), "give numbers at distances evenly spaced from the centre to the radius")
    if values.shape[0] < 2:
        raise ValueError(f"`profile` must be a table of at least 2 numbers, got {values.shape[0]}; or give 'gaussian' or 'ball'")
    if not is_traced(values):
        checks.require_finite("profile", values)
        checks.require_positive("profile", values, "extinction cannot be negative", strict=False)
        with np.errstate(over="ignore"):
            values = np.asarray(values).astype(dtype)
        checks.require_finite("profile", values, f"it overflows {values.dtype}: give shares of the extinction, such as 0 to 1")
    return Table(array_of(values, dtype))


def _quadrature(value: Callable[[Array], Array], start: Array, end: Array) -> Array:
    """Gauss-Legendre on either side of the foot, where profiles may have a cusp."""
    halves = []
    for side in (jnp.minimum, jnp.maximum):
        low, high = side(start, 0), side(end, 0)
        middle, half = 0.5 * (low + high), 0.5 * (high - low)
        rule = zip(NODES, WEIGHTS, strict=True)
        terms = (float(weight) * value(middle + float(node) * half) for node, weight in rule)
        halves.append(half * functools.reduce(operator.add, terms))
    return functools.reduce(operator.add, halves)


@tree(static=("spread", "length_unit"))
class Points(PaddedSet):
    """A set of points; make it with `from_arrays`.

    At an offset d from its centre a point has the extinction `extinction * profile(|d| / radius)` a unit length, and none where
    its radius ends. Where points overlap, extinctions add up, and colours weigh by extinction. Unlike the field of `Particles`,
    nothing is normalised: more points are more light. Arrays are padded to a capacity, with the first point; values may be
    changed by `dataclasses.replace` under jit without recompiling.

    Attributes:
        position: of centres, world coordinates, length units.
        radius: > 0, length units.
        color: red, green, blue in [0, 1].
        extinction: at the centre, >= 0, a unit length.
        valid: which entries are points; the rest is padding.
        attributes: further numbers of each point by name, for a profile that reads them.
        profile: how extinction falls off, see `Profile`.
        position_rest: what rounding float64 positions has left; None where that is a negligible part of every radius.
        splats_beyond: distance from the eye (depth, if the view is orthographic) beyond which points are splats: spread as
            "centres"; None where none are.
        spread: how a point's thickness is laid along a ray. "chords": where it is, to a sample: what each sample of the ray
            stands for has the integral of extinction along it. "feet": all of it in the one sample with the foot of the centre
            on the ray (Kaehler, Abel & Hege 2007, section 3.2). "centres": all of it at the depth of the centre, as a splat has
            it. What a ray meets in all is the same, and so is alpha away from clips, near and far; how it is ordered in depth is
            not. Colours by feet differ from those by chords by at most a point's opacity times that of what else lies along its
            chord, to a sample: nothing where points are alone. A tolerance along rays is kept for chords only.
        length_unit: what the unit of lengths is called, where positions were given with one (static).
    """

    position: Float[Array, "points 3"]
    radius: Float[Array, " points"]
    color: Float[Array, "points 3"]
    extinction: Float[Array, " points"]
    valid: Bool[Array, " points"]
    attributes: dict[str, Float[Array, " points"]]
    profile: Profile
    position_rest: Float[Array, "points 3"] | None = None
    splats_beyond: Float[Array, ""] | None = None
    spread: str = "chords"
    length_unit: str | None = None

    def __repr__(self) -> str:
        return line_of(
            "Points",
            f"{count_of(self.valid)}, {getattr(self.position, 'dtype', 'of no type')}",
            f"radius {span_of(self.radius, self.valid)}" + ("" if self.length_unit is None else f" {self.length_unit}"),
            f"extinction {span_of(self.extinction, self.valid)}",
            None if self.spread == "chords" else f"spread at {self.spread}",
        )

    @classmethod
    @checks.typed
    def from_arrays(
        cls,
        position: Any,
        radius: Any,
        color: Any = (1.0, 1.0, 1.0),
        extinction: Any = None,
        profile: Any = "gaussian",
        *,
        opacity: Any = None,
        attributes: dict[str, Any] | None = None,
        spread: str = "chords",
        splats_beyond: Any = None,
        capacity: int | None = None,
    ) -> Points:
        """Check and pack arrays of points.

        Arrays may carry units, as those of unyt and astropy do. Lengths and extinctions are then converted to that of `position`,
        in which numbers without one are meant; attributes keep their own.

        Args:
            position: (N, 3), length units; N = 0 is an empty set.
            radius: (N,) or a number, > 0, length units.
            color: (N, 3) or (3,), in [0, 1].
            extinction: (N,) or a number, >= 0: at the centre, a unit length. Give this or `opacity`.
            profile: `"gaussian"` (exp(-4.5 q^2), q in radii, cut off at 1), `"ball"` (constant), numbers at distances evenly
                spaced from the centre to the radius, or a function of the offset and the attributes, see `Shaped`.
            opacity: (N,) or a number in [0, 1): that of a whole point along a ray through its centre.
            attributes: (N,) or a number each, by name.
            spread: "chords", "feet" or "centres", see `Points`.
            splats_beyond: distance >= 0 beyond which points are splats; None for none.
            capacity: pad to this many entries; default the class of N, so that sets of similar size share programs.

        Returns:
            Points of dtype float64 if `position` is float64 and x64 is enabled, else float32.

        Raises:
            ValueError: wrong shapes, numbers that are not finite or out of range, neither or both of extinction and opacity,
                an unknown profile or spread, capacity < N, an attribute named as what every point has, an opacity where the
                profile has none through the centre, or is not known by distance alone; masks, units of another kind.
        """
        if spread not in SPREADS:
            raise ValueError(f"`spread` must be one of {', '.join(map(repr, SPREADS))}, got {spread!r}")
        if not isinstance(attributes, dict | None):
            raise ValueError(f"`attributes` must be a dictionary of numbers by name, got {type(attributes).__name__}")
        position, unit = checks.with_unit("position", position)
        given = {"position": position, "radius": checks.in_unit("radius", radius, unit), "color": checks.plain("color", color)}
        columns = columns_of("point", given | _strengths(extinction, opacity, attributes or {}, unit), LEAST)
        shape = profile_of(profile, jnp.promote_types(jax.dtypes.canonicalize_dtype(columns["position"].dtype), jnp.float32))
        if opacity is not None:
            columns["extinction"] = _extinction(columns.pop("opacity"), columns["radius"], shape)
        entries = packed("point", columns, "radius", capacity)
        beyond = _beyond(splats_beyond, unit, entries["position"].dtype)
        main = {name: entries.pop(name) for name in (*MAIN, "valid", "position_rest")}
        more: dict[str, Any] = {"splats_beyond": beyond, "spread": spread, "length_unit": checks.name_of(unit)}
        return cls(**main, attributes=entries, profile=shape, **more)

    @property
    def num_points(self) -> int:
        """Number of points that exist (host side)."""
        return len(self)

    def usable(self) -> Bool[Array, " points"]:
        """Points that exist, with numbers that mean something."""
        xp, own = at_hand(self)
        finite = xp.isfinite(own.position).all(1) & xp.isfinite(own.radius) & xp.isfinite(own.extinction)
        for value in own.attributes.values():
            finite &= xp.isfinite(value)
        shown = ((own.color >= 0) & (own.color <= 1)).all(1)
        return array_of(own.valid & finite & shown & (own.radius > 0) & (own.extinction >= 0))

    def spheres(self) -> Particles:
        """What they can be met in, as particles that carry nothing."""
        nothing = array_of(module_for(self.radius).zeros(self.radius.shape, self.radius.dtype))
        return Particles(self.position, self.radius, nothing, nothing, self.usable(), position_rest=self.position_rest)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corner of the box around all points, (3,) and (3,), float64, length units (host side)."""
        return self.spheres().bounds()


def _strengths(extinction: Any, opacity: Any, attributes: dict[str, Any], unit: Any) -> dict[str, Any]:
    """Extinction or opacity, by name, and attributes, none of which may stand for what every point has."""
    if (extinction is None) == (opacity is None):
        what = "neither" if extinction is None else "both"
        raise ValueError(f"one of `extinction` and `opacity` must be given, got {what}; opacity is that through the centre")
    taken = [name for name in attributes if name in (*MAIN, "opacity")]
    if taken:
        raise ValueError(f"`attributes` must not be named as what every point has, got {taken[0]!r}; give it another name")
    given = {name: checks.own(name, value) for name, value in attributes.items()}
    if opacity is None:
        return {"extinction": checks.in_unit("extinction", extinction, unit, -1)} | given
    return {"opacity": checks.plain("opacity", opacity, "it is a number")} | given


def _extinction(opacity: Any, radius: Any, profile: Profile) -> Any:
    """Extinction at the centre of points that have an opacity along a ray through it; in float64 where numbers are known."""
    through: Any = profile.through_centre()
    if not is_traced(through):
        through = float(through)
        if not through > 0:
            raise ValueError("`profile` is 0 along a ray through the centre; give `extinction`, not `opacity`")
    if is_traced(opacity):
        return -jnp.log1p(-opacity) / (radius * through)
    return -np.log1p(-np.asarray(opacity, np.float64)) / (radius * through)


def _beyond(distance: Any, unit: Any, dtype: Any) -> Array | None:
    """The distance beyond which points are splats, if there is one."""
    if distance is None:
        return None
    beyond = checks.one_number("splats_beyond", checks.in_unit("splats_beyond", distance, unit))
    if not is_traced(beyond) and not float(beyond) >= 0:
        raise ValueError(f"`splats_beyond` must be >= 0 or None, got {beyond!r}; it is a distance from the eye")
    return array_of(beyond, dtype)
