"""What is estimated of leaves is what it is said to be, and how far that is from the truth is known."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY

from jaxsph.engine.screen.canvas import allowed, leaf_errors, places

SHAPE, SIDE = (65, 49), 8
EVEN = np.sqrt(105 / 11), np.sqrt(10)  # of fields that bend to the same side down and across; see `index_of`
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


def test_the_norm_is_the_integral_of_a_bilinear_difference():
    """Where nothing was there before, the difference is what there is: its square is summed by brute force."""
    corners = np.random.default_rng(0).normal(size=(4, 3, 4)).astype(np.float32)
    norm = np.asarray(errors_of(np.zeros((4, 2, 3)), corners, shape=(17, 25), side=SIDE)[0])
    share = (np.arange(500) + 0.5) / 500
    y, x = np.meshgrid(share, share, indexing="ij")
    for row, column in np.ndindex(norm.shape):
        (a, b), (c, d) = np.moveaxis(corners[:, row : row + 2, column : column + 2].astype(np.float64), 0, -1)
        inside = [(1 - y) * ((1 - x) * a[k] + x * b[k]) + y * ((1 - x) * c[k] + x * d[k]) for k in range(4)]
        mean = sum((channel**2).mean() for channel in inside)
        assert norm[row, column] == pytest.approx(SIDE * np.sqrt(mean), rel=1e-5)


def test_what_is_linear_has_no_error_though_its_corners_vary():
    row, column = np.indices(SHAPE)
    linear = np.stack([0.1 + 0.01 * row + 0.005 * column, 0.9 - 0.002 * row, 0.004 * column, 0 * row + 0.5])
    norm, largest = estimated(linear)
    assert norm.max() <= SIDE * 8 * np.finfo(np.float32).eps and largest.max() <= 8 * np.finfo(np.float32).eps


def index_of(image):
    r"""Estimated over true error in the L2 norm, of all leaves: the effectivity index.

    To second order a field with second derivatives a down and b across (the mixed one is bilinear) is off by $a y (h - y) / 2 +
    b x (h - x) / 2$ on a leaf of side h, and what halving 2 h adds is a hat of height $a h^2 / 2$ plus one of $b h^2 / 2$. Of
    their squares' means, $(a^2 + b^2) h^4 / 120 + a b h^4 / 72$ and $(a^2 + b^2) h^4 / 12 + a b h^4 / 8$, the ratio is
    between 105 / 11 where a = b, 10 where one of them is 0, and 15 where a = -b.
    """
    off = (bilinear(image) - image)[:, :-1, :-1]
    return np.sqrt((estimated(image)[0] ** 2).sum() / (off**2).sum())


@pytest.mark.parametrize(("k", "l"), [(0.02, 0.05), (0.05, 0.05), (0.1, 0.03), (0.05, 0.1), (0.1, 0.1)])
def test_waves_are_estimated_within_what_theory_says(k, l):  # noqa: E741
    """And a little less where a leaf holds more of a wave, of up to 0.8 radians a side here: by a sixth of their squares."""
    row, column = np.indices(SHAPE)
    less = SIDE**2 * (k**2 + l**2) / 6
    for start in (0.0, 0.4, 1.2):
        index = index_of((np.sin(k * row + start) * np.sin(l * column + 0.5))[None])
        assert EVEN[0] * (1 - less) <= index <= EVEN[1]


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
