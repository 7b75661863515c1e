r"""What particles are at any places in space, in float64: field, coverage, its gradient, and who makes it (host side).

Flow: Particles, places -> [at_places] -> pixels explained, the view.

$C(x) = \sum_j V_j W_j(x)$ of kernels of unit integral is the coverage, $Q(x) = \sum_j q_j V_j W_j(x) / C(x)$ the field.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy.spatial
from jaxtyping import Float, Int

from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles
from jaxsph.reference.where import places_of

BLOCK = 1 << 14
"""Places that are looked at in one go: of liquids a million pairs of a place and a particle."""


class Near(NamedTuple):
    """Pairs of a place and a particle whose support holds it, in any order.

    Attributes:
        place: numbers of the places.
        entry: entries of the particles, as they are given; of a periodic set in any copy.
        weight: $V_j W_j$.
        gradient: of that by the place, a unit length.
    """

    place: Int[np.ndarray, " pairs"]
    entry: Int[np.ndarray, " pairs"]
    weight: Float[np.ndarray, " pairs"]
    gradient: Float[np.ndarray, "pairs 3"]


class AtPlaces(NamedTuple):
    """What is at places.

    Attributes:
        coverage: C, 0 outside of every support.
        gradient: of C, a unit length.
        quantity: Q (of two quantities that of colours); NaN outside of every support.
        number: of the particles whose supports hold the place.
    """

    coverage: Float[np.ndarray, " places"]
    gradient: Float[np.ndarray, "places 3"]
    quantity: Float[np.ndarray, " places"]
    number: Int[np.ndarray, " places"]

    @property
    def normal(self) -> Float[np.ndarray, "places 3"]:
        """Against the gradient, of unit length: out of a fluid; 0 where there is no slope."""
        length = np.linalg.norm(self.gradient, axis=1, keepdims=True)
        return np.divide(-self.gradient, length, out=np.zeros_like(self.gradient), where=length > 0)


class ParticleField:
    """Particles in float64, with every copy of a periodic set that reaches into its box; asked for places many times."""

    def __init__(self, particles: Particles) -> None:
        self._position, self._entry = places_of(particles)
        self._support, self._volume = (
            np.asarray(column, np.float64)[self._entry] for column in (particles.support, particles.volume)
        )
        self._quantities = np.asarray(particles.quantity, np.float64)
        self._kernel = kernels.by_name(particles.kernel)

    def near(self, places: Float[np.ndarray, "places 3"]) -> Near:
        """Who makes what is at some places."""
        if not len(places):
            return Near(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros((0, 3)))
        gap = np.maximum(np.maximum(places.min(0) - self._position, self._position - places.max(0)), 0)
        reaching = np.flatnonzero((gap < self._support[:, None]).all(1))
        found = scipy.spatial.cKDTree(places).query_ball_point(self._position[reaching], self._support[reaching])
        which = np.repeat(reaching, [len(one) for one in found])
        place = np.concatenate([np.zeros(0, int), *(np.asarray(one, int) for one in found if one)])
        offset, support = places[place] - self._position[which], self._support[which]
        square = (offset**2).sum(1) / support**2
        strength = self._kernel.norm * self._volume[which] / support**3
        slope = self._kernel.slope(self._kernel.prepare(square, 1.0), 0.0, 1.0, np)
        weight = strength * self._kernel.of_square(square, np)
        return Near(place, self._entry[which], weight, (2 * strength * slope / support**2)[:, None] * offset)

    def at(self, places: Float[np.ndarray, "places 3"]) -> AtPlaces:
        """What is at places (P, 3), length units."""
        blocks = [self._at(places[begin : begin + BLOCK]) for begin in range(0, max(len(places), 1), BLOCK)]
        return AtPlaces(*(np.concatenate(column) for column in zip(*blocks, strict=True)))

    def _at(self, places: np.ndarray) -> AtPlaces:
        near, count = self.near(places), len(places)

        def summed(values: np.ndarray) -> np.ndarray:
            return np.bincount(near.place, values, count).astype(np.float64)  # of none they are whole numbers

        coverage = summed(near.weight)
        weighted = summed(near.weight * self._quantities[near.entry])
        quantity = np.divide(weighted, coverage, out=np.full(count, np.nan), where=coverage > 0)
        gradient = np.stack([summed(component) for component in near.gradient.T], 1)
        return AtPlaces(coverage, gradient, quantity, np.bincount(near.place, minlength=count))
