"""Marking: the worst leaves are found, and no more than were asked for."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from examples import examples
from hypothesis import given, strategies as st

from jaxsph.engine.screen.canvas import Leaves, leaves_of, of_lattice, places, wanted_by, worst

ALL = np.float32(1)
SIDES, STRIDE = (8, 4, 2), 4


def some_leaves(seed, hidden=0.0):
    rng, found = np.random.default_rng(seed), []
    for side, count in zip(SIDES, (5, 10, 20), strict=True):
        norm = rng.exponential(1.0, (count, count)).astype(np.float32)
        split = rng.random(norm.shape) < 0.7
        looks_empty = split & (rng.random(norm.shape) < hidden)
        arrays = np.where(looks_empty, 0, norm), norm, split, looks_empty
        found.append(Leaves(*arrays, side))
    return found


def worst_of(arrays, number, share):
    """So many of the worst leaves, without their sides, which are not traced."""
    return worst([Leaves(*some, side) for some, side in zip(arrays, SIDES, strict=True)], number, share)


so_many = jax.jit(worst_of)


def worst_some(leaves, number):
    return so_many([some[:-1] for some in leaves], np.int32(number), ALL)


@functools.partial(jax.jit, static_argnums=0)
def looked_at(shape, nodes, tolerance):
    """What leaves of two sides say, the pixels that splitting them asks for, and those that are known."""
    there = nodes.shape[:2]
    canvas = of_lattice(shape, nodes, jnp.zeros(there), jnp.ones(there), STRIDE)
    leaves, quality = leaves_of(canvas, (4, 2), tolerance)
    return [some.split for some in leaves], quality, wanted_by([some.split for some in leaves], canvas, (4, 2)), canvas.known


def flat(marked):
    return np.concatenate([np.asarray(some).ravel() for some in marked])


@examples(20)
@given(seed=st.integers(0, 10**6), number=st.integers(1, 600))
def test_the_worst_leaves_are_so_many_and_none_that_is_left_is_worse(seed, number):
    leaves = some_leaves(seed)
    marked, norm = flat(worst_some(leaves, number)), flat([some.norm for some in leaves])
    candidates = flat([some.split for some in leaves])
    assert not (marked & ~candidates).any()
    assert marked.sum() == min(number, candidates.sum())
    if marked.sum() < candidates.sum():
        assert norm[marked].min() >= norm[candidates & ~marked].max()


def holding(leaves):
    """By the number of leaves that `FEWEST` is now."""
    arrays, marked = [some[:-1] for some in leaves], jax.jit(functools.partial(worst_of, number=None))
    return lambda share: flat(marked(arrays, share=np.float32(share)))


def test_as_few_leaves_as_hold_a_share_of_the_squared_error(monkeypatch):
    monkeypatch.setattr("jaxsph.engine.screen.canvas.FEWEST", 1)
    leaves = some_leaves(3)
    marked_for, candidates = holding(leaves), flat([some.split for some in leaves])
    squares = flat([some.norm for some in leaves]) ** 2
    for share in (0.1, 0.5, 0.9):
        marked = marked_for(share)
        held, total = squares[marked].sum(), squares[candidates].sum()
        assert held >= share * total * (1 - 1e-5) and held - squares[marked].min() < share * total


def test_leaves_that_look_empty_compete_with_those_of_their_size():
    leaves = some_leaves(5, hidden=0.3)
    hidden, marked = flat([some.hidden for some in leaves]), flat(worst_some(leaves, 60))
    assert 0 < (hidden & marked).sum() < 60
    alone = [some._replace(split=some.hidden) for some in leaves]
    assert (flat(worst_some(alone, 1)) == flat([some.hidden for some in leaves])).all()  # nothing tells them apart


def nodes_of(image):
    height, width = image.shape
    value = np.zeros((height, width, 6), np.float32)
    value[..., 0], value[..., 3] = image, 0.5
    return value[np.ix_(*(places(size, STRIDE) for size in image.shape))]


def test_a_linear_image_is_good_at_once_and_a_corner_is_split_where_it_is():
    rows, columns = np.mgrid[:33, :41].astype(np.float32)
    linear, quality, *_ = looked_at(rows.shape, nodes_of(0.01 * rows + 0.005 * columns), np.float32(1e-3))
    assert not flat(linear).any() and float(quality.over) == 0 and float(quality.l2) < 1e-6
    corner = nodes_of((columns > 20).astype(np.float32))
    leaves, quality, wanted, known = jax.tree.map(np.asarray, looked_at(rows.shape, corner, np.float32(1e-3)))
    split = leaves[0]
    assert float(quality.over) == split.sum() > 0 and split.any(0).sum() <= 4 and split.any(0)[5]
    assert wanted.any() and not wanted[known].any() and wanted[:, 22].any()
