"""Fewer particles for a draft: of a large set, some at random stand for all.

Flow: Particles -> [fewer] -> stages.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from jaxsph.model.particles.particles import Particles
from jaxsph.numerics.checks import product
from jaxsph.numerics.extremes import lesser

MOST = 40_000
"""Particles of a draft, such that what is done once a particle takes a fraction of a tenth of a second on two cores."""


def fewer(particles: Particles) -> Particles:
    """At most `MOST` of the particles, or the very set.

    Each of them stands for several: its volume is theirs, and its support as much longer as distances are now, so that sums over
    kernels stay what they were on average. In a periodic set no support becomes longer than the longest.
    """
    entries = np.flatnonzero(np.asarray(particles.valid))
    if len(entries) <= MOST:
        return particles
    ratio = len(entries) / MOST
    kept = particles.at(np.sort(np.random.default_rng(0).permutation(entries)[:MOST]))
    support = product(kept.support, ratio ** (1 / 3))
    if particles.box is not None:
        support = lesser(particles.support.max(), support)
    return dataclasses.replace(kept, support=support, volume=product(kept.volume, np.asarray(ratio, kept.volume.dtype)))
