"""From particles to a grid: their CSPH field at the points of a lattice, as a volume.

Flow: particles -> [resample] -> Volume -> render, write_volume.

Particle by particle, each adds its weight to the points in its support: the sums that a sample gathers, in float64. Particles
whose supports span as many points are taken together, in the order in which they lie in memory, so that what a chunk adds to is
small.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxsph.analysis.at_places import carrying, rounded
from jaxsph.model.particles import kernels
from jaxsph.model.particles.particles import Particles, capacity_class
from jaxsph.model.particles.periodic import with_ghosts
from jaxsph.model.volume import Volume
from jaxsph.numerics.checks import require_finite, require_positive
from jaxsph.numerics.given import in_unit
from jaxsph.numerics.trees import on_host

PAIRS = 1 << 19  # (particle, point) pairs of a chunk: its arrays stay in the caches
ON_FACE = 1e-6  # of a spacing, that points may lie outside of a periodic box
BEYOND = 4.0  # a squared distance in supports, at which every kernel is 0


@on_host
def resample(
    particles: Particles,
    lower: Any,
    spacing: Any,
    shape: tuple[int, int, int],
    *,
    fill: float = 0.0,
    of: Any = None,
    normalised: bool = True,
) -> Volume:
    r"""The field $Q(x) = \sum q_j V_j W_j(x) / \sum V_j W_j(x)$ at the points of a grid, or a plain sum (host side, float64).

    Args:
        particles: whose quantity is resampled; of two, that of colours. Of a periodic set one period: there is nothing outside.
        lower: (3,) position of the point (0, 0, 0), length units.
        spacing: between neighbouring points, length units: a number, or (3,); > 0.
        shape: points along x, y and z, at least 2 each.
        fill: value of points outside of every support. Particles show nothing there, a volume what its transfer function makes of
            `fill`: give a value beyond the quantities, and extinction 0 from there to the first that is to be shown. Between a
            point inside and one outside the volume is interpolated, so borders are blurred by a cell. Of a plain sum, which is 0
            outside of supports, that of points outside of a period.
        of, normalised: as for `jaxsph.sample`: the plain sum of masses is the density, whose integral is the mass.

    Returns:
        Volume of the particles' dtype.

    Raises:
        ValueError: a shape, spacing, lower corner or fill out of range.

    References:
        Hochstetter, Orthmann & Kolb 2016, equations 1 and 2.
    """
    places = {"lower": lower, "spacing": spacing}.items()
    lower, spacing = (np.asarray(in_unit(name, value, particles.length_unit), np.float64) for name, value in places)
    if len(shape) != 3 or any(int(points) != points or points < 2 for points in shape):
        raise ValueError(f"`shape` must be three integers of at least 2, got {tuple(shape)}; give the points along x, y and z")
    for name, value, shapes in (("lower", lower, [(3,)]), ("spacing", spacing, [(), (3,)]), ("fill", np.asarray(fill), [()])):
        if value.shape not in shapes:
            raise ValueError(f"`{name}` must have shape {' or '.join(map(str, shapes))}, got {value.shape}")
        require_finite(name, value, "give finite numbers")
    require_positive("spacing", spacing, "spacing is the distance between neighbouring grid points")
    (held, exponent), spacing = carrying(particles, of, normalised), np.broadcast_to(spacing, 3)
    grid = _Sums(lower, spacing, tuple(int(points) for points in shape), with_ghosts(held), normalised)
    for box in grid.boxes():
        grid.add(*box)
    inside = grid.weight.reshape(shape) > 0 if normalised else np.ones(shape, bool)
    for axis, (low, high) in enumerate(() if particles.box is None else zip(*particles.box.corners(), strict=True)):
        at, slack = lower[axis] + spacing[axis] * np.arange(shape[axis]), ON_FACE * spacing[axis]
        inside &= np.moveaxis(((at >= low - slack) & (at <= high + slack))[:, None, None], 0, axis)
    inside = inside.ravel()
    sums = grid.weighted / np.where(inside, grid.weight, 1) if normalised else grid.weight
    values = np.where(inside, rounded(sums, exponent, particles.dtype), fill)
    made = Volume.from_array(values.reshape(shape).astype(particles.dtype), lower, spacing)
    return dataclasses.replace(made, length_unit=particles.length_unit)


class _Sums:
    """Sums of weights, and of quantities times weights, at all points of a grid."""

    def __init__(self, lower: np.ndarray, spacing: np.ndarray, shape: tuple[int, ...], particles: Particles, normalised: bool):
        valid, columns, self.spacing, self.shape = np.asarray(particles.valid), particles.to_numpy(), spacing, shape
        self.position = (particles.exact_position()[valid] - lower) / spacing
        self.support, self.quantity, volume = (columns[name].astype(np.float64) for name in ("support", "quantity", "volume"))
        self.kernel = kernels.by_name(particles.kernel)
        if normalised:  # ratios alone count, however far apart
            strength = np.log(np.where(volume > 0, volume, 1)) - 3 * np.log(self.support)
            largest = strength.max(initial=-np.inf, where=volume > 0)
            self.strength = np.where(volume > 0, np.exp(np.minimum(strength - largest, 0)), 0)
        else:
            self.strength = self.kernel.norm * volume / self.support**3
        self.weight, self.weighted = np.zeros((2, int(np.prod(shape))))

    def boxes(self) -> Iterator[tuple[np.ndarray, np.ndarray, tuple[range, ...]]]:
        """Particles whose supports span boxes of one size: which, the first point of each, and the offsets of all its points."""
        reach = self.support[:, None] / self.spacing
        first = np.maximum(np.ceil(self.position - reach), 0).astype(np.int64)
        last = np.minimum(np.floor(self.position + reach), np.array(self.shape) - 1).astype(np.int64)
        points = last - first + 1
        some = np.flatnonzero((points > 0).all(1) & (self.strength != 0))
        sizes = np.array([capacity_class(count) for count in range(max(self.shape) + 1)])[points[some]]
        ways, of_size = np.unique(sizes, axis=0, return_inverse=True)
        for k, size in enumerate(ways.tolist()):
            which = some[of_size.ravel() == k]
            which = which[np.argsort(np.ravel_multi_index(tuple(first[which].T), self.shape))]
            deep = max(PAIRS // (size[1] * size[2]), 1)
            together = max(PAIRS // (min(size[0], deep) * size[1] * size[2]), 1)
            for begin, x in itertools.product(range(0, len(which), together), range(0, size[0], deep)):
                chunk = which[begin : begin + together]
                yield chunk, first[chunk], (range(x, min(x + deep, size[0])), range(size[1]), range(size[2]))

    def add(self, which: np.ndarray, first: np.ndarray, offsets: tuple[range, ...]) -> None:
        """Add particles to the points of their boxes."""
        squares, places = [], []
        for axis, points in enumerate(self.shape):
            at = first[:, axis, None] + np.array(offsets[axis])
            away = (at - self.position[which, axis, None]) * (self.spacing[axis] / self.support[which, None])
            squares.append(np.where(at < points, away**2, BEYOND))
            places.append(np.minimum(at, points - 1))
        columns, rows, layers = (np.s_[:, :, None, None], np.s_[:, None, :, None], np.s_[:, None, None, :])
        distance = squares[0][columns] + squares[1][rows] + squares[2][layers]
        weight = self.kernel.of_square(distance, np) * self.strength[which, None, None, None]
        place = (places[0][columns] * self.shape[1] + places[1][rows]) * self.shape[2] + places[2][layers]
        start, end = int(place.min()), int(place.max()) + 1
        count = functools.partial(np.bincount, (place - start).ravel(), minlength=end - start)
        self.weight[start:end] += count(weight.ravel())
        self.weighted[start:end] += count((weight * self.quantity[which, None, None, None]).ravel())
