"""Nodes, leaves and what is interpolated between them, on images of any size; and how wrong that is estimated to be."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from hypothesis import given, strategies as st

from jaxsph.engine.screen.canvas import (
    allowed,
    lattices,
    leaf_errors,
    nodes_of_leaves,
    num_leaves,
    over_pixels,
    pixels_of_nodes,
    places,
)

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


SHAPE, SIDE = (65, 49), 8
ANY = np.sqrt(105 / 11), np.sqrt(15)


@functools.partial(jax.jit, static_argnames=("shape", "side"), compiler_options=QUICKLY)
def errors_of(coarser, corners, *, shape, side):
    return leaf_errors(coarser, corners, shape, side)


def estimated(image, side=SIDE):
    """Of the leaves of one side of an image of (channels, rows, columns)."""
    shape = image.shape[1:]
    lattices = (np.float32(image[:, places(shape[0], step)][:, :, places(shape[1], step)]) for step in (2 * side, side))
    return [np.asarray(found, np.float64) for found in errors_of(*lattices, shape=shape, side=side)]


def bilinear(image, side=SIDE):
    """What is drawn of leaves that are not split."""
    for axis in (1, 2):
        size = image.shape[axis]
        nodes = places(size, side)
        units = np.stack([np.interp(np.arange(size), nodes, unit) for unit in np.eye(len(nodes))])
        image = np.moveaxis(np.tensordot(image.take(nodes, axis), units, (axis, 0)), -1, axis)
    return image


def index_of(image):
    r"""Estimated over true error in the L2 norm, of all leaves: the effectivity index.

    To second order a field with second derivatives a down and b across (the mixed one is bilinear) is off by $a y (h - y) / 2 +
    b x (h - x) / 2$ on a leaf of side h, and what halving 2 h adds is a hat of height $a h^2 / 2$ plus one of $b h^2 / 2$. Of
    their squares' means, $(a^2 + b^2) h^4 / 120 + a b h^4 / 72$ and $(a^2 + b^2) h^4 / 12 + a b h^4 / 8$, the ratio is
    between 105 / 11 where a = b, 10 where one of them is 0, and 15 where a = -b.
    """
    off = (bilinear(image) - image)[:, :-1, :-1]
    return np.sqrt((estimated(image)[0] ** 2).sum() / (off**2).sum())


@pytest.mark.parametrize(("down", "across"), [(1, 1), (1, 0), (1, 0.3), (1, -0.5), (1, -1)])
def test_parabolas_are_estimated_as_theory_says(down, across):
    row, column = np.indices(SHAPE)
    index = index_of((1e-3 * (down * row**2 + across * column**2) + 2e-4 * row * column)[None])
    assert ANY[0] * 0.99 <= index <= ANY[1] * 1.01
    gain = SIDE**4 * (1 / 12 + down * across / (down**2 + across**2) / 8)
    off = (SIDE**4 - 1) / 120 + (SIDE**2 - 1) ** 2 * down * across / (down**2 + across**2) / 72  # summed over pixels
    assert index == pytest.approx(np.sqrt(gain / off), rel=1e-3)


@pytest.mark.parametrize(("k", "l"), [(0.05, 0.05), (0.1, 0.03), (0.1, 0.1), (0.15, 0.15)])
def test_no_pixel_of_a_wave_is_further_off_than_its_leaf_expects(k, l):  # noqa: E741
    row, column = np.indices(SHAPE)
    image = (np.sin(k * row + 0.3) * np.sin(l * column + 0.5))[None]
    off = np.abs(bilinear(image) - image)[0]
    largest = estimated(image)[1]
    for leaf in np.ndindex(largest.shape):
        inside = tuple(slice(SIDE * place, SIDE * place + SIDE + 1) for place in leaf)
        assert off[inside].max() <= largest[leaf]


def test_rays_and_leaves_share_a_tolerance():
    bound = np.zeros((9, 9))
    bound[8, 8] = 0.01
    assert np.allclose(allowed(np.float32(0.03), bound, 4), [[0.03, 0.03], [0.03, 0.02]])
