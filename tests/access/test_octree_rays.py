"""Along rays no sphere is missed and nothing comes twice; where there is no room, a walk is taken up again."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from derivatives import QUICKLY
from hypothesis import given
from octrees import built, few, in_both, members, seeds, spheres, styles

from jaxsph.access.octree_rays import leaves_along

RAYS, LEAVES = 64, 128


@functools.partial(jax.jit, static_argnames="max_leaves", compiler_options=QUICKLY)
def walked(tree, origin, direction, first, last, with_empty, max_leaves=LEAVES):
    return leaves_along(tree, list(origin), list(direction), first, last, max_leaves, with_empty=with_empty)


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


@in_both
@given(seed=seeds, style=styles)
@few
def test_no_sphere_that_a_ray_enters_is_missed_by_the_leaves_along_it(seed, style, dtype):
    rng = np.random.default_rng(seed)
    with jax.enable_x64(dtype == np.float64):
        centre, radius = spheres(seed, style, dtype)
        tree = built(jnp.asarray(centre), jnp.asarray(radius))
        origin, direction = rays(rng, centre, radius)
        last = rng.choice([0.7, 1e3], RAYS).astype(dtype)
        found = walked(tree, jnp.asarray(origin.T), jnp.asarray(direction.T), jnp.zeros(RAYS, dtype), jnp.asarray(last), False)
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


@in_both
@given(seed=seeds, style=styles)
@few
def test_intervals_are_in_order_and_cover_the_ray_inside_the_box(seed, style, dtype):
    rng = np.random.default_rng(seed)
    with jax.enable_x64(dtype == np.float64):
        centre, radius = spheres(seed, style, dtype)
        tree = built(jnp.asarray(centre), jnp.asarray(radius))
        origin, direction = (jnp.asarray(value.T) for value in rays(rng, centre, radius))
        ends = jnp.zeros(RAYS, dtype), jnp.full(RAYS, 1e3, dtype)
        full = walked(tree, origin, direction, *ends, True)
        some = walked(tree, origin, direction, *ends, False)
    entry, exit, number = (np.asarray(value) for value in (full.entry, full.exit, full.number))
    there = np.arange(LEAVES)[:, None] < number
    assert (exit >= entry)[there].all()  # rounding may leave nothing of one
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
    whole = walked(tree, origin, direction, first, last, False)
    taken = np.zeros(RAYS, int)
    for _ in range(200):
        part = walked(tree, origin, direction, first, last, False, max_leaves=4)
        taken += np.asarray(part.number)
        first = part.reached
        if np.asarray(part.ended).all():
            break
    assert np.asarray(part.ended).all()
    assert (taken >= np.asarray(whole.number)).all()  # a leaf in which it stopped may be met again, by rounding
