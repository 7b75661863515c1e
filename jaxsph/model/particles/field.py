r"""What particles are at any places in space, summed up on the host: the one field in float64 by NumPy.

Flow: Particles, places or rays of samples -> [field] -> samples, grids, first pictures, a surface's level.

$C(x) = \sum_j V_j W_j(x)$ of kernels of unit integral is the coverage, $Q(x) = \sum_j q_j V_j W_j(x) / C(x)$ the field.
Places anywhere are found by a tree; samples that are even along rays, as points of a grid are, by the rays that supports meet.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import scipy
from jaxtyping import Float, Int

from jaxsph.model.particles.kernels import Kernel, by_name
from jaxsph.model.particles.particles import Particles, capacity_class
from jaxsph.numerics.checks import require_finite, require_positive

BLOCK, MOST_PAIRS = 1 << 14, 1 << 22  # places that are looked at in one go, and how many pairs of these there may be or so
FEW = 64  # places that tell how many there are
PAIRS = 1 << 16  # particles times rays, and samples of these, that are looked at in one go: they stay in the caches
MOST_CENTERS = 256


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
    """Particles in float64, with every copy of a periodic set that reaches into its box; asked for places many times.

    Attributes:
        entry: of the particle that each is, in the arrays of the set.
        position, support, volume, quantities: of each.
        kernel: of all.
    """

    def __init__(self, particles: Particles, copied: bool = True, signed: bool = False) -> None:
        self.own: Any = slice(None)  # those that are no copies
        self.entry, self.kernel = np.flatnonzero(np.asarray(particles.valid)), by_name(particles.kernel)
        self.position = particles.exact_position()[self.entry]
        columns = particles.support, particles.volume, *particles.quantities
        self.support, self.volume, *self.quantities = (np.asarray(column, np.float64)[self.entry] for column in columns)
        named = {"position": self.position, "support": self.support, "volume": self.volume, "quantity": self.quantities[0]}
        for name, column in named.items():
            require_finite(name, column)
        require_positive("support", self.support, "give the support radius H > 0 of every particle")
        if not signed:  # amounts of a plain sum may be of either sign
            require_positive("volume", self.volume, "give the volume V >= 0 of every particle", strict=False)
        if copied and particles.box is not None and len(self.entry):
            self._copy(*particles.box.corners())

    def _copy(self, lower: np.ndarray, upper: np.ndarray) -> None:
        """Take every copy of all that reaches into a period."""
        period = upper - lower
        most = np.ceil(self.support.max() / period).astype(int) + 1
        turns = np.array(list(itertools.product(*(range(-k, k + 1) for k in most))))
        copies = lower + (self.position - lower) % period + (period * turns)[:, None]
        away = np.linalg.norm(np.maximum(np.maximum(lower - copies, copies - upper), 0), axis=2)
        turn, which = np.nonzero(away < self.support)
        self.own = (turns == 0).all(1)[turn]
        self.position, self.entry = copies[turn, which], self.entry[which]
        columns = self.support, self.volume, *self.quantities
        self.support, self.volume, *self.quantities = (column[which] for column in columns)

    def pairs(self, places: Float[np.ndarray, "places 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Numbers of places, those of the particles whose supports hold them, and how far from these, (pairs, 3)."""
        low, high = places.min(0, initial=np.inf), places.max(0, initial=-np.inf)
        gap = np.maximum(low - self.position, self.position - high)
        reaching = np.flatnonzero((gap < self.support[:, None]).all(1))
        tree, some = scipy.spatial.cKDTree(places), (self.position[reaching], self.support[reaching])
        found = tree.query_ball_point(*some, return_sorted=False)
        which = np.repeat(reaching, np.fromiter(map(len, found), int))
        place = np.fromiter(itertools.chain.from_iterable(found), int, len(which))
        return place, which, places[place] - self.position[which]

    def padded(self, places: Float[np.ndarray, "places 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs with entries, padded so that programs recur: with a place beyond all."""
        place, which, offset = self.pairs(places)
        room = 0, capacity_class(len(place)) - len(place)
        place, entry = np.pad(place, room, constant_values=BLOCK), np.pad(self.entry[which], room)
        return place, entry, np.pad(offset, (room, (0, 0)))

    def blocks(self, places: Float[np.ndarray, "places 3"]) -> list[slice]:
        """Places that are looked at in one go: fewer where supports hold many of them, as some tell."""
        some, size = places[:: len(places) // FEW + 1], BLOCK
        if len(some) > 1:
            number = scipy.spatial.cKDTree(some).query_ball_point(self.position, self.support, return_length=True).sum()
            size = int(np.clip(MOST_PAIRS * len(some) // max(number, 1), 1, BLOCK))
        return [slice(begin, begin + size) for begin in range(0, max(len(places), 1), size)]

    def at(self, places: Float[np.ndarray, "places 3"]) -> AtPlaces:
        """What is at places (P, 3), length units."""
        found = [self._at(places[block]) for block in self.blocks(places)]
        return AtPlaces(*(np.concatenate(column) for column in zip(*found, strict=True)))

    def _at(self, places: np.ndarray) -> AtPlaces:
        place, which, offset = self.pairs(places)
        support, count = self.support[which], len(places)
        square = (offset**2).sum(1) / support**2
        strength = self.kernel.norm * self.volume[which] / support**3
        slope = self.kernel.slope(self.kernel.prepare(square, 1.0), 0.0, 1.0, np)
        weight = strength * self.kernel.of_square(square, np)

        def summed(values: np.ndarray) -> np.ndarray:
            return np.bincount(place, values, count).astype(np.float64)  # of none they are whole numbers

        coverage, weighted = summed(weight), summed(weight * self.quantities[0][which])
        quantity = np.divide(weighted, coverage, out=np.full(count, np.nan), where=coverage > 0)
        gradient = np.stack([summed(2 * strength * slope / support**2 * along) for along in offset.T], 1)
        return AtPlaces(coverage, gradient, quantity, np.bincount(place, minlength=count))

    def at_centers(self, most: int = MOST_CENTERS) -> AtPlaces:
        """What is at the centres of some particles, at most so many, evenly out of all."""
        centers = self.position[self.own]
        return self.at(centers[:: max(-(-len(centers) // most), 1)])

    def along(self, rays: EvenSamples, view: np.ndarray, number: int | None = None) -> tuple[np.ndarray, float]:
        """C and each Q C of a `number` of quantities at samples, (1 + number, rows, columns, steps), over a unit; and that."""
        strength = self.volume / self.support**3
        strongest = float(strength.max(initial=0)) or 1.0
        strength = strength / strongest
        amounts = np.stack([strength, *(strength * quantity for quantity in self.quantities[:number])])
        return rays.sums(view, self.support, amounts, self.kernel), self.kernel.norm * strongest


@dataclasses.dataclass(frozen=True, eq=False)
class EvenSamples:
    """Rays, parallel or from the origin, and where samples are along them: of a coarse picture, or of a grid of points.

    Attributes:
        u, v: lateral coordinates of columns and rows, that ascend or descend: tangents if perspective, else length units.
        near, step, steps: the depth at which samples begin, how far they are apart, and how many there are.
        offset: of the first sample of each ray, in steps.
        is_perspective: whether rays are from the origin.
    """

    u: Float[np.ndarray, " columns"]
    v: Float[np.ndarray, " rows"]
    near: float
    step: float
    steps: int
    offset: Float[np.ndarray, "rows columns"]
    is_perspective: bool

    @functools.cached_property
    def slant(self) -> Float[np.ndarray, "rows columns"]:
        """Square of the length of ray a unit of depth."""
        return 1 + self.v[:, None] ** 2 + self.u**2 if self.is_perspective else np.ones_like(self.offset)

    def sums(self, view: np.ndarray, support: np.ndarray, amounts: np.ndarray, kernel: Kernel) -> np.ndarray:
        """At all samples, of (channels, N) amounts of particles times kernels, whose peak is not normed; by view coordinates.

        Pairs of a ray and a particle that have as many samples are taken together.
        """
        sums, adds = np.zeros((len(amounts), self.offset.size * self.steps)), (amounts != 0).any(0)
        for ray, of, away, nearest, half in self._chords(view, support, adds):
            half, scale = half / self.step, self.step * np.sqrt(self.slant.ravel()[ray]) / support[of]
            middle = (nearest - self.near) / self.step - self.offset.ravel()[ray]
            first = np.maximum(np.ceil(middle - half), 0)
            count = np.where(away < 1, np.minimum(np.floor(middle + half) + 1, self.steps) - first, 0).clip(0).astype(np.int64)
            begin, start = ray * self.steps + first.astype(np.int64), (first - middle) * scale
            order = np.argsort(count.astype(np.min_scalar_type(self.steps)), kind="stable")  # of short numbers in one pass
            ends = np.searchsorted(count[order], np.arange(count.max(initial=0) + 1), "right")
            runs = [(n, k) for n in range(1, len(ends)) for k in range(ends[n - 1], ends[n], PAIRS // n + 1)]
            for number, at in runs:
                which, along = order[at : min(at + PAIRS // number + 1, ends[number])], np.arange(number)
                square = away[which, None] + (start[which, None] + scale[which, None] * along) ** 2
                weight, entry = kernel.of_square(square, np), (begin[which, None] + along).ravel()
                for total, amount in zip(sums, amounts, strict=True):
                    np.add.at(total, entry, (weight * amount[of[which], None]).ravel())
        return sums.reshape(-1, *self.offset.shape, self.steps)

    def largest(self, view: np.ndarray, support: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The largest of the values of particles whose supports each ray meets between its ends, and how many these are.

        (rows, columns) each; -inf where there are none.
        """
        found, number = np.full(self.offset.size, -np.inf), np.zeros(self.offset.size)
        for ray, of, away, nearest, half in self._chords(view, support, np.ones(len(support), bool)):
            met = (away < 1) & (nearest + half >= self.near) & (nearest - half <= self.near + self.step * self.steps)
            np.maximum.at(found, ray[met], values[of[met]])
            number += np.bincount(ray[met], minlength=len(number))
        return found.reshape(self.offset.shape), number.reshape(self.offset.shape)

    def _chords(self, view: np.ndarray, support: np.ndarray, adds: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
        """Of pairs of a ray and a particle the square of their distance in supports, its depth, and half of the depth inside."""
        for ray, of in self._pairs(view, support, adds):
            row, column = np.divmod(ray, len(self.u))
            (x, y, z), u, v, slant = view[of].T, self.u[column], self.v[row], self.slant.ravel()[ray]
            radius, nearest, spread = support[of], z, 1.0
            if self.is_perspective:
                nearest = spread = (x * u + y * v + z) / slant
            away = ((spread * u - x) ** 2 + (spread * v - y) ** 2 + (nearest - z) ** 2) / radius**2
            yield ray, of, away, nearest, np.sqrt(np.maximum(1 - away, 0) / slant) * radius

    def _boxes(self, view: np.ndarray, support: np.ndarray, adds: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """First columns and rows of rays that may meet each particle, and how many; none of particles that add nothing."""
        front, back = view[:, 2] - support, view[:, 2] + support
        begins, sizes, reach = [], [], support
        if not self.is_perspective:  # of spheres that samples cut aside of their middles
            beside = np.maximum(np.maximum(self.near - view[:, 2], view[:, 2] - self.near - self.step * self.steps), 0)
            reach = np.sqrt(np.maximum(support**2 - beside**2, 0))
        for axis, places in enumerate((self.u, self.v)):
            low, high = view[:, axis] - reach, view[:, axis] + reach
            if self.is_perspective:
                safe, behind = np.where(front > 0, front, 1), np.where(back > 0, back, 1)
                around = front <= self.near / 2
                low = np.where(around, -np.inf, np.minimum(low / safe, low / behind))
                high = np.where(around, np.inf, np.maximum(high / safe, high / behind))
            begin, end = (np.searchsorted(np.sort(places), edge) for edge in (low, high))
            begins.append(len(places) - end if places[0] > places[-1] else begin)
            sizes.append(end - begin)
        there = adds & (back >= self.near) & (front <= self.near + self.step * self.steps)
        return begins, [sizes[0] * there, sizes[1] * there]

    def _pairs(self, view: np.ndarray, support: np.ndarray, adds: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Numbers of rays, and particles that may meet them, of all pairs, some at a time; of particles that add anything."""
        begins, sizes = self._boxes(view, support, adds)
        number = sizes[0] * sizes[1]
        some, ends = np.flatnonzero(number), np.cumsum(number[number > 0])
        for few in np.split(some, np.searchsorted(ends, np.arange(PAIRS, number.sum(), PAIRS))):
            of, before = np.repeat(few, number[few]), np.cumsum(number[few]) - number[few]
            row, column = np.divmod(np.arange(len(of)) - np.repeat(before, number[few]), sizes[0][of])
            yield (begins[1][of] + row) * len(self.u) + begins[0][of] + column, of
