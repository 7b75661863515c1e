"""Particles that share a place: how many places there are, and one particle a place that makes the same sums.

Flow: positions -> [coincident] -> trees of places, notes on files, particles of pictures.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxsph.model.particles.particles import Particles
from jaxsph.numerics.trees import on_host

MANY = 2  # particles a place, on average, from which on they are told of and drawn as one


def share_places(rows: Float[np.ndarray, "rows columns"]) -> bool:
    """Whether several rows are equal on average: by sums of their bits, which one sort counts."""
    bits = np.ascontiguousarray(np.asarray(rows, np.float64) + 0.0).view(np.uint64)  # there is no -0
    odd = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0x27D4EB2F165667C5], np.uint64)
    mixed = ((bits ^ (bits >> np.uint64(29))) * odd[: bits.shape[1]]).sum(1, dtype=np.uint64)
    return len(mixed) >= MANY * len(np.unique(mixed)) > 0


def distinct(rows: Float[np.ndarray, "rows columns"]) -> tuple[Int[np.ndarray, " places"], Int[np.ndarray, " rows"]]:
    """The index of one of each group of equal rows, and for every row the number of its group.

    A tree cannot part points that coincide, and would compare each with all others. Rows that all differ keep their order.
    """
    order = np.lexsort(rows.T)
    ordered = rows[order]
    is_first = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    if is_first.all():
        every = np.arange(len(rows))
        return every, every
    group = np.empty(len(rows), np.int64)
    group[order] = np.cumsum(is_first) - 1
    return order[is_first], group


@on_host
def one_a_place(particles: Particles) -> tuple[Particles, int]:
    """Particles of which those with one place and one support are one, where these are many, and how many there were.

    It has the sum of their volumes and the mean of their quantities by volume: all sums over particles are the same.
    """
    valid = np.flatnonzero(np.asarray(particles.valid))
    position, support = particles.exact_position()[valid], np.asarray(particles.support)[valid]
    rows = np.column_stack([position, support])
    if not share_places(rows):
        return particles, len(valid)
    first, group = distinct(rows)
    volume = np.asarray(particles.volume, np.float64)[valid]
    total = np.bincount(group, volume)
    each = [np.asarray(one, np.float64)[valid] for one in particles.quantities]
    weight = np.where(total[group] > 0, volume, 1)
    means = [np.bincount(group, weight * one) / np.bincount(group, weight) for one in each]
    dtype = particles.dtype
    carried: Any = tuple(mean.astype(dtype) for mean in means)
    carried = carried if len(means) > 1 else carried[0]
    place = position[first] if particles.position_rest is not None else position[first].astype(dtype)
    made = Particles.from_arrays(place, support[first], carried, total.astype(dtype), particles.kernel)
    return dataclasses.replace(made, box=particles.box, length_unit=particles.length_unit), len(valid)
