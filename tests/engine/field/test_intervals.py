"""Of a ray along which supports cover some pieces, intervals have the shares and the ends that those pieces say."""

from __future__ import annotations

import functools
import itertools

import jax
import numpy as np
from derivatives import QUICKLY
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.engine.field.cover import Cover
from jaxsph.engine.field.intervals import Intervals, intervals_of, means_of
from jaxsph.engine.lookups.means import MeanTables
from jaxsph.model.transfer.function import TransferFunction

SAMPLES = 5
DEPTH = 2.0 + 0.3 * np.arange(SAMPLES)
LINE = 0.7, -0.4  # a quantity that is linear along the ray: value at depth 0, and change a unit of depth
intervals = jax.jit(intervals_of)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def means(looks, made):
    return means_of(MeanTables.of(looks.segments()), made, slice(0, 4))


def field(depth):
    return LINE[0] + LINE[1] * np.asarray(depth)


def found(pieces, pivot):
    """Intervals of a ray that is inside of supports in one piece in front of a pivot, and one behind it; None is none."""
    inside = np.zeros(SAMPLES, bool)
    for piece in pieces:
        inside |= (piece[0] < DEPTH) & (piece[1] > DEPTH) if piece else False
    far = np.finfo(np.float32).max
    ends = np.array([piece or (far, -far) for piece in pieces])
    of_ends = np.where(np.abs(ends) < far, field(ends), 0)
    cover = Cover(*(np.float32(part)[:, None, None] for part in (*ends.T, *of_ends.T)), np.full((1, 1), pivot, np.float32))
    quantity = np.float32(np.where(inside, field(DEPTH), 0))[None, :, None]
    made = intervals(quantity, inside[None, :, None], cover, np.float32(DEPTH)[None])
    return [np.asarray(part)[0, :, 0] for part in made]


def check(pieces, pivot):
    """That where intervals are inside, the quantity is that of the line, and shares are those of the pieces."""
    near, far, share = found(pieces, pivot)
    for k, (first, last) in enumerate(itertools.pairwise(DEPTH)):
        parts = [(max(piece[0], first), min(piece[1], last)) for piece in pieces if piece]
        parts = [part for part in parts if part[0] < part[1]]
        assert len(parts) < 2
        wanted = (parts[0][1] - parts[0][0]) / (last - first) if parts else 0
        np.testing.assert_allclose(share[k], wanted, atol=1e-5)
        if wanted > 1e-5:
            np.testing.assert_allclose([near[k], far[k]], field(parts[0]), atol=1e-5)


AWAY = 0.01  # of an interval, from samples
inner = st.tuples(st.integers(-1, SAMPLES - 1), st.floats(AWAY, 1 - AWAY)).map(lambda place: DEPTH[0] + 0.3 * sum(place))


@given(st.tuples(inner, inner).map(sorted))
def test_one_piece_is_found_wherever_it_begins_and_ends(ends):
    """Within an interval, over samples, or out of the slab on either side."""
    begin, end = ends
    outer = DEPTH[(begin > DEPTH) | (end < DEPTH)]
    behind = outer[outer > end]
    inside_any = ((begin < DEPTH) & (end > DEPTH)).any()
    pivot = np.inf if not outer.size else behind[0] if inside_any and behind.size else outer[-1]
    pieces = [None, None]
    if begin < end:
        pieces[0 if end < pivot else 1] = (begin, end)
    check(pieces, pivot)


@given(st.integers(1, SAMPLES - 2), st.data())
def test_two_pieces_on_either_side_of_an_outer_sample_are_told_apart(k, data):
    share = st.floats(AWAY, 1 - AWAY)
    end = DEPTH[k] - 0.3 * data.draw(share)
    begin = DEPTH[k] + 0.3 * data.draw(share)
    check(
        [
            (end - data.draw(st.sampled_from([0.1, 0.45, 3.0])), end),
            (begin, begin + data.draw(st.sampled_from([0.1, 0.45, 3.0]))),
        ],
        DEPTH[k],
    )


def test_what_is_inside_at_both_ends_is_so_all_along():
    near, far, share = found([(0.0, 9.0), None], np.inf)
    np.testing.assert_allclose([near, far], [field(DEPTH[:-1]), field(DEPTH[1:])], rtol=1e-6)
    assert (share == 1).all()


def test_borders_that_the_cover_does_not_tell_count_half_of_an_interval():
    """Two gaps that end in one slab: the second is no border of a piece."""
    inside = np.array([True, False, True, False, True])[None, :, None]
    front, back = np.float32([[1.0], [2.5]]), np.float32([[2.1], [4.0]])
    cover = Cover(*(part[..., None] for part in (front, back, 0 * front, 0 * back)), np.full((1, 1), DEPTH[1], np.float32))
    share = np.asarray(intervals(np.ones((1, SAMPLES, 1), np.float32), inside, cover, np.float32(DEPTH)[None]).share)[0, :, 0]
    np.testing.assert_allclose(share, [(2.1 - 2.0) / 0.3, (2.6 - 2.5) / 0.3, 0.5, 0.5], atol=1e-5)


def test_means_are_of_the_part_that_is_inside():
    looks = TransferFunction.from_points([0.0, 1.0], [[0, 0, 1.0], [1, 0, 0]], [0.0, 2.0])
    near, far, share = (np.float32(part)[None, :, None] for part in ([0.0, 0.5], [1.0, 0.5], [0.25, 0.0]))
    made = Intervals(near, far, share)
    red, green, blue, extinction = (np.asarray(mean)[0, :, 0] for mean in means(looks, made))
    np.testing.assert_allclose([red, green, blue, extinction], [[0.25 * 2 / 3, 0], [0, 0], [0.25 / 3, 0], [0.25, 0]], atol=1e-6)
