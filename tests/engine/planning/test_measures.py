"""Counts of pairs are exact, beyond what float32 can count, and sums that would wrap are known as such."""

import dataclasses

import jax
import numpy as np
import pytest
from hypothesis import given, strategies as st

import jaxsph as js
from jaxsph.engine.access.lists import BUNDLE, TILE, counted
from jaxsph.engine.access.view import Viewed
from jaxsph.engine.planning.viewing import measure


def seen(left, right, top, bottom) -> Viewed:
    """Particles of which only the pixels that they touch matter."""
    sides = {
        name: np.asarray(side, np.int32)
        for name, side in zip(("left", "right", "top", "bottom"), (left, right, top, bottom), strict=True)
    }
    rest = {field.name: np.ones(len(left)) for field in dataclasses.fields(Viewed)}
    return Viewed(**{**rest, **sides})


def camera(height: int) -> js.Camera:
    return js.Camera.look_at((0, 0, 0), (0, 0, 1), width=16, height=height, near=1.0, far=2.0)


sides = st.tuples(st.integers(0, 99), st.integers(0, 99)).map(sorted)


@given(st.lists(st.tuples(sides, sides), min_size=1, max_size=6), st.integers(100, 130))
def test_pairs_are_those_of_every_square_that_a_particle_touches(particles, height):
    viewed = seen(*np.reshape([(*columns, *rows) for columns, rows in particles], (-1, 4)).T)
    found = measure(viewed, camera(height), 16)
    tile_rows = -(-height // TILE)
    for size, counts in ((TILE, found.tile_pairs), (BUNDLE, found.bundle_pairs)):
        touched = np.zeros((len(particles), tile_rows * TILE // size, 130 // size + 1), bool)
        for nth, ((left, right), (top, bottom)) in enumerate(particles):
            touched[nth, top // size : bottom // size + 1, left // size : right // size + 1] = True
        assert counts.tolist() == touched.reshape(len(particles), tile_rows, -1).sum((0, 2)).tolist()


def test_pairs_beyond_float32_are_counted_to_the_last():
    """An odd number of them above 2^24, which float32 would round to an even one."""
    viewed = seen([0, 0, 8], [65535, 65535, 8], [0, 0, 8], [65535, 65535, 8])
    found = measure(viewed, camera(65536), 16)
    assert int(found.bundle_pairs.sum()) == 2 * 8192**2 + 1
    assert int(found.tile_pairs.sum()) == 2 * 4096**2 + 1


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_extents_are_counted_in_samples(projection):
    """A sphere from depth 1 to 2 of near 1 to far 4 holds half of the samples if they are geometric, a third if linear."""
    look = (0, 0, 0), (0, 0, 1)
    if projection == "perspective":
        view = js.Camera.look_at(*look, width=16, height=16, near=1.0, far=4.0)
    else:
        view = js.Camera.orthographic(*look, view_height=1.0, width=16, height=16, near=1.0, far=4.0)
    viewed = dataclasses.replace(seen([0], [9], [0], [9]), z=np.array([1.5]), reach=np.array([0.5]))
    assert measure(viewed, view, 64).depth_extent == pytest.approx(32 if projection == "perspective" else 64 / 3)
    assert measure(viewed, view, 64).diameter == 10


def test_nothing_seen_has_no_pairs_and_no_median():
    found = measure(seen([5], [4], [0], [9]), camera(33), 16)
    assert found.tile_pairs.tolist() == [0, 0, 0] and found.bundle_pairs.tolist() == [0, 0, 0]
    assert (found.rows, found.columns) == (1, 1) and np.isnan(found.diameter)


counted_of = jax.jit(lambda count: counted(count, count.sum()))


@pytest.mark.parametrize("over", [0, 1, 3])
def test_a_sum_of_pairs_is_compared_exactly(over):
    """float32(117440515) is 117440512: a plan with room for that many dropped three without a word."""
    capacity = 117_440_512
    count = np.full(8, capacity // 8, np.int32)
    count[3] += over
    assert int(counted_of(count)) == capacity + over


def test_a_sum_that_wraps_is_no_sum():
    assert int(counted_of(np.full(5, 1 << 30, np.int32))) == -1
