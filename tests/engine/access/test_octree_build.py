"""Nodes are split as long as that keeps spheres apart and there is memory, and what is no sphere is left out."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from octrees import SPHERES, built, members, spheres

from jaxsph.engine.access.octree import build_octree

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
