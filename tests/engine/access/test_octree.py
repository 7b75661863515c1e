"""Every point is in one leaf, and that leaf has every sphere it is in; cells that no sphere meets are told to be empty."""

from __future__ import annotations

import functools

import jax
import numpy as np
from derivatives import QUICKLY
from hypothesis import given
from octrees import SPHERES, built, few, in_both, members, probes, seeds, spheres, styles

from jaxsph.engine.access.octree import INNER


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


@in_both
@given(seed=seeds, style=styles)
@few
def test_leaves_tile_the_box_and_have_no_sphere_that_is_far_from_them(seed, style, dtype):
    with jax.enable_x64(dtype == np.float64):
        centre, radius = spheres(seed, style, dtype)
        tree = built(centre, radius)
        node, dense = np.asarray(tree.node), 1 << tree.top
        lower, length = np.asarray(tree.lower, np.float64), float(tree.side)
    todo = [(row, tree.top, np.array(np.unravel_index(row, (dense,) * 3)) / dense) for row in range(dense**3)]
    rows, leaves = set(), []
    while todo:
        row, level, corner = todo.pop()
        assert row not in rows  # a tree: no node has two parents
        rows.add(row)
        if node[row, 1] == INNER:
            half = 0.5 ** (level + 1)
            todo += [(node[row, 0] + k, level + 1, corner + half * np.array([k >> 2, k >> 1 & 1, k & 1])) for k in range(8)]
        else:
            assert level <= tree.levels
            leaves.append((row, 0.5**level, corner))
    assert sum(side**3 for _, side, _ in leaves) == 1
    assert sum(node[row, 1] for row, *_ in leaves) == np.maximum(node[:, 1], 0).sum()
    has = members(tree, *node[[row for row, *_ in leaves]].T)
    low, side = np.array([corner for *_, corner in leaves]), np.array([[side] for _, side, _ in leaves])
    scaled = (centre.astype(np.float64) - lower) / length
    off = np.maximum(np.maximum(low[:, None] - scaled, scaled - (low + side)[:, None]), 0)
    slack = 80 * np.finfo(dtype).eps * (1 + np.abs(lower).max() / length)
    assert not (has & (np.sqrt((off**2).sum(-1)) > radius / length * (1 + slack) + slack)).any()


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
