r"""Profiles of points: how extinction falls off from a point's centre, and its integrals along rays.

Flow: [profiles] -> points -> field, reference.

Lengths here are in radii of the point: a ray passes the centre at the distance b, and t counts from there, so that the profile f
meets it at $\sqrt{b^2 + t^2}$. A point ends where its radius does, whatever its profile is there.
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
from jaxtyping import Array, Float

from jaxsph.numerics.checks import array_of, is_traced, require_finite, require_positive, require_real, require_shape
from jaxsph.numerics.extremes import lesser
from jaxsph.numerics.given import plain
from jaxsph.numerics.trees import tree

FALLOFF = 4.5  # of the Gaussian: its radius is three standard deviations
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Of either half of a chord: all of a Gaussian is met to 1e-6, of an exponential decay, which has a cusp at the centre, to 1e-3,
and a table to about its steps over their number."""


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

    Raises:
        ValueError: another name, or a table that is not a row of at least two finite numbers >= 0.
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
    given = plain("profile", given, "it is a share of the extinction")
    values = given if isinstance(given, jax.Array) else np.asarray(given)
    require_real("profile", values)
    require_shape("profile", values, (None,), "give numbers at distances evenly spaced from the centre to the radius")
    if values.shape[0] < 2:
        raise ValueError(f"`profile` must be a table of at least 2 numbers, got {values.shape[0]}; or give 'gaussian' or 'ball'")
    if not is_traced(values):
        require_finite("profile", values)
        require_positive("profile", values, "extinction cannot be negative", strict=False)
        with np.errstate(over="ignore"):
            values = np.asarray(values).astype(dtype)
        require_finite("profile", values, f"it overflows {values.dtype}: give shares of the extinction, such as 0 to 1")
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
