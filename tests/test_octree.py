"""The octree of benchmarks: leaves tile the box, no sphere is missed, capacities are kept; and pictures are those of lists."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given, strategies as st
from images import error_of, seen_from
from tools import tool

import jaxsph as js
from jaxsph.numerics.faults import CapacityError

octree = tool("benchmarks", "octree")
object_space = tool("benchmarks", "object_space")
SPHERES, RAYS, ROOM = 40, 64, (4096, 16384)
STYLES = "uniform", "clump", "borders", "sizes", "points", "giant"
seeds, styles = st.integers(0, 2**32 - 1), st.sampled_from(STYLES)


def spheres(seed, style):
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
    return (centre + rng.choice([0.0, 3.0, 100.0])).astype(np.float32), radius.astype(np.float32)


def built(centre, radius, **how):
    """A deep tree of few spheres, with room for any, such that programs are shared."""
    tree = octree.build(centre, radius, **({"most": 2, "max_level": 5, "room": ROOM} | how))
    return octree.Octree(tree.lower, tree.side, tree.node, tree.entry, tree.before, tree.top, tree.levels)


def leaves_of(tree):
    """Leaves by number of their node, depth, and entries; and corners in cells of the finest level."""
    node, entry, found = np.asarray(tree.node), np.asarray(tree.entry), []
    cells = range(1 << tree.top)
    below = [(((x << tree.top) + y << tree.top) + z, tree.top, np.array([x, y, z])) for x in cells for y in cells for z in cells]
    while below:
        row, depth, corner = below.pop()
        begin, length = node[row]
        if length == octree.INNER:
            below += [(begin + k, depth + 1, 2 * corner + half) for k, half in enumerate(octree.HALVES)]
        else:
            found.append((depth, corner << (tree.levels - depth), entry[begin : begin + length]))
    return found


@pytest.mark.parametrize("style", STYLES)
def test_leaves_tile_the_box_and_list_what_meets_them(style):
    """Each cell of the finest level is in one leaf, found from the cell; entries are the spheres that the leaf's cube meets."""
    centre, radius = spheres(1, style)
    tree = built(centre, radius)
    taken = np.zeros((1 << tree.levels,) * 3, int)
    place = (centre.astype(np.float64) - np.asarray(tree.lower, np.float64)) / float(tree.side)
    reach = radius.astype(np.float64) / float(tree.side)
    leaves = leaves_of(tree)
    corners, sides = np.array([corner for _, corner, _ in leaves]), np.array([1 << (tree.levels - leaf[0]) for leaf in leaves])
    leaf = jax.tree.map(np.asarray, tree.leaf_of(list((corners + sides[:, None] // 2).T)))
    assert (leaf.side == sides).all()
    for (depth, corner, entries), side, length in zip(leaves, sides, leaf.length, strict=True):
        taken[tuple(slice(low, low + side) for low in corner)] += 1
        assert length == len(entries) == len(set(entries))
        low, high = corner / (1 << tree.levels), (corner + side) / (1 << tree.levels)
        away = np.linalg.norm(place - np.clip(place, low, high), axis=1)
        assert set(np.flatnonzero(away <= reach)) <= set(entries) <= set(np.flatnonzero(away <= reach + 1e-4))
        fits = radius[entries] <= float(tree.side) * 0.5**depth * 0.999
        assert fits.sum() <= 2 or depth == 5
    assert (taken == 1).all()


def test_eight_at_most_are_in_leaves_where_spheres_can_be_kept_apart():
    rng = np.random.default_rng(2)
    place = rng.choice([-1, 1], (4000, 3)) + rng.normal(0, 0.05, (4000, 3))
    tree = octree.build(place.astype(np.float32), np.full(4000, 0.0004, np.float32))
    lengths = np.asarray(tree.node)[:, 1]
    assert 4 < lengths.max() <= octree.MOST and tree.levels < octree.MAX_LEVELS
    listed = np.concatenate([entries for *_, entries in leaves_of(tree)])
    assert set(listed) == set(range(4000)) and len(listed) == len(np.asarray(tree.entry))


def rays_at(rng, centre, radius):
    """Rays anywhere, through centres, along axes, and beside spheres; in float64."""
    which = rng.integers(SPHERES, size=RAYS)
    way = rng.normal(size=(RAYS, 3))
    way[::4] = np.eye(3)[rng.integers(3, size=len(way[::4]))]
    way /= np.linalg.norm(way, axis=1)[:, None]
    aside = np.cross(way, rng.normal(size=(RAYS, 3)))
    aside /= np.linalg.norm(aside, axis=1)[:, None]
    through = centre[which] + aside * (radius[which] * rng.choice([0, 0.5, 0.999], RAYS))[:, None]
    size = np.ptp(centre, axis=0).max() + 2 * radius.max()
    return through - size * way, way, size * rng.choice([0.5, 1.0, 4.0], RAYS)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def walked(tree, start, way, end):
    """How often each sphere was listed along rays, what leaves cover of them, and whether each leaf has its own middle."""
    rays = octree.Rays(list(start), list(way), jnp.zeros_like(end), end).in_box()

    def visit(found, leaf, enters, leaves, last):
        met, length, right = found
        middle = tree.leaf_of(tree.cells_at(rays.at(0.5 * enters + 0.5 * leaves)))
        clear = (leaves - enters) > 1e-5  # of what rounding may have in the leaf beside
        right &= ~clear | ~(enters < rays.end) | (middle.length == 0) | (middle.begin == leaf.begin)

        def add(nth, met):
            there = nth < leaf.length
            sphere = tree.entry[jnp.where(there, leaf.begin + nth, 0)]
            return met.at[jnp.arange(RAYS), sphere].add(there)

        met = jax.lax.fori_loop(0, leaf.length.max(), add, met)
        return met, length + jnp.where(enters < rays.end, leaves - enters, 0), right

    zero = jnp.zeros((RAYS, SPHERES), jnp.int32), jnp.zeros(RAYS), jnp.ones(RAYS, bool)
    met, length, right = tree.along(rays, visit, zero)
    return met, length, right, rays.end - rays.begin


@given(seed=seeds, style=styles)
@examples(20)
def test_no_sphere_that_a_ray_enters_is_missed(seed, style):
    centre, radius = spheres(seed, style)
    tree = built(centre, radius)
    start, way, end = rays_at(np.random.default_rng(seed), centre.astype(np.float64), radius.astype(np.float64))
    lower, side = np.asarray(tree.lower, np.float64), float(tree.side)
    given = [column.astype(np.float32) for column in ((start - lower).T / side, way.T, end / side)]
    met, length, right, whole = map(np.asarray, walked(tree, *given))
    start, way, end = (column.astype(np.float64) for column in given)
    place, reach = (centre - lower) / side, radius / side  # of the very rays that were given
    foot = np.clip(((place[:, None] - start.T) * way.T).sum(-1), 0, end)
    away = np.linalg.norm(start.T + foot[..., None] * way.T - place[:, None], axis=-1)
    assert not ((away < reach[:, None]).T & (met == 0)).any()
    np.testing.assert_allclose(length, np.maximum(whole, 0), atol=1e-4)
    assert right.all()


def test_a_capacity_that_overflows_is_refused():
    centre, radius = spheres(3, "uniform")
    taken = tuple(map(len, (octree.build(centre, radius).node, octree.build(centre, radius).entry)))
    assert octree.build(centre, radius, room=taken).entry.shape == (taken[1],)
    for room, what in (((taken[0] - 1, taken[1]), "nodes"), ((taken[0], taken[1] - 1), "entries")):
        with pytest.raises(CapacityError, match=f"`room` is for .* {what}, and these spheres take"):
            octree.build(centre, radius, room=room)


PROJECTIONS = "perspective", pytest.param("orthographic", marks=pytest.mark.slow)


def parts(kind):
    rng = np.random.default_rng(4)
    place, size = rng.uniform(-0.8, 0.8, (60, 3)), 10 ** rng.uniform(-1.5, -0.3, 60)
    if kind == "particles":
        look = js.TransferFunction.from_points([0, 0.4, 1], [[1, 0, 0], [0, 1, 0.2], [0.1, 0, 1]], [0.2, 2.0, 1.0])
        return {"particles": js.Particles.from_arrays(place, size + 0.2, rng.uniform(0, 1, 60)), "transfer": look}
    color, extinction = rng.uniform(0, 1, (60, 3)), rng.uniform(0.3, 2, 60) / size
    return {"points": js.Points.from_arrays(place, size, color, extinction, spread=kind)}


@pytest.mark.parametrize("projection", PROJECTIONS)
@pytest.mark.parametrize("kind", ["particles", "chords", "feet"])
def test_pictures_are_those_of_view_aligned_lists(kind, projection, quick_programs):
    scene, settings = js.Scene(**parts(kind)), js.Settings(samples=24, integrator="samples")
    camera = seen_from((0.6, 0.5, -3.0), projection, 42.0, 2.2, width=20, height=16, near=1.5, far=5.0)
    image = js.render(scene, camera, settings)
    other = js.render(object_space.in_object_space(scene, most=2, max_level=6), camera, settings)
    assert np.asarray(image.alpha).max() > 0.2
    assert error_of(other, image).max() <= 16 * np.finfo(np.float32).eps


def test_points_that_are_no_spheres_on_rays_are_refused():
    with pytest.raises(ValueError, match="`points` that are splats"):
        object_space.in_object_space(js.Scene(**parts("centres")))
