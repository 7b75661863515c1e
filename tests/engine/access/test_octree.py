"""Every point is in one leaf, which has all spheres that it is in; cells of none are told; nodes are split while that helps."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given
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


@functools.partial(jax.jit, compiler_options=QUICKLY)
def looked_up(tree, x, y, z):
    """The leaf of each position, and its coordinates in the unit cube."""
    coordinates = [(at - zero) * (1 / tree.side) for at, zero in zip((x, y, z), tree.lower, strict=True)]
    return tree.leaf_at(coordinates), coordinates


@jax.jit
def any_in(tree, low, high):
    return tree.occupancy.any_in(low, high)


@in_both
@given(seed=seeds, style=styles)
@few
def test_the_leaf_of_a_point_has_every_sphere_that_the_point_is_in(seed, style, dtype):
    with jax.enable_x64(dtype == np.float64):
        centre, radius = spheres(seed, style, dtype)
        tree = built(centre, radius)
        at = probes(np.random.default_rng(seed), centre, radius, tree)
        leaf, _ = looked_up(tree, *at.T)
        has = members(tree, leaf.begin, leaf.length)
    exact = at.astype(np.float64)[:, None] - centre.astype(np.float64)
    touched = (exact**2).sum(-1) <= radius.astype(np.float64) ** 2
    assert not (touched & ~has).any()
    assert touched.any()


@in_both
@given(seed=seeds)
@few
def test_a_sphere_that_only_touches_a_border_is_on_both_of_its_sides(seed, dtype):
    """Points right on borders of nodes, as far as can be told, and spheres whose surface they are on."""
    rng = np.random.default_rng(seed)
    ends = np.array([[-1, -1, -1], [1, 1, 1]]) + rng.choice([0, 3])
    with jax.enable_x64(dtype == np.float64):
        centre, radius = np.repeat(ends, SPHERES // 2, axis=0).astype(dtype), np.full(SPHERES, 0.01, dtype)
        empty = built(centre, radius)
        lower, side = np.asarray(empty.lower, np.float64), float(empty.side)
        axis = np.eye(3)[rng.integers(3, size=SPHERES)] > 0
        at = lower + side * np.where(axis, 0.25, rng.uniform(0.1, 0.2, (SPHERES, 3)))
        at = at.astype(dtype)
        reach = side * rng.uniform(0.005, 0.09, (SPHERES, 1)) * rng.choice([-1, 1], (SPHERES, 1))
        free = np.arange(1, SPHERES - 1)  # the first and the last keep the box as it is
        kept = ~np.isin(np.arange(SPHERES), free)
        moved = (at - np.where(axis, reach, 0)).astype(dtype)
        exact = np.linalg.norm(at.astype(np.float64) - moved.astype(np.float64), axis=1)
        centre = np.where(kept[:, None], np.repeat(ends, SPHERES // 2, axis=0), moved).astype(dtype)
        close = exact.astype(dtype)
        close = np.where(close.astype(np.float64) < exact, np.nextafter(close, dtype(np.inf)), close)
        tree = built(centre, np.where(kept, dtype(0.01), close))
        leaf, _ = looked_up(tree, *at.T)
        has = members(tree, leaf.begin, leaf.length)
    assert has[np.arange(SPHERES), np.arange(SPHERES)][free].all()


@given(seeds, styles)
@few
def test_cells_that_hold_any_of_a_sphere_are_occupied(seed, style):
    rng = np.random.default_rng(seed)
    centre, radius = spheres(seed, style, np.float32)
    tree = built(centre, radius)
    at = probes(rng, centre, radius, tree)
    coordinates = looked_up(tree, *at.T)[1]
    macrocells = [np.clip(np.asarray(place), 0, np.float32(1 - 1e-6)) * tree.occupancy_cells for place in coordinates]
    occupied = np.asarray(any_in(tree, macrocells, macrocells))
    away = at.astype(np.float64)[:, None] - centre.astype(np.float64)
    touched = ((away**2).sum(-1) <= radius.astype(np.float64) ** 2).any(1)
    assert occupied[touched].all() and touched.any()


def test_empty_space_is_told():
    """Between two clusters, a corner of the box each."""
    ends = np.repeat([[0.0, 0, 0], [1, 1, 1]], SPHERES // 2, axis=0).astype(np.float32)
    tree = built(ends, np.full(SPHERES, 0.05, np.float32))
    corners = ([np.float32(part * tree.occupancy_cells) for part in corner] for corner in ((0.6, 0.1, 0.4), (0.7, 0.2, 0.6)))
    assert not bool(any_in(tree, *corners))
    assert int(looked_up(tree, *np.full((3, 1), 0.5, np.float32))[0].length[0]) == 0


EVERY = np.ones(SPHERES, bool)
leaf_at = jax.jit(lambda tree, place: tree.leaf_at(list(place)))


def some():
    """Spheres that trees are made of."""
    return spheres(5, "uniform", np.float32)


def lengths(tree):
    """How many entries each leaf has; 0 of inner nodes and of padding."""
    return np.maximum(np.asarray(tree.node)[:, 1], 0)


def test_entries_are_padded_to_a_class_of_sizes_that_similar_sets_share():
    tree = build_octree(*some(), EVERY, most=2)
    number = lengths(tree).sum()
    assert number <= len(tree.entry) < 1.34 * number + 4
    similar = build_octree(*some(), EVERY & (np.arange(SPHERES) != 7), most=2)
    assert similar.entry.shape == tree.entry.shape


def test_where_memory_does_not_suffice_nodes_are_left_as_they_are():
    assert built(*some(), memory=24).levels < built(*some()).levels


def test_spheres_all_in_one_place_reach_the_maximal_level():
    centre, radius = np.full((SPHERES, 3), 0.3, np.float32), np.full(SPHERES, 1e-7, np.float32)
    centre[0] = 0
    tree = built(centre, radius, max_level=6)
    assert tree.levels == 6
    leaf = leaf_at(tree, (centre[1] - np.asarray(tree.lower)) / np.asarray(tree.side))
    assert members(tree, leaf.begin, leaf.length)[1:].all()


@pytest.mark.parametrize("count", [0, SPHERES])
def test_where_no_sphere_is_live_leaves_are_empty(count):
    tree = built(np.ones((count, 3), np.float32), np.ones(count, np.float32), np.zeros(count, bool))
    assert not lengths(tree).any() and not np.asarray(tree.occupancy.before).any()
    assert not int(leaf_at(tree, np.full(3, 0.5, np.float32)).length)


def test_spheres_that_are_no_spheres_are_left_out():
    centre = np.array([[0, 0, 0], [np.nan, 0, 0], [1, 1, 1], [np.inf, 0, 0], [2, 2, 2], [9, 9, 9]], np.float32)
    radius, live = np.array([0.1, 1, -1, 1, np.nan, 1], np.float32), np.array([1, 1, 1, 1, 1, 0], bool)
    tree = built(centre, radius, live)
    assert float(tree.side) < 0.21
    assert set(np.asarray(tree.entry)[: lengths(tree).sum()]) == {0}


def test_overlapping_supports_are_not_split_without_end():
    """Thirty deep everywhere: a leaf is no smaller than its spheres."""
    at = np.stack(np.meshgrid(*[np.arange(12)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    tree = build_octree(at, np.full(len(at), 2, np.float32), np.ones(len(at), bool))
    assert tree.levels <= 2 and len(tree.entry) < 25 * len(at)
