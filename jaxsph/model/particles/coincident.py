"""Particles that share a place: one a place makes the same sums.

Flow: Particles -> [coincident] -> particles of pictures.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jaxsph.model.particles.particles import Particles
from jaxsph.numerics.rows import distinct, share_places
from jaxsph.numerics.trees import on_host


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
