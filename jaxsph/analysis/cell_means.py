r"""Means of plain sums over the cells of a grid, whose sum times a cell is what particles have in the grid.

Flow: particles, grid -> [cell_means] -> resample.

A particle's kernel is summed at points that are even in each cell, and at least `FINE` along its support, whatever that is to a
cell; over all of them the weights of a particle add up to 1, so it has all of its amount, to rounding. One that is too small for
points is in the cell it lies in; of one that is much wider than cells the points are their middles.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from jaxsph.model.particles.field import EvenSamples, ParticleField
from jaxsph.model.particles.kernels import Kernel
from jaxsph.model.particles.particles import Box

FINE = 6.0  # points along a support, at least
WIDE = 16.0  # cells along a support, from which on points in the middles add up to 1 by themselves, to 1e-3
MOST_POINTS_OF_CELL = 2.0**20  # along an axis: what is smaller is in one of them
POINTS = 1 << 18  # looked at in one go


def cell_means(
    field: ParticleField,
    amounts: Float[np.ndarray, "channels particles"],
    box: Box | None,
    lower: np.ndarray,
    spacing: np.ndarray,
    shape: tuple[int, int, int],
) -> Float[np.ndarray, "channels x y z"]:
    r"""Mean of the plain sum $\sum_j a_j W_j(x)$ over each cell of a grid, for each channel of amounts $a$ (host side).

    Args:
        field: particles, without periodic copies.
        amounts: of each particle.
        box: the period, whose copies are made here; None for none.
        lower: (3,) the middle of the first cell, length units.
        spacing: (3,) sides of a cell, length units.
        shape: number of cells along each axis.
    """
    total = np.zeros((len(amounts), int(np.prod(shape))))
    low, high = lower - spacing / 2, lower + spacing * (np.array(shape) - 0.5)
    for turned in _turned(field.position, field.support, box, low, high):
        reaches = ((turned + field.support[:, None] > low) & (turned - field.support[:, None] < high)).all(1)
        is_wide = field.support >= WIDE * spacing.max()
        rows = np.flatnonzero(reaches & is_wide)
        x, y = (spacing[axis] * np.arange(shape[axis]) for axis in (0, 1))
        rays = EvenSamples(y, x, 0.0, spacing[2], shape[2], np.zeros(shape[:2]), False)
        strength = amounts[:, rows] * (field.kernel.norm / field.support[rows] ** 3)
        total += rays.sums((turned[rows] - lower)[:, [1, 0, 2]], field.support[rows], strength, field.kernel).reshape(total.shape)
        rows = np.flatnonzero(reaches & ~is_wide)
        rows = rows[np.argsort(field.support[rows], kind="stable")]  # those alike have as many points
        _deposit(total, turned[rows] - low, field.support[rows], amounts[:, rows] / spacing.prod(), field.kernel, spacing, shape)
    return total.reshape(-1, *shape)


def _turned(
    position: np.ndarray, support: np.ndarray, box: Box | None, low: np.ndarray, high: np.ndarray
) -> Iterator[np.ndarray]:
    """Positions of all particles; of a periodic set once for each shift by whole sides that may bring any of them to the grid."""
    if box is None or not len(position):
        yield position
        return
    corner, end = box.corners()
    sides = end - corner
    within = corner + (position - corner) % sides
    first = np.floor((low - end - support.max()) / sides).astype(int)
    last = np.ceil((high - corner + support.max()) / sides).astype(int)
    for turns in itertools.product(*map(range, first, last + 1)):
        yield within + sides * turns


def _deposit(
    total: np.ndarray,
    place: np.ndarray,
    support: np.ndarray,
    amounts: np.ndarray,
    kernel: Kernel,
    spacing: np.ndarray,
    shape: tuple[int, int, int],
) -> None:
    """Add each particle's amount to the cells that it covers, by its kernel at points; places are from the grid's corner"""
    per_cell = np.ceil(np.clip(FINE * spacing / support[:, None], 1, MOST_POINTS_OF_CELL))  # points along each axis
    apart = spacing / per_cell
    counts = np.ceil(2 * (support[:, None] / apart)).astype(int) + 1
    begin = 0
    while begin < len(support):
        some = slice(begin, begin + max(POINTS // int(counts[begin].prod()) // 2, 1))
        count, step, here, reach = counts[some].max(0), apart[some], place[some], support[some, None]
        first = np.floor((here - reach) / step)
        squares, cells, inside = [], [], []
        for axis in range(3):
            index = first[:, axis, None] + np.arange(count[axis])
            squares.append((((index + 0.5) * step[:, axis, None] - here[:, axis, None]) / reach) ** 2)
            cell = np.floor(index / per_cell[some, axis, None])
            inside.append((cell >= 0) & (cell < shape[axis]))
            cells.append(np.clip(cell, 0, shape[axis] - 1).astype(np.int64))
        weight = kernel.of_square(_outer(np.add, squares), np)
        whole = weight.sum((1, 2, 3))
        nearest = (np.floor(here / step) - first).astype(int).clip(0, count - 1)
        missed = np.flatnonzero(whole == 0)
        weight[(missed, *nearest[missed].T)] = whole[missed] = 1
        weight = weight / whole[:, None, None, None] * _outer(np.logical_and, inside)
        cell = (cells[0][:, :, None, None] * shape[1] + cells[1][:, None, :, None]) * shape[2] + cells[2][:, None, None, :]
        for channel, amount in zip(total, amounts[:, some], strict=True):
            np.add.at(channel, cell.ravel(), (weight * amount[:, None, None, None]).ravel())
        begin = some.stop


def _outer(verb: np.ufunc, columns: list[np.ndarray]) -> np.ndarray:
    x, y, z = columns
    return np.asarray(verb(verb(x[:, :, None, None], y[:, None, :, None]), z[:, None, None, :]))
