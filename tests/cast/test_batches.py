"""Batches: every filled slab is marched once, those of a chunk are about as full, and samples sit where the contract says."""

import dataclasses
import types

import jax.numpy as jnp
import numpy as np
import pytest

from jaxsph.cast.batches import BLOCK, KINDS, CastPlan, kind_of, batches_of
from jaxsph.field.schedule import MAX_LEVEL, SlabSchedule

SLABS, BUNDLES, PLAN = 11, 13, CastPlan(chunk=8, slab_samples=4, held=24)


def work_of(rng, level=None, painted=None):
    filled = rng.uniform(size=(SLABS, BUNDLES)) < 0.6
    count = np.where(filled, rng.integers(1, 200, filled.shape), 0)
    level = np.zeros_like(count) if level is None else np.full_like(count, level)
    columns = (filled, level, count[None] * 0, count[None], count, np.zeros(filled.shape, np.float32))
    painted = None if painted is None else jnp.full(filled.shape, painted)
    paint = None if painted is None else jnp.zeros((4, *filled.shape))
    return SlabSchedule(*(jnp.asarray(column) for column in columns), painted, paint)


def stretches(work, samples=SLABS * 4 - 1):
    grid = types.SimpleNamespace(half_steps=jnp.arange(2 * samples + 1, dtype=jnp.float32) / 2, samples=samples)
    return batches_of(grid, work, PLAN)


def chunks_of(found, stretch):
    """Items of the chunks of a stretch, without dummies."""
    chunks = []
    for nth in range(int(stretch.chunks)):
        items, begin = found.chunk(stretch, jnp.int32(nth))
        assert int(begin) == nth * PLAN.chunk
        chunks.append(np.asarray(items)[np.asarray(items) < SLABS * BUNDLES])
        assert chunks[-1].size, "no chunk is marched for nothing"
    return chunks


def test_every_filled_slab_is_in_one_chunk():
    work = work_of(np.random.default_rng(0))
    found, seen = stretches(work), []
    for nth in range(int(found.number)):
        stretch = found.stretch(jnp.int32(nth))
        number, of_stretch = int(stretch.number), np.concatenate(chunks_of(found, stretch))
        np.testing.assert_array_equal(stretch.marched[stretch.slot[:number]], stretch.items[:number])
        blocks = -(-np.asarray(work.count).ravel()[of_stretch] // BLOCK)
        assert (np.diff(blocks) <= 0).all()
        seen += of_stretch.tolist()
    assert sorted(seen) == np.flatnonzero(np.asarray(work.filled)).tolist()


def test_chunks_hold_slabs_of_one_kind():
    rng = np.random.default_rng(2)
    work = work_of(rng)
    kind = rng.integers(0, KINDS, work.count.shape)
    interpolated = jnp.asarray(kind > 1)
    level, count = jnp.asarray(np.maximum(kind - 2, 0), jnp.int32), jnp.where(interpolated, 0, work.count)
    sparse = jnp.asarray(kind == 1)
    found = stretches(dataclasses.replace(work, count=count, level=level, interpolated=interpolated, sparse=sparse))
    np.testing.assert_array_equal(kind_of(found.work), kind)
    seen = []
    for nth in range(int(found.number)):
        stretch = found.stretch(jnp.int32(nth))
        number = int(stretch.number)
        np.testing.assert_array_equal(stretch.marched[stretch.slot[:number]], stretch.items[:number])
        for items in chunks_of(found, stretch):
            assert len(set(kind.ravel()[items])) == 1
            assert (np.diff(-(-np.asarray(count).ravel()[items] // BLOCK)) <= 0).all()
            seen += items.tolist()
    assert sorted(seen) == np.flatnonzero(np.asarray(work.filled)).tolist()


@pytest.mark.parametrize("level", range(MAX_LEVEL + 1))
def test_a_coarse_sample_sits_in_the_middle_of_its_window(level):
    found = stretches(work_of(np.random.default_rng(1), level))
    item, slab, _ = found.item(jnp.arange(BUNDLES))
    middle, border = found.depths(item, slab)
    windows = np.arange(PLAN.slab_samples + 1) * 2**level
    last = SLABS * 4 - 1
    np.testing.assert_array_equal(border[0], np.minimum(windows, last))
    np.testing.assert_array_equal(middle[0], np.minimum(windows[:-1] + 2**level / 2, last))


def test_a_super_pixel_is_one_sample_as_long_as_a_cell():
    found = stretches(work_of(np.random.default_rng(2), MAX_LEVEL, painted=True))
    item, slab, _ = found.item(jnp.arange(BUNDLES))
    border = np.asarray(found.depths(item, slab)[1])
    np.testing.assert_array_equal(border[0], [0, *[1 << MAX_LEVEL] * PLAN.slab_samples])


def test_what_lies_past_the_last_sample_has_no_length():
    found = stretches(work_of(np.random.default_rng(3)), samples=SLABS * 4 - 3)
    item, slab, _ = found.item((SLABS - 1) * BUNDLES + jnp.arange(BUNDLES))
    lengths = np.diff(np.asarray(found.depths(item, slab)[1]), axis=1)
    np.testing.assert_array_equal(lengths[0], [1, 0, 0, 0])


@pytest.mark.parametrize("sizes", [{"chunk": 0}, {"slab_samples": 0}, {"held": 0}, {"held": 12}])
def test_sizes_that_do_not_fit_are_refused(sizes):
    with pytest.raises(ValueError, match="must be"):
        CastPlan(**({"chunk": 8, "slab_samples": 4, "held": 24} | sizes))
