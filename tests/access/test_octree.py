"""Every point is in one leaf, and that leaf has every sphere it is in; along rays, none is missed and nothing comes twice."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsph.access.octree import INNER
from jaxsph.access.octree_build import LevelSizes, OctreePlan, build_octree, plan_octree
from jaxsph.access.octree_rays import leaves_along
from jaxsph.numerics import faults

SPHERES, RAYS, LEAVES = 40, 64, 256
PLAN = OctreePlan(2, 4096, 4096, tuple(LevelSizes(256, 6144) for _ in range(3)), 16384, most=2)
STYLES = "uniform", "clump", "borders", "sizes", "points", "giant"
seeds, styles, dtypes = st.integers(0, 2**32 - 1), st.sampled_from(STYLES), st.sampled_from([np.float32, np.float64])
few = settings(max_examples=20)


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


@functools.partial(jax.jit, static_argnames="plan")
def built(centre, radius, live=None, plan=PLAN):
    return build_octree(centre, radius, live, plan=plan)


@jax.jit
def looked_up(tree, x, y, z):
    return tree.leaf_at(x, y, z)


@functools.partial(jax.jit, static_argnames=("max_leaves", "with_empty"))
def walked(tree, origin, direction, first, last, max_leaves=LEAVES, with_empty=False):
    return leaves_along(tree, list(origin), list(direction), first, last, max_leaves, with_empty=with_empty)


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


@given(seeds, styles, dtypes)
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


@given(seeds, dtypes)
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


@given(seeds, styles, dtypes)
@few
def test_leaves_tile_the_box_and_have_no_sphere_that_is_far_from_them(seed, style, dtype):
    with jax.enable_x64(dtype == np.float64):
        centre, radius = spheres(seed, style, dtype)
        tree = built(jnp.asarray(centre), jnp.asarray(radius))
        at = probes(np.random.default_rng(seed), centre, radius, tree)
        leaf, cells = looked_up(tree, *jnp.asarray(at).T)
        has = members(tree, leaf.begin, leaf.length)
        node = np.asarray(tree.node)
    volume, row, todo = 0.0, 0, [(row, PLAN.top) for row in range(64)]
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


def rays(rng, centre, radius):
    """From around and from inside of the set, some along axes and some on borders, towards spheres and their edges."""
    middle, size = centre.mean(0, dtype=np.float64), np.ptp(centre, axis=0).max() + radius.max()
    origin = middle + size * rng.uniform(-1, 1, (RAYS, 3)) * rng.choice([0.3, 1.5], (RAYS, 1))
    way = rng.normal(size=(RAYS, 3))
    target = rng.integers(len(radius), size=RAYS)
    beside = way / np.linalg.norm(way, axis=1)[:, None] * (radius[target] * rng.choice([0, 0.7, 0.99], RAYS))[:, None]
    direction = centre[target] + beside - origin
    axis = np.eye(3)[rng.integers(3, size=RAYS)] * rng.choice([-1, 1], (RAYS, 1))
    along_axis = rng.uniform(size=(RAYS, 1)) < 0.3
    direction = np.where(along_axis, axis, direction)
    origin = np.where(along_axis, centre[target] - size * axis, origin)
    scale = rng.choice([0.2, 1, 30], (RAYS, 1))
    return origin.astype(centre.dtype), (direction * scale).astype(centre.dtype)


@given(seeds, styles, dtypes)
@few
def test_no_sphere_that_a_ray_enters_is_missed_by_the_leaves_along_it(seed, style, dtype):
    rng = np.random.default_rng(seed)
    with jax.enable_x64(dtype == np.float64):
        centre, radius = spheres(seed, style, dtype)
        tree = built(jnp.asarray(centre), jnp.asarray(radius))
        origin, direction = rays(rng, centre, radius)
        last = rng.choice([0.7, 1e3], RAYS).astype(dtype)
        found = walked(tree, jnp.asarray(origin.T), jnp.asarray(direction.T), jnp.zeros(RAYS, dtype), jnp.asarray(last))
        assert np.asarray(found.ended).all()
        has = members(tree, found.begin, found.length)
    start, way = origin.astype(np.float64), direction.astype(np.float64)
    off, square = start[:, None] - centre, (way**2).sum(1)[:, None]
    nearest = -(off * way[:, None]).sum(-1) / square
    miss = np.linalg.norm(off + nearest[..., None] * way[:, None], axis=-1)
    rounding = 16 * np.finfo(dtype).eps * (np.abs(start).max() + np.abs(centre).max() + float(tree.side))  # of a position
    half = np.sqrt(np.maximum(radius.astype(np.float64) ** 2 - miss**2, 0) / square)
    for share in (-0.98, -0.5, 0.0, 0.6, 0.98):
        at = nearest + share * half
        enters = (miss < radius - rounding) & (at > 0) & (at < last[:, None])
        entry, exit = (np.asarray(value, np.float64)[:, :, None] for value in (found.entry, found.exit))
        margin = rounding / np.sqrt(square)
        in_leaf = (entry - margin <= at) & (at <= exit + margin) & has
        assert not (enters & ~in_leaf.any(0)).any()


@given(seeds, styles, dtypes)
@few
def test_intervals_are_in_order_and_cover_the_ray_inside_the_box(seed, style, dtype):
    rng = np.random.default_rng(seed)
    with jax.enable_x64(dtype == np.float64):
        centre, radius = spheres(seed, style, dtype)
        tree = built(jnp.asarray(centre), jnp.asarray(radius))
        origin, direction = (jnp.asarray(value.T) for value in rays(rng, centre, radius))
        ends = jnp.zeros(RAYS, dtype), jnp.full(RAYS, 1e3, dtype)
        full = walked(tree, origin, direction, *ends, with_empty=True)
        some = walked(tree, origin, direction, *ends)
    entry, exit, number = (np.asarray(value) for value in (full.entry, full.exit, full.number))
    there = np.arange(LEAVES)[:, None] < number
    assert (exit > entry)[there].all()
    assert (entry[1:] == exit[:-1])[there[1:]].all()
    lower, side = np.asarray(tree.lower, np.float64)[:, None], float(tree.side)
    start, way = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.sort([(lower - start) / way, (lower + side - start) / way], axis=0)
    beside = ((way == 0) & ((start < lower) | (start > lower + side))).any(0)
    near = np.maximum(np.where(way == 0, -np.inf, sides[0]).max(0), 0)
    far = np.where(beside, -np.inf, np.where(way == 0, np.inf, sides[1]).min(0))
    allowed = 32 * np.finfo(dtype).eps * (np.abs(start).max() + side + np.abs(lower).max()) / np.linalg.norm(way, axis=0)
    met, room = number > 0, far - near > 2 * allowed
    assert met[room].all()
    rows = np.flatnonzero(met & room)
    assert (np.abs(entry[0] - near)[rows] <= allowed[rows]).all()
    assert (np.abs(exit[number[rows] - 1, rows] - far[rows]) <= allowed[rows]).all()
    for ray in range(RAYS):
        kept = there[:, ray] & (np.asarray(full.length)[:, ray] > 0)
        np.testing.assert_array_equal(np.asarray(some.entry)[: int(some.number[ray]), ray], entry[kept, ray])


def test_where_there_is_no_room_for_all_leaves_a_walk_can_be_taken_up_again():
    centre, radius = spheres(3, "uniform", np.float32)
    tree = built(jnp.asarray(centre), jnp.asarray(radius))
    origin, direction = (jnp.asarray(value.T) for value in rays(np.random.default_rng(4), centre, radius))
    first, last = jnp.zeros(RAYS), jnp.full(RAYS, 1e3)
    whole = walked(tree, origin, direction, first, last)
    taken = np.zeros(RAYS, int)
    for _ in range(200):
        part = walked(tree, origin, direction, first, last, max_leaves=4)
        taken += np.asarray(part.number)
        first = part.reached
        if np.asarray(part.ended).all():
            break
    assert np.asarray(part.ended).all()
    assert (taken >= np.asarray(whole.number)).all()  # a leaf in which it stopped may be met again, by rounding


@given(seeds, styles)
@few
def test_a_box_that_may_meet_nothing_meets_nothing(seed, style):
    rng = np.random.default_rng(seed)
    centre, radius = spheres(seed, style, np.float32)
    tree = built(jnp.asarray(centre), jnp.asarray(radius))
    at = probes(rng, centre, radius, tree)
    extent = (float(tree.side) * rng.choice([0, 0.01, 0.3], (len(at), 1)) * rng.uniform(size=(len(at), 3))).astype(np.float32)
    lower, upper = at - extent, at + extent
    may = np.asarray(jax.jit(lambda tree, a, b: tree.may_meet(list(a), list(b)))(tree, lower.T, upper.T))
    a, b, c = (value.astype(np.float64) for value in (lower, upper, centre))
    off = np.maximum(np.maximum(a[:, None] - c, c - b[:, None]), 0)
    meets = ((off**2).sum(-1) <= radius.astype(np.float64) ** 2).any(1)
    assert not (meets & ~may).any()


def test_empty_space_is_told():
    centre = np.array([[0.0, 0, 0], [1, 1, 1]], np.float32)
    tree = build_octree(
        jnp.asarray(centre), jnp.full(2, 0.05), plan=plan_octree(centre, np.full(2, 0.05, np.float32), max_level=6)
    )
    plan = OctreePlan(3, 1024, 1024, (), 1024)
    tree = build_octree(jnp.asarray(centre), jnp.full(2, 0.05), plan=plan)
    box = [jnp.float32(value) for value in (0.6, 0.1, 0.4)], [jnp.float32(value) for value in (0.7, 0.2, 0.6)]
    assert not bool(tree.may_meet(*box))
    assert int(tree.leaf_at(jnp.float32(0.5), jnp.float32(0.5), jnp.float32(0.5))[0].length) == 0


def test_spheres_all_in_one_place_reach_the_maximal_level_and_say_so():
    centre, radius = np.full((30, 3), 0.3, np.float32), np.full(30, 1e-7, np.float32)
    centre[0] = 0
    plan = plan_octree(centre, radius, max_level=4)
    assert plan.deepest == 4 and not plan.lowered
    tree = build_octree(jnp.asarray(centre), jnp.asarray(radius), plan=plan)
    assert int(tree.deepest) == 4 and int(tree.crowded) >= 1 and int(tree.fault) == 0
    leaf, _ = tree.leaf_at(*jnp.asarray(centre[1]))
    begin = int(leaf.begin)
    assert set(np.asarray(tree.entry)[begin : begin + int(leaf.length)]) >= set(range(1, 30))


def test_an_empty_set_has_empty_leaves():
    for count, live in ((0, None), (1, jnp.zeros(1, bool))):
        centre, radius = jnp.ones((count, 3)), jnp.ones(count)
        plan = plan_octree(centre, radius, live)
        tree = build_octree(centre, radius, live, plan=plan)
        assert int(tree.num_entries) == int(tree.fault) == 0
        found = leaves_along(tree, [jnp.zeros(4)] * 3, [jnp.ones(4)] * 3, jnp.zeros(4), jnp.full(4, jnp.inf), 3)
        assert not np.asarray(found.number).any() and np.asarray(found.ended).all()
        assert not bool(tree.may_meet([jnp.float32(-5)] * 3, [jnp.float32(5)] * 3))


def test_spheres_that_are_no_spheres_are_left_out():
    centre = np.array([[0, 0, 0], [np.nan, 0, 0], [1, 1, 1], [np.inf, 0, 0], [2, 2, 2], [9, 9, 9]], np.float32)
    radius, live = np.array([0.1, 1, -1, 1, np.nan, 1], np.float32), np.array([1, 1, 1, 1, 1, 0], bool)
    plan = plan_octree(centre, radius, live)
    tree = build_octree(jnp.asarray(centre), jnp.asarray(radius), jnp.asarray(live), plan=plan)
    assert float(tree.side) < 0.21
    assert set(np.asarray(tree.entry)[: int(tree.num_entries)]) == {0}


@pytest.mark.parametrize(
    "small", ["children", "entries", *(pytest.param(name, marks=pytest.mark.slow) for name in ("candidates", "pairs", "blocks"))]
)
def test_a_plan_that_is_too_small_raises_its_fault(small):
    centre, radius = spheres(5, "uniform", np.float32)
    plan = plan_octree(centre, radius, most=2, max_level=3)
    sizes = {name: getattr(plan, name) for name in ("candidates", "pairs", "entries")}
    levels = list(plan.levels)
    if small in sizes:
        sizes[small] //= 2
    else:
        levels[0] = LevelSizes(1, levels[0].pairs) if small == "blocks" else LevelSizes(levels[0].blocks, levels[0].pairs // 2)
    less = OctreePlan(plan.top, levels=tuple(levels), most=2, **sizes)
    assert int(build_octree(jnp.asarray(centre), jnp.asarray(radius), plan=plan).fault) == 0
    tree = build_octree(jnp.asarray(centre), jnp.asarray(radius), plan=less)
    assert int(tree.fault) == faults.OCTREE_OVERFLOW
    assert "plan_octree" in faults.describe(int(tree.fault))
    begin, length = np.asarray(tree.node).T
    assert (begin + np.maximum(length, 0) <= max(len(tree.entry), len(begin))).all()


def test_a_plan_counts_what_is_built():
    centre, radius = spheres(6, "sizes", np.float32)
    plan = plan_octree(centre, radius, most=2, max_level=4)
    tree = build_octree(jnp.asarray(centre), jnp.asarray(radius), plan=plan)
    assert int(tree.deepest) == plan.deepest and int(tree.fault) == 0
    assert int(tree.num_entries) <= plan.entries < 1.34 * int(tree.num_entries) + 4


def test_where_memory_does_not_suffice_levels_are_left_out_and_the_plan_says_so():
    centre, radius = spheres(7, "sizes", np.float32)
    full, less = (plan_octree(centre, radius, most=2, max_level=4, memory=memory) for memory in (1 << 30, 1 << 12))
    assert less.lowered and not full.lowered and less.deepest < full.deepest
    assert int(build_octree(jnp.asarray(centre), jnp.asarray(radius), plan=less).fault) == 0


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
