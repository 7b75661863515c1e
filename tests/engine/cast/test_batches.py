"""Batches: every filled slab is marched once, those of a chunk are about as full, and samples sit where the contract says."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY

from jaxsph.engine.access.grid import MAX_LEVEL
from jaxsph.engine.cast.batches import CastPlan, batches_of
from jaxsph.engine.field.gather import BLOCK
from jaxsph.engine.field.tasks import INTERPOLATED, NUM_METHODS, RayPackets, SlabSchedule

SLABS, BUNDLES, PLAN = 11, 13, CastPlan(chunk=8, slab_samples=4, batch_slabs=24)


def schedule_of(rng, level=None, span=None):
    filled = rng.uniform(size=(SLABS, BUNDLES)) < 0.6
    count = np.where(filled, rng.integers(1, 200, filled.shape), 0)
    level = np.zeros_like(count) if level is None else np.full_like(count, level)
    columns = filled, level, count[None] * 0, count[None], count
    span = None if span is None else np.broadcast_to(np.int32(span), filled.shape)
    paint = None if span is None else np.zeros((4, *filled.shape), np.float32)
    reference = np.zeros(filled.shape, np.float32)
    return SlabSchedule(*columns, (reference,), span, paint)


def batches(schedule, samples=SLABS * 4 - 1):
    grid = types.SimpleNamespace(half_steps=jnp.arange(2 * samples + 1, dtype=jnp.float32) / 2, samples=samples)
    u, v = jnp.arange(3.0 * BUNDLES).reshape(3, BUNDLES), -jnp.arange(2.0 * BUNDLES).reshape(2, BUNDLES)
    return batches_of(grid, schedule, RayPackets(u, v), PLAN, True)


@functools.partial(jax.jit, compiler_options=QUICKLY)
def nth_batch(schedule, nth):
    """How many batches there are; one of them; and items of as many chunks as it can have, and where they begin."""
    found = batches(schedule)
    batch = found.batch(nth)
    every = jnp.arange(found.num_slots // PLAN.chunk, dtype=jnp.int32)
    return found.number, vars(batch), jax.vmap(functools.partial(found.chunk, batch))(every)


@functools.partial(jax.jit, static_argnames="samples", compiler_options=QUICKLY)
def task_of(schedule, items, **how):
    """What is to be done for items, and the borders of their samples."""
    found = batches(schedule, **how)
    return found.task(items), found.depths(items, found.half_steps)[1]


def batches_with_chunks(schedule):
    """Every batch with the items of its chunks, without dummies."""
    nth, number = 0, 1
    while nth < number:
        number, batch, (items, begin) = jax.tree.map(np.asarray, nth_batch(schedule, np.int32(nth)))
        batch, used = types.SimpleNamespace(**batch), batch["chunks"]
        np.testing.assert_array_equal(begin[:used], PLAN.chunk * np.arange(used))
        chunks = [chunk[chunk < SLABS * BUNDLES] for chunk in items[:used]]
        assert all(chunk.size for chunk in chunks), "no chunk is marched for nothing"
        yield batch, chunks
        nth += 1


def test_chunks_hold_slabs_of_one_method():
    rng = np.random.default_rng(2)
    schedule = schedule_of(rng)
    method = rng.integers(0, NUM_METHODS, schedule.count.shape)
    level = np.maximum(method - INTERPOLATED, 0).astype(np.int32)
    count = np.where(method >= INTERPOLATED, 0, schedule.count)
    schedule = dataclasses.replace(schedule, count=count, level=level, method=method.astype(np.int32))
    seen = []
    for batch, chunks in batches_with_chunks(schedule):
        number = int(batch.number)
        np.testing.assert_array_equal(batch.marched[batch.slot[:number]], batch.items[:number])
        for items in chunks:
            assert len(set(method.ravel()[items])) == 1
            assert (np.diff(-(-np.asarray(count).ravel()[items] // BLOCK)) <= 0).all()
            seen += items.tolist()
    assert sorted(seen) == np.flatnonzero(np.asarray(schedule.filled)).tolist()


@pytest.mark.parametrize("level", range(MAX_LEVEL + 1))
def test_a_coarse_sample_sits_in_the_middle_of_its_window(level):
    task, borders = task_of(schedule_of(np.random.default_rng(1), level), np.arange(BUNDLES))
    windows = np.arange(PLAN.slab_samples + 1) * 2**level
    last = SLABS * 4 - 1
    np.testing.assert_array_equal(task.border[0], np.minimum(windows, last))
    np.testing.assert_array_equal(task.depth[0], np.minimum(windows[:-1] + 2**level / 2, last))
    np.testing.assert_array_equal(borders, task.border)


@pytest.mark.parametrize("span", [1, 4, SLABS])
def test_a_painted_entry_spans_its_slabs(span):
    task, borders = task_of(schedule_of(np.random.default_rng(2), span=span), np.arange(BUNDLES))
    np.testing.assert_array_equal(task.border[0], [0, *[min(4 * span, SLABS * 4 - 1)] * PLAN.slab_samples])
    np.testing.assert_array_equal(task.border, borders)


def test_painted_entries_come_last_in_own_chunks():
    rng = np.random.default_rng(4)
    schedule = schedule_of(rng, span=rng.integers(0, 3, (SLABS, BUNDLES)))
    span, entries = np.asarray(schedule.span).ravel(), []
    for batch, chunks in batches_with_chunks(schedule):
        number = int(batch.number)
        np.testing.assert_array_equal(batch.marched[batch.slot[:number]], batch.items[:number])
        for nth, items in enumerate(chunks):
            assert (span[items] > 0).all() if nth >= batch.unpainted else not span[items].any()
            entries += items.tolist()
    assert sorted(entries) == np.flatnonzero(np.asarray(schedule.filled)).tolist()


def test_what_lies_past_the_last_sample_has_no_length():
    last = (SLABS - 1) * BUNDLES + np.arange(BUNDLES)
    task, _ = task_of(schedule_of(np.random.default_rng(3)), last, samples=SLABS * 4 - 3)
    np.testing.assert_array_equal(np.diff(np.asarray(task.border), axis=1)[0], [1, 0, 0, 0])


def test_a_dummy_has_no_particles_and_no_length():
    task, _ = task_of(schedule_of(np.random.default_rng(3)), np.full(2, SLABS * BUNDLES))
    assert not np.asarray(task.entry.length).any() and not np.asarray(task.entry.count).any()
    assert not np.diff(np.asarray(task.border), axis=1).any()


@pytest.mark.parametrize("sizes", [{"chunk": 0}, {"slab_samples": 0}, {"batch_slabs": 0}, {"batch_slabs": 12}])
def test_sizes_that_do_not_fit_are_refused(sizes):
    with pytest.raises(ValueError, match="must be"):
        CastPlan(**({"chunk": 8, "slab_samples": 4, "batch_slabs": 24} | sizes))


@pytest.mark.parametrize(("shards", "slabs"), [(1, 24), (2, 8), (4, 8)])
def test_shards_hold_together_no_more_than_one_would_but_a_chunk_each(shards, slabs):
    assert PLAN.of_shard(shards) == dataclasses.replace(PLAN, batch_slabs=slabs)
