"""Every point is in one leaf, and that leaf has every sphere it is in; what is far from all spheres is told to be empty."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from derivatives import QUICKLY
from hypothesis import given
from octrees import PLAN, SPHERES, built, few, in_both, members, probes, seeds, spheres, styles

from jaxsph.engine.access.octree import INNER


@functools.partial(jax.jit, compiler_options=QUICKLY)
def looked_up(tree, x, y, z):
    return tree.leaf_at(x, y, z)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def may_meet(tree, lower, upper):
    return tree.may_meet(list(lower), list(upper))


@in_both
@given(seed=seeds, style=styles)
@few
def test_the_leaf_of_a_point_has_every_sphere_that_the_point_is_in(seed, style, dtype):
    with jax.enable_x64(dtype == np.float64):
        centre, radius = spheres(seed, style, dtype)
        tree = built(jnp.asarray(centre), jnp.asarray(radius))
        assert int(tree.fault) == 0
        at = probes(np.random.default_rng(seed), centre, radius, tree)
        leaf, _ = looked_up(tree, *jnp.asarray(at).T)
        has = members(tree, leaf.begin, leaf.length)
    exact = at.astype(np.float64)[:, None] - centre.astype(np.float64)
    touched = (exact**2).sum(-1) <= radius.astype(np.float64) ** 2
    assert np.asarray(leaf.inside)[touched.any(1)].all()
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
        empty = built(jnp.asarray(centre), jnp.asarray(radius))
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
        tree = built(jnp.asarray(centre), jnp.asarray(np.where(kept, dtype(0.01), close)))
        leaf, _ = looked_up(tree, *jnp.asarray(at).T)
        has = members(tree, leaf.begin, leaf.length)
    assert has[np.arange(SPHERES), np.arange(SPHERES)][free].all()


@in_both
@given(seed=seeds, style=styles)
@few
def test_leaves_tile_the_box_and_have_no_sphere_that_is_far_from_them(seed, style, dtype):
    with jax.enable_x64(dtype == np.float64):
        centre, radius = spheres(seed, style, dtype)
        tree = built(jnp.asarray(centre), jnp.asarray(radius))
        at = probes(np.random.default_rng(seed), centre, radius, tree)
        leaf, cells = looked_up(tree, *jnp.asarray(at).T)
        has = members(tree, leaf.begin, leaf.length)
        node = np.asarray(tree.node)
    volume, row, todo = 0.0, 0, [(row, PLAN.top) for row in range(1 << 3 * PLAN.top)]
    rows = set()
    while todo:
        row, level = todo.pop()
        assert row not in rows  # a tree: no node has two parents
        rows.add(row)
        if node[row, 1] == INNER:
            todo += [(node[row, 0] + k, level + 1) for k in range(8)]
        else:
            volume += 8.0**-level
            assert level <= int(tree.deepest)
    assert volume == 1
    assert sum(node[row, 1] != INNER for row in rows) == int(tree.num_leaves)
    assert sum(max(node[row, 1], 0) for row in rows) == int(tree.num_entries)
    side = 1 << (PLAN.deepest - np.asarray(leaf.level))
    low = np.stack([np.asarray(cell) & -side for cell in cells], -1) / 2**PLAN.deepest
    high = low + side[:, None] / 2**PLAN.deepest
    lower, length = np.asarray(tree.lower, np.float64), float(tree.side)
    scaled = (centre.astype(np.float64) - lower) / length
    off = np.maximum(np.maximum(low[:, None] - scaled, scaled - high[:, None]), 0)
    slack = 80 * np.finfo(dtype).eps * (1 + np.abs(lower).max() / length)
    assert not (has & (np.sqrt((off**2).sum(-1)) > radius / length * (1 + slack) + slack)).any()


@given(seeds, styles)
@few
def test_a_box_that_may_meet_nothing_meets_nothing(seed, style):
    rng = np.random.default_rng(seed)
    centre, radius = spheres(seed, style, np.float32)
    tree = built(jnp.asarray(centre), jnp.asarray(radius))
    at = probes(rng, centre, radius, tree)
    extent = (float(tree.side) * rng.choice([0, 0.01, 0.3], (len(at), 1)) * rng.uniform(size=(len(at), 3))).astype(np.float32)
    lower, upper = at - extent, at + extent
    may = np.asarray(may_meet(tree, lower.T, upper.T))
    a, b, c = (value.astype(np.float64) for value in (lower, upper, centre))
    off = np.maximum(np.maximum(a[:, None] - c, c - b[:, None]), 0)
    meets = ((off**2).sum(-1) <= radius.astype(np.float64) ** 2).any(1)
    assert not (meets & ~may).any()


def test_empty_space_is_told():
    """Between two clusters, a corner of the box each."""
    ends = np.repeat([[0.0, 0, 0], [1, 1, 1]], SPHERES // 2, axis=0).astype(np.float32)
    tree = built(jnp.asarray(ends), jnp.asarray(np.full(SPHERES, 0.05, np.float32)))
    box = jnp.asarray([[0.6], [0.1], [0.4]], jnp.float32), jnp.asarray([[0.7], [0.2], [0.6]], jnp.float32)
    assert not bool(may_meet(tree, *box)[0])
    assert int(looked_up(tree, *jnp.full((3, 1), 0.5))[0].length[0]) == 0
