"""Octrees that tests look into: spheres that are hard to keep apart, in trees of few shapes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from examples import examples
from hypothesis import strategies as st

from jaxsph.engine.access.octree import build_octree

SPHERES, NODES, ENTRIES = 40, 4096, 16384
STYLES = "uniform", "clump", "borders", "sizes", "points", "giant"
seeds, styles = st.integers(0, 2**32 - 1), st.sampled_from(STYLES)
in_both = pytest.mark.parametrize("dtype", [np.float32, pytest.param(np.float64, marks=pytest.mark.slow)])
few = examples(20)


def spheres(seed, style, dtype):
    """Sets that are hard to keep apart: clumps, borders of nodes, radii of 1 : 20000, of zero, and of more than all."""
    rng = np.random.default_rng(seed)
    centre, radius = rng.uniform(-1, 1, (SPHERES, 3)), 10 ** rng.uniform(-3, -0.7, SPHERES)
    if style == "clump":
        centre = np.where(rng.uniform(size=(SPHERES, 1)) < 0.7, 0.3 + 1e-5 * centre, centre)
    if style == "borders":
        centre, radius = np.round(centre * 8) / 8, np.full(SPHERES, 0.125)
    if style == "sizes":
        radius = 10 ** rng.uniform(-4.6, -0.3, SPHERES)
    if style == "points":
        radius = radius * 0
    if style == "giant":
        radius[0] = 40
    offset = rng.choice([0.0, 3.0, 100.0])
    return (centre + offset).astype(dtype), radius.astype(dtype)


def built(centre, radius, live=None, **how):
    """A deep tree of few spheres, with room for any, such that looking it up is compiled a few times."""
    live = np.ones(len(radius), bool) if live is None else live
    tree = build_octree(centre, radius, live, **({"most": 2, "max_level": 4} | how))
    node = np.pad(np.asarray(tree.node), ((0, NODES - len(tree.node)), (0, 0)))
    return dataclasses.replace(tree, node=node, entry=np.pad(np.asarray(tree.entry), (0, ENTRIES - len(tree.entry))))


def members(tree, begin, length):
    """Which spheres leaves have, (leaves, SPHERES)."""
    entry, begin, length = (np.asarray(value) for value in (tree.entry, begin, length))
    found = np.zeros((begin.size, SPHERES), bool)
    for k, (at, number) in enumerate(zip(begin.ravel(), length.ravel(), strict=True)):
        listed = entry[at : at + number]
        assert len(set(listed)) == number  # none twice
        found[k, listed] = True
    return found.reshape(*begin.shape, SPHERES)


def probes(rng, centre, radius, tree, count=400):
    """Positions anywhere, inside of spheres and right at their surface, and on borders of nodes."""
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    which = rng.integers(len(radius), size=count)
    near = centre[which] + way * (radius[which] * rng.choice([0, 0.5, 1], count))[:, None]
    lower, side = np.asarray(tree.lower, np.float64), float(tree.side)
    anywhere = lower + side * rng.uniform(0, 1, (count, 3))
    borders = lower + side * rng.integers(0, 33, (count, 3)) / 32
    return np.concatenate([near, anywhere, np.clip(borders, lower, lower + 0.999 * side)]).astype(centre.dtype)
