r"""Surface: where the coverage of particles reaches a level, as fluids are drawn, or where a quantity does.

Flow: user -> [surface] -> scene -> viewing -> media.

$\sum V_j W_j(x)$ of kernels of unit integral is about 1 within a fluid, and falls to 0 over a support outside of it. Where it is
a half lies the surface of the fluid, but for the curvature of thin parts.
"""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import numpy as np
import scipy.spatial
from jaxtyping import Array, Float

from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.numerics.checks import is_traced, product, require_finite, require_positive, require_shape
from jaxsph.numerics.trees import tree

FIELDS = ("coverage", "quantity", "extinction_quantity")  # what a surface is a level of: see `Surface.of`
NOT_ZERO = {"level": "coverage is 0 away from a fluid", "smoothing": "1 takes supports as given"}
MOST_CENTERS = 256
COLOR, AMBIENT = (0.42, 0.66, 0.86), 0.3
"""Of a surface that no transfer function colours: that of water; and what it has of it where it is seen edge on."""


@tree(static=("of",), unchecked=True)
class Surface:
    r"""The surface of a scene's particles: where a ray first crosses a level of a field of theirs; `Scene(surface=...)`.

    The field is $F(x) = \sum_j a_j V_j W(|x - x_j|, s H_j)$ with kernels of unit integral, supports H and `smoothing` s. With
    all a = 1 that is the coverage; else a is a quantity of the particles, and F what they have of it at x, which falls to 0
    outside of them: the density of gas, say. The surface is opaque, and particles are shown by it alone: there is no fog of
    them. It is lit from the eye (Lambert): $c \, (a + (1 - a) \, |n \cdot d|)$, with d
    the ray's direction, a the share of ambient light and n along the gradient of F. Its colour c is that of the scene's transfer
    function, at the mean of the quantity there, by what particles add to F; without one `color`.

    **What is found.** Every crossing between neighbouring samples of a ray (`Settings.samples`), to rounding; of thin parts see
    `jaxsph.engine.media.surfaces.particle_surface`, which says what is found between samples, and what is an estimate.

    **Derivatives** by positions, supports, volumes, quantities, level, smoothing and camera are those of an implicit function, of
    depth, normal and colour alike. Silhouettes have none: a ray that stops meeting the surface is not foreseen.

    Nothing closes a fluid where a clip cuts it or a ray begins in it: there the first crossing is where the ray leaves it.

    Attributes:
        level: of the field, > 0. Of the coverage a half is halfway between fluid and nothing; a droplet of one particle has
            $V W(0, s H)$ at its centre, and shows at lower levels alone.
        of: the field (static): `"coverage"`; `"quantity"`, of the particles, by which the transfer function colours them as
            well; or `"extinction_quantity"`, their second, such that one is coloured by another. Neither may be negative.
        smoothing: what supports are multiplied by, > 0: 1.5 to 2 evens out bumps of single particles, and takes away droplets.
        color: red, green and blue (3,) in [0, 1], where there is no transfer function.
        ambient: share of the colour that the surface has where it is seen edge on, in [0, 1].

    Raises:
        ValueError: a level or a smoothing that is not > 0 and finite, another field, a colour or a share outside of [0, 1].
    """

    level: Float[Array, ""] | Any = 0.5
    of: str = "coverage"
    smoothing: Float[Array, ""] | Any = 1.0
    color: Float[Array, "3"] | Any = COLOR
    ambient: Float[Array, ""] | Any = AMBIENT

    def __post_init__(self) -> None:
        if self.of not in FIELDS:
            raise ValueError(f"`of` must be one of {', '.join(map(repr, FIELDS))}, got {self.of!r}")
        require_looks(level=self.level, smoothing=self.smoothing, color=self.color, ambient=self.ambient)
        for name, remedy in NOT_ZERO.items():
            if not is_traced(getattr(self, name)):
                require_positive(name, np.asarray(getattr(self, name), np.float64), remedy)

    def check(self, particles: Particles) -> None:
        """Raise `ValueError` where particles lack the quantity that it is of, or where that is negative, or out of range."""
        values = particles.volume if self.of == "coverage" else getattr(particles, self.of)
        if values is None:
            raise ValueError(f"`surface` is of the {self.of!r} of `particles`, which have one quantity; give them a second")
        if self.of == "coverage" or is_traced(particles):
            return
        numbers, volumes = (np.asarray(column)[np.asarray(particles.valid)] for column in (values, particles.volume))
        if (numbers < 0).any():
            raise ValueError(
                f"`surface` is of a quantity that may not be negative, got {numbers.min():g}: shift it, and the level"
            )
        with np.errstate(over="ignore", under="ignore"):
            made = numbers * volumes
        if ((made < np.finfo(made.dtype).tiny) & (numbers > 0) & (volumes > 0)).any() or not np.isfinite(made).all():
            raise ValueError(
                f"`surface` is of quantity times volume, and {numbers.max():g} times {volumes.max():g} leaves the range of "
                f"{made.dtype}; give the quantity in other units"
            )

    def makers(self, particles: Particles, smoothing: Any) -> Particles:
        """Particles whose coverage is the field: with supports that `smoothing` widens, and the quantity in their volumes."""
        support = product(particles.support, smoothing.astype(particles.support.dtype))
        volume = particles.volume if self.of == "coverage" else product(particles.volume, getattr(particles, self.of))
        return dataclasses.replace(particles, support=support, volume=volume)


def require_looks(**numbers: Any) -> None:
    """Raise `ValueError` where what makes a surface has another shape or is not finite; colours and shares lie in [0, 1]."""
    for name, value in numbers.items():
        rgb = name == "color"
        require_shape(name, value, (3,) if rgb else (), "give red, green and blue" if rgb else "give one number")
        if is_traced(value):
            continue
        number = np.asarray(value, np.float64)
        require_finite(name, number, "give a finite number")
        if name in ("color", "ambient") and not ((number >= 0) & (number <= 1)).all():
            raise ValueError(f"`{name}` must lie in [0, 1], got {value}")


def coverage_at_centers(particles: Particles, most: int = MOST_CENTERS) -> np.ndarray:
    r"""$\sum V_j W_j$ at the centres of some particles, at most so many, evenly out of all; nothing without any (host side)."""
    columns, kernel = particles.to_numpy(), kernels.by_name(particles.kernel)
    position, support, volume = (columns[name].astype(np.float64) for name in ("position", "support", "volume"))
    centers = position[:: max(-(-len(position) // most), 1)]
    place, which, offset = pairs(centers, position, support)
    weight = kernel.norm * kernel.of_square((offset**2).sum(1) / support[which] ** 2, np)
    return np.bincount(place, weight * volume[which] / support[which] ** 3, len(centers))


def pairs(places: np.ndarray, position: np.ndarray, support: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers of places, those of the particles whose supports hold them, and how far from these, (pairs, 3); in float64."""
    low, high = places.min(0, initial=np.inf), places.max(0, initial=-np.inf)
    gap = np.maximum(low - position, position - high)
    reaching = np.flatnonzero((gap < support[:, None]).all(1))
    found = scipy.spatial.cKDTree(places).query_ball_point(position[reaching], support[reaching], return_sorted=False)
    which = np.repeat(reaching, np.fromiter(map(len, found), int))
    place = np.fromiter(itertools.chain.from_iterable(found), int, len(which))
    return place, which, places[place] - position[which]
