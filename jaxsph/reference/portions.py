"""Rays cut into portions: nothing begins or ends inside of a portion, and a list says which chords lie over it.

Flow: rays, chords -> [portions] -> media -> light_integral.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxsph.reference.chords import Chords, Rays, ranges

LONGEST = 0.25  # of a support: see `borders`
FEW = 4  # chords, see `borders`


class Portions(NamedTuple):
    """Parts of rays, in order of rays and, within a ray, of depth.

    Attributes:
        ray: number of its ray.
        start, end: depths.
        root: number of the portion of the first cut that it is a part of: what parts of a scene have there is told of those.
    """

    ray: Int[np.ndarray, " portions"]
    start: Float[np.ndarray, " portions"]
    end: Float[np.ndarray, " portions"]
    root: Int[np.ndarray, " portions"]

    def some(self, which: np.ndarray) -> Portions:
        """Those of the given numbers, or a mask."""
        return Portions(*(column[which] for column in self))


Cuts = tuple[np.ndarray, np.ndarray]
"""Numbers of rays, and depths on them."""


def borders(chords: Chords, radius: Float[np.ndarray, " chords"]) -> Cuts:
    """Entries and exits that rays are cut at from the start.

    All where less than `FEW` chords are on one side: there the medium begins or ends, or a mean of few may change quickly. At the
    others only a higher derivative jumps, and rays are cut where the error demands it. Of these the first in each of the bins
    that are `LONGEST` of a support long (of the power of two below it): so no longer chord is overlooked between nodes.
    """
    ray, depth = np.tile(chords.ray, 2), np.concatenate([chords.entry, chords.exit])
    step = np.repeat([1, -1], len(chords.ray))
    order = np.lexsort((-step, depth, ray))
    ray, depth, step = ray[order], depth[order], step[order]
    covering = np.cumsum(step)
    octave = np.frexp(np.tile(radius, 2)[order])[1]
    place = np.floor(depth / np.ldexp(LONGEST, octave - 1))
    first = np.zeros(len(ray), bool)
    within = np.lexsort((depth, octave, ray))
    keys = ray[within], octave[within], place[within]
    first[within[1:]] = np.logical_or.reduce([key[1:] != key[:-1] for key in keys])
    first[within[:1]] = True
    kept = first | (np.minimum(covering, covering - step) < FEW)
    return ray[kept], depth[kept]


def cut(rays: Rays, cuts: list[Cuts]) -> Portions:
    """What lies between neighbouring cuts of a ray, between near and far."""
    count = len(rays.u)
    ends = np.repeat([rays.near, rays.far], count)
    ray = np.concatenate([np.tile(np.arange(count), 2), *(ray for ray, _ in cuts)])
    depth = np.clip(np.concatenate([ends, *(depth for _, depth in cuts)]), rays.near, rays.far)
    order = np.lexsort((depth, ray))
    ray, depth = ray[order], depth[order]
    held = (ray[1:] == ray[:-1]) & (depth[1:] > depth[:-1])
    start, end = depth[:-1][held], depth[1:][held]
    return Portions(ray[:-1][held], start, end, np.arange(len(start)))


def lists(rays: Rays, portions: Portions, chords: Chords) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which chords lie over which portions: `chord[first[i] : first[i] + length[i]]` of the arrays over portion i."""
    width = 2 * (rays.far - rays.near)

    def key(ray: np.ndarray, depth: np.ndarray) -> np.ndarray:
        return ray * width + np.clip(depth, rays.near, rays.far) - rays.near

    last = len(portions.ray) - 1
    first = np.searchsorted(key(portions.ray, portions.end), key(chords.ray, chords.entry)) - 1  # keys are rounded: one more
    beyond = np.searchsorted(key(portions.ray, portions.start), key(chords.ray, chords.exit)) + 1
    first, beyond = np.clip(first, 0, last), np.clip(beyond, 0, last + 1)
    chord, portion = ranges(first, np.maximum(beyond - first, 0))
    over = (portions.ray[portion] == chords.ray[chord]) & (chords.entry[chord] < portions.end[portion])
    over &= chords.exit[chord] > portions.start[portion]
    chord, portion = chord[over], portion[over]
    count = np.bincount(portion, minlength=len(portions.ray))
    small = portion.astype(np.uint16) if len(count) <= 1 << 16 else portion  # which sorts faster
    return np.cumsum(count) - count, count, chord[np.argsort(small, kind="stable")]
