"""Slabs of any fullness are looped over whole, each block once and in order."""

import jax
import numpy as np
from examples import examples
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.engine.field.tasks import SlabSchedule, SlabTask

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


@examples(20)
@given(st.integers(0, 2**32 - 1), st.booleans())
def test_each_block_of_each_slab_is_met_once_and_in_order(seed, sorted_first):
    rng = np.random.default_rng(seed)
    length = [
        int(n) for n in np.where(rng.uniform(size=TASKS) < rng.uniform(), rng.integers(0, 40, TASKS), rng.integers(0, 3, TASKS))
    ]
    length = sorted(length, reverse=True) if sorted_first else length
    met = [[] for _ in range(TASKS)]
    for depth, number, begin, end in turned(task_of(length)):
        assert depth.shape[0] == number
        for block in range(int(begin), int(end)):
            for slab in range(int(number)):
                met[slab].append(block)
    for slab, blocks in enumerate(met):
        needed = -(-length[slab] // 4)
        assert blocks[:needed] == list(range(needed))
        assert blocks == sorted(set(blocks))


def test_one_full_slab_does_not_keep_the_others_waiting():
    length = [1000] + [1] * (TASKS - 1)
    looped = sum(int(number) * int(end - begin) for _, number, begin, end in turned(task_of(length)))
    assert looped == 250 * (TASKS // 4) + TASKS - TASKS // 4
    assert jax.tree.leaves(task_of(length).at(slice(3)))[0].shape == (3,)
    np.testing.assert_array_equal(task_of(length).at(slice(2)).entry.count, [1000, 1])
