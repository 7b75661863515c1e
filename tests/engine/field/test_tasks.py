"""Packets read the lists of bundles, and samples are where rays and depths meet."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest
from derivatives import QUICKLY
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

from jaxsph.engine.field.tasks import Painting, RayPackets, SlabSchedule, SlabTask, painted_over

BUNDLES = 4
reading = jax.jit(RayPackets.reading)


@functools.partial(jax.jit, static_argnums=2)
def per_pixel(packets, per_ray, pixels):
    return packets.sum_per_pixel(packets.reading(per_ray), BUNDLES, pixels)


def packets(list_id, rows=2, columns=3):
    number = BUNDLES if list_id is None else len(list_id)
    u, v = np.zeros((columns, number), np.float32), np.zeros((rows, number), np.float32)
    return RayPackets(u, v, None if list_id is None else np.asarray(list_id))


@pytest.mark.parametrize("list_id", [None, [2, 2, 0]])
def test_packets_read_the_lists_that_they_name(list_id):
    of_bundles = np.arange(2.0 * BUNDLES).reshape(2, BUNDLES)
    wanted = of_bundles if list_id is None else of_bundles[:, list_id]
    np.testing.assert_array_equal(reading(packets(list_id), of_bundles), wanted)
    assert packets(list_id).shape == (2, 3) and packets(list_id).num_rays == 6


@pytest.mark.parametrize(("list_id", "each"), [(None, [1, 1, 1, 1]), ([2, 2, 0], [1, 0, 2, 0])])
def test_what_rays_take_is_shared_among_the_pixels_of_their_bundle(list_id, each):
    """Six rays a packet, eight pixels a bundle."""
    per_ray = np.array([1.0, 2.0, 4.0, 8.0])
    np.testing.assert_allclose(per_pixel(packets(list_id), per_ray, 8), np.array(each) * per_ray * 6 / 8)
    if list_id is None:
        np.testing.assert_array_equal(per_pixel(packets(None), per_ray, 6), per_ray)


TASKS = 256


def task_of(length):
    count = np.asarray(length, np.int32)
    of_both = np.zeros((2, TASKS), np.int32), np.stack([count // 3, count - count // 3])
    entry = SlabSchedule(count > 0, 0 * count, *of_both, count, (np.zeros(TASKS, np.float32),))
    nothing = np.zeros((TASKS, 1), np.float32)
    return SlabTask(entry, count, count, nothing, nothing, nothing, nothing, True)


@jax.jit
def turned(task):
    """Of each turn its slabs, of which there are so many, and its blocks: the first, and the one behind the last."""
    return [(some.depth, len(some.depth), begin, end) for some, begin, end in task.turns(4, (4,))]


def test_one_full_slab_does_not_keep_the_others_waiting():
    length = [1000] + [1] * (TASKS - 1)
    looped = sum(int(number) * int(end - begin) for _, number, begin, end in turned(task_of(length)))
    assert looped == 250 * (TASKS // 4) + TASKS - TASKS // 4
    assert jax.tree.leaves(task_of(length).at(slice(3)))[0].shape == (3,)
    np.testing.assert_array_equal(task_of(length).at(slice(2)).entry.count, [1000, 1])


SLABS, RAYS = 9, 5
painted = jax.jit(painted_over, compiler_options=QUICKLY)


@st.composite
def paintings(draw):
    """Windows of slabs, and paint of few kinds over some, which may end before the last slab."""
    count = draw(hnp.arrays(np.int32, (SLABS, RAYS), elements=st.sampled_from([0, 1, 7, 7, 7])))
    kind = draw(hnp.arrays(np.int32, (SLABS - 1, RAYS), elements=st.integers(-1, 2)))
    kinds = np.float32([[0, 0.5, 1], [0, 0.5, 0.25], [0, 0.5, 0.75], [2, 0.5, 0]])
    return count, Painting(kind >= 0, kinds[:, np.maximum(kind, 0)])


@given(paintings())
def test_runs_of_one_paint_are_one_entry(drawn):
    count, painting = drawn
    level = np.zeros_like(count)
    schedule = SlabSchedule(count > 0, level, level[None], count[None], count, (np.float32(count),))
    found = jax.tree.map(np.asarray, painted(schedule, painting))
    here = (count > 0) & np.pad(painting.here, ((0, 1), (0, 0)))
    np.testing.assert_array_equal(found.filled & (found.span == 0), (count > 0) & ~here)
    np.testing.assert_array_equal(found.count, np.where(here, 0, count))
    np.testing.assert_array_equal(found.length[0], np.where(here, 0, count))
    covered = np.zeros_like(count)
    for slab, ray in np.argwhere(found.span > 0):
        run = slice(slab, slab + found.span[slab, ray])
        covered[run, ray] += 1
        assert found.filled[slab, ray] and (found.paint[:, run, ray] == found.paint[:, slab, ray, None]).all()
        behind = run.stop
        if behind < SLABS and here[behind, ray]:
            assert (found.paint[:, behind, ray] != found.paint[:, slab, ray]).any(), "a run is as long as it can be"
    np.testing.assert_array_equal(covered, here)


@given(paintings(), hnp.arrays(np.float64, SLABS, elements=st.floats(0, 2)))
def test_a_run_is_what_its_slabs_are(drawn, lengths):
    count, painting = drawn
    level = np.zeros_like(count)
    schedule = SlabSchedule(count > 0, level, level[None], count[None], count, (np.float32(count),))
    found = jax.tree.map(np.asarray, painted(schedule, painting))
    here = (count > 0) & np.pad(painting.here, ((0, 1), (0, 0)))
    for ray in range(RAYS):
        apart, together = np.float64([0, 0, 0, 1]), np.float64([0, 0, 0, 1])
        for slab in range(SLABS):
            paint, span = np.float64(found.paint[:, slab, ray]), found.span[slab, ray]
            apart = through(apart, paint, lengths[slab] * here[slab, ray])
            together = through(together, paint, lengths[slab : slab + span].sum())
        np.testing.assert_allclose(together, apart, atol=1e-12)


def through(light, paint, length):
    """Colour and transmittance behind so much paint."""
    left = np.exp(-paint[3] * length)
    return np.append(light[:3] + light[3] * paint[:3] * (1 - left), light[3] * left)
