"""A plan counts what an octree takes, one that is too small says so, and what is no sphere is left out.

All sets have one number of entries, and plans are of few sizes, such that most steps are compiled once.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from octrees import PLAN, SPHERES, built, spheres

from jaxsph.engine.access.octree_build import LevelSizes, OctreePlan, build_octree, plan_octree
from jaxsph.numerics import faults

EVERY = jnp.ones(SPHERES, bool)
FEW = {"most": 2, "max_level": 3}


def some():
    """Spheres that plans are made for."""
    return (*map(jnp.asarray, spheres(5, "uniform", np.float32)), EVERY)


@pytest.fixture(scope="module")
def plan():
    return plan_octree(*some(), **FEW)


@pytest.fixture(scope="module")
def tree(plan):
    return built(*some(), plan=plan)


def test_a_plan_counts_what_is_built(plan, tree):
    assert int(tree.deepest) == plan.deepest == 3 and int(tree.fault) == 0
    assert int(tree.num_entries) <= plan.entries < 1.34 * int(tree.num_entries) + 4


@pytest.mark.slow
def test_a_tree_is_the_same_whoever_compiles_it(plan, tree):
    """`built` is compiled without optimization, for tests."""
    np.testing.assert_array_equal(build_octree(*some(), plan=plan).entry, tree.entry)


@pytest.mark.parametrize(
    "small",
    ["children", *(pytest.param(name, marks=pytest.mark.slow) for name in ("entries", "candidates", "pairs", "blocks"))],
)
def test_a_plan_that_is_too_small_raises_its_fault(small, plan):
    sizes = {name: getattr(plan, name) for name in ("candidates", "pairs", "entries")}
    levels = list(plan.levels)
    if small in sizes:
        sizes[small] //= 2
    else:
        levels[0] = LevelSizes(1, levels[0].pairs) if small == "blocks" else LevelSizes(levels[0].blocks, levels[0].pairs // 2)
    less = dataclasses.replace(plan, levels=tuple(levels), **sizes)
    tree = built(*some(), plan=less)
    assert int(tree.fault) == faults.OCTREE_OVERFLOW
    assert "plan_octree" in faults.describe(int(tree.fault))
    begin, length = np.asarray(tree.node).T
    assert (begin + np.maximum(length, 0) <= max(len(tree.entry), len(begin))).all()


def test_where_memory_does_not_suffice_levels_are_left_out_and_the_plan_says_so(plan):
    less = plan_octree(*some(), **FEW, memory=1 << 12)
    assert less.lowered and not plan.lowered and less.deepest < plan.deepest
    assert int(built(*some(), plan=less).fault) == 0


def test_spheres_all_in_one_place_reach_the_maximal_level_and_say_so():
    centre, radius = np.full((SPHERES, 3), 0.3, np.float32), np.full(SPHERES, 1e-7, np.float32)
    centre[0] = 0
    tree = built(jnp.asarray(centre), jnp.asarray(radius))
    assert int(tree.deepest) == PLAN.deepest and int(tree.crowded) >= 1 and int(tree.fault) == 0
    leaf, _ = tree.leaf_at(*jnp.asarray(centre[1]))
    begin = int(leaf.begin)
    assert set(np.asarray(tree.entry)[begin : begin + int(leaf.length)]) >= set(range(1, SPHERES))


@pytest.mark.slow
def test_where_all_are_in_one_place_planning_ends_at_the_maximal_level():
    centre = np.full((SPHERES, 3), 0.3, np.float32)
    centre[0] = 0
    plan = plan_octree(centre, np.full(SPHERES, 1e-7, np.float32), max_level=4)
    assert plan.deepest == 4 and not plan.lowered


def test_where_no_sphere_is_live_leaves_are_empty(plan):
    tree = built(*some()[:2], ~EVERY, plan=plan)
    assert int(tree.num_entries) == int(tree.fault) == 0 and not np.asarray(tree.occupancy.before).any()


@pytest.mark.slow
@pytest.mark.parametrize("count", [0, SPHERES])
def test_an_empty_set_has_empty_leaves(count):
    centre, radius, live = jnp.ones((count, 3)), jnp.ones(count), jnp.zeros(count, bool)
    plan = plan_octree(centre, radius, live)
    tree = built(centre, radius, live, plan=plan)
    assert int(tree.num_entries) == int(tree.fault) == 0
    assert not bool(tree.may_meet([jnp.float32(-5)] * 3, [jnp.float32(5)] * 3))


def test_spheres_that_are_no_spheres_are_left_out(plan):
    centre = np.array([[0, 0, 0], [np.nan, 0, 0], [1, 1, 1], [np.inf, 0, 0], [2, 2, 2], [9, 9, 9]], np.float32)
    radius, live = np.array([0.1, 1, -1, 1, np.nan, 1], np.float32), np.array([1, 1, 1, 1, 1, 0], bool)
    more = SPHERES - len(radius)
    centre, radius, live = np.pad(centre, ((0, more), (0, 0))), np.pad(radius, (0, more)), np.pad(live, (0, more))
    tree = built(*map(jnp.asarray, (centre, radius, live)), plan=plan)
    assert float(tree.side) < 0.21
    assert set(np.asarray(tree.entry)[: int(tree.num_entries)]) == {0}


@pytest.mark.slow
def test_overlapping_supports_are_not_split_without_end():
    """Thirty deep everywhere: a leaf is no smaller than its spheres."""
    at = np.stack(np.meshgrid(*[np.arange(12)] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    plan = plan_octree(at, np.full(len(at), 2, np.float32))
    assert plan.deepest <= 2 and plan.entries < 25 * len(at)


@pytest.mark.parametrize(
    ("changed", "match"),
    [({"most": 0}, "`most`"), ({"ratio": 0.0}, "`ratio`"), ({"top": 21}, "levels"), ({"entries": 0}, "`entries`")],
)
def test_a_plan_names_what_it_refuses(changed, match):
    with pytest.raises(ValueError, match=match):
        OctreePlan(**{"top": 1, "candidates": 1, "pairs": 1, "levels": (), "entries": 1} | changed)


def test_a_maximal_level_that_cannot_be_is_refused():
    with pytest.raises(ValueError, match="`max_level`"):
        plan_octree(np.zeros((1, 3), np.float32), np.ones(1, np.float32), max_level=25)
