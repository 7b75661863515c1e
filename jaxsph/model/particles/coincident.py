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
    """Merge particles of equal place and support where many share places; return how many there were before, too.

    A merged particle has the sum of their volumes and the mean of their quantities by volume, so that no sum over particles
    changes.
    """
    position, support = particles.places(), particles.unpadded(particles.support)
    rows = np.column_stack([position, support])
    if not share_places(rows):
        return particles, len(rows)
    first, group = distinct(rows)
    volume, dtype = particles.unpadded(particles.volume), particles.dtype
    total = np.bincount(group, volume)
    weight = np.where(total[group] > 0, volume, 1)
    sums = (np.bincount(group, weight * particles.unpadded(one)) for one in particles.quantities)
    means: Any = tuple((one / np.bincount(group, weight)).astype(dtype) for one in sums)
    place = position[first] if particles.position_rest is not None else position[first].astype(dtype)
    quantity = means if len(means) > 1 else means[0]
    made = Particles.from_arrays(place, support[first].astype(dtype), quantity, total.astype(dtype), particles.kernel)
    return dataclasses.replace(made, box=particles.box, length_unit=particles.length_unit), len(rows)
