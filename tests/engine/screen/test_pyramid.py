"""Nodes, leaves and what is interpolated between them, on images of any size."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.engine.screen.canvas import lattices, nodes_of_leaves, num_leaves, over_pixels, pixels_of_nodes, places

EPS = np.finfo(np.float32).eps
SIZES = st.integers(1, 70)
STRIDES = st.sampled_from([1, 2, 4, 8, 16])
IMAGES = [(1, 9, 4), (2, 3, 4), (18, 21, 8), (5, 33, 16)]  # rows, columns, coarsest
images = st.sampled_from(IMAGES)
seeds = st.integers(0, 2**32 - 1)


@functools.partial(jax.jit, static_argnames="coarsest", compiler_options=QUICKLY)
def every_lattice(value, known, *, coarsest):
    return lattices(value, known, 1, coarsest)


@functools.partial(jax.jit, static_argnames=("shape", "stride"), compiler_options=QUICKLY)
def split(leaf, *, shape, stride):
    """Nodes that are needed, their pixels, and the pixels of the leaves."""
    nodes = nodes_of_leaves(leaf, shape, stride)
    return nodes, pixels_of_nodes(nodes, shape, stride), over_pixels(leaf, shape, 2 * stride)


def strides(coarsest):
    return [coarsest >> nth for nth in range(coarsest.bit_length())]


def some_known(rng, shape, coarsest):
    """The nodes of the coarsest lattice, and any others."""
    known = rng.uniform(size=shape) < rng.choice([0, 0.1, 0.9])
    known[np.ix_(*(places(size, coarsest) for size in shape))] = True
    return known


@given(SIZES, STRIDES)
def test_nodes_lie_on_every_so_many_pixels_and_on_the_last(size, stride):
    found = places(size, stride)
    assert found.tolist() == sorted({*range(0, size, stride), size - 1})
    assert num_leaves(size, stride) == max(len(found) - 1, 1)


@given(images, seeds)
def test_what_is_linear_in_pixels_is_found_on_every_lattice(image, seed):
    """Whatever is known beside the coarsest nodes, and though the last nodes are nearer to each other."""
    *shape, coarsest = image
    rng = np.random.default_rng(seed)
    row, column = np.indices(shape)
    offset, down, across = rng.uniform(-1, 1, (3, 2, 1, 1))
    linear = (offset + down * row + across * column).astype(np.float32)
    known = some_known(rng, shape, coarsest)
    found = every_lattice(np.where(known, linear, np.nan), known, coarsest=coarsest)
    assert len(found) == len(strides(coarsest))
    for stride, lattice in zip(strides(coarsest), found, strict=True):
        expected = linear[:, places(shape[0], stride)][:, :, places(shape[1], stride)]
        np.testing.assert_allclose(lattice, expected, rtol=0, atol=8 * len(found) * EPS * np.abs(linear).max())


@given(images, seeds)
def test_an_image_is_the_sum_of_what_each_lattice_adds_bilinear_over_pixels(image, seed):
    """So it is continuous wherever nodes hang on the sides of larger leaves; and what is known stays as it is."""
    *shape, coarsest = image
    rng = np.random.default_rng(seed)
    known = some_known(rng, shape, coarsest)
    value = rng.uniform(-1, 1, (2, *shape)).astype(np.float32)
    found = np.asarray(every_lattice(np.where(known, value, np.nan), known, coarsest=coarsest)[-1])
    np.testing.assert_array_equal(found[:, known], value[:, known])
    total = np.zeros((2, *shape))
    for stride in strides(coarsest):
        rows, columns = (places(size, stride) for size in shape)
        here = np.ix_((0, 1), rows, columns)
        new = np.where(known[here[1:]], value[here] - total[here], 0)
        down = np.stack([np.interp(np.arange(shape[0]), rows, unit) for unit in np.eye(len(rows))])
        across = np.stack([np.interp(np.arange(shape[1]), columns, unit) for unit in np.eye(len(columns))])
        total += np.einsum("kij,ir,jc->krc", new, down, across)
    np.testing.assert_allclose(found, total, rtol=0, atol=16 * len(strides(coarsest)) * EPS)


@pytest.mark.parametrize(("rows", "columns", "stride"), [(1, 9, 2), (6, 13, 2), (18, 21, 4), (9, 5, 1)])
def test_splitting_a_leaf_needs_the_nodes_on_its_sides_and_in_its_middle(rows, columns, stride):
    """Those are the nodes that lie in it or on its border; and each leaf's pixels are those up to the next leaf."""
    shape, side = (rows, columns), 2 * stride
    rng = np.random.default_rng(0)
    counts = [num_leaves(size, side) for size in shape]
    first = [np.arange(count) * side for count in counts]
    last = [np.minimum(begin + side, size - 1) for begin, size in zip(first, shape, strict=True)]
    held = [
        (begin[:, None] <= places(size, stride)) & (places(size, stride) <= end[:, None])
        for begin, end, size in zip(first, last, shape, strict=True)
    ]
    for _ in range(10):
        leaf = rng.uniform(size=counts) < 0.3
        nodes, pixels, spread = map(np.asarray, split(leaf, shape=shape, stride=stride))
        np.testing.assert_array_equal(nodes, np.einsum("ij,ir,jc->rc", leaf, *(inside.astype(int) for inside in held)) > 0)
        assert pixels.sum() == nodes.sum() and pixels[np.ix_(*(places(size, stride) for size in shape))].sum() == nodes.sum()
        row, column = (np.minimum(np.arange(size) // side, count - 1) for size, count in zip(shape, counts, strict=True))
        np.testing.assert_array_equal(spread, leaf[np.ix_(row, column)])
