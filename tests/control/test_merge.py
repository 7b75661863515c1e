"""Coarser slabs hold the particles of all that they span, and cost what they are said to; cells merge where all allow it."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from jaxsph.access.slab_windows import SlabWindows
from jaxsph.cast.march import evaluations
from jaxsph.cast.batches import CastPlan
from jaxsph.control.errors import SUPER_PIXEL, fits
from jaxsph.control.merge import coarse_work, coarser_windows, evaluations_of_levels, merged_levels
from jaxsph.field.schedule import CELL_SAMPLES, MAX_LEVEL

CLASSES, CELLS, BUNDLES = 2, 17, 3
SLAB_SAMPLES = [4, 8, 16]
merge = jax.jit(merged_levels, static_argnums=2)
unions = jax.jit(coarser_windows, static_argnums=1)


@functools.partial(jax.jit, static_argnums=2)
def evaluated(windows, levels, slab_samples):
    shape = windows[0].length.shape[1:]
    work = coarse_work(windows, levels, jnp.zeros(shape), jnp.zeros((4, CELLS, BUNDLES)), slab_samples)
    return evaluations(work, CELLS * CELL_SAMPLES, CastPlan(8, slab_samples, 8))


def cells_of(slab_samples):
    """Windows of slabs that begin one after the other, some of them empty."""
    rng = np.random.default_rng(slab_samples)
    shape = (CLASSES, CELLS * CELL_SAMPLES // slab_samples, BUNDLES)
    begin = np.sort(rng.integers(0, 900, shape), 1).astype(np.int32)
    length = np.where(rng.uniform(size=shape) < 0.3, 0, rng.integers(1, 40, shape)).astype(np.int32)
    return SlabWindows(*(jnp.asarray(value) for value in (begin, length, length.sum(0, dtype=np.int32))))


@pytest.mark.parametrize("slab_samples", SLAB_SAMPLES)
def test_coarser_windows_are_unions_up_to_the_coarsest(slab_samples):
    cells = cells_of(slab_samples)
    begin, length = np.asarray(cells.begin), np.asarray(cells.length)
    found = unions(cells, slab_samples)
    assert len(found) == MAX_LEVEL + 1
    for level, window in enumerate(found):
        share = 1 << level
        assert window.begin.shape[1] == -(-begin.shape[1] // CELL_SAMPLES) * CELL_SAMPLES >> level
        for group in range(window.begin.shape[1]):
            part = np.s_[:, group * share : (group + 1) * share]
            filled = length[part] > 0
            first = np.where(filled, begin[part], 10**6).min(1, initial=10**6)
            past = np.where(filled, begin[part] + length[part], 0).max(1, initial=0)
            wanted = np.maximum(past - first, 0)
            np.testing.assert_array_equal(window.length[:, group], wanted)
            np.testing.assert_array_equal(np.asarray(window.begin[:, group])[wanted > 0], first[wanted > 0])


@pytest.mark.parametrize("slab_samples", SLAB_SAMPLES)
def test_a_level_costs_what_work_of_that_level_evaluates(slab_samples):
    cells = cells_of(slab_samples)
    found = unions(cells, slab_samples)
    merged, alone = (evaluations_of_levels(found, CELLS, slab_samples, merge) for merge in (True, False))
    for level in range(MAX_LEVEL + 1):
        share = 1 << max(level - fits(slab_samples), 0)  # cells that share a slab
        whole = CELLS // share * share
        levels = jnp.asarray(np.where(np.arange(CELLS) < whole, level, SUPER_PIXEL)[:, None] * np.ones(BUNDLES, int), jnp.int32)
        spent = evaluated(found, levels, slab_samples)
        np.testing.assert_allclose(np.asarray(merged[level])[:whole].sum(0), spent, rtol=1e-6)
        assert (alone[level] is None) == (share > 1)
        windows = np.asarray(found[level].length).sum(0)[: whole * CELL_SAMPLES // slab_samples >> level]
        np.testing.assert_allclose(spent, windows.sum(0) * slab_samples, rtol=1e-6)  # a slab has as many samples at any level


def test_samples_past_the_last_are_not_evaluated_at_full_rate():
    cells = cells_of(4)
    work = coarse_work(unions(cells, 4), jnp.zeros((CELLS, BUNDLES), jnp.int32), jnp.zeros(cells.count.shape), None, 4)
    all_of_them, fewer = (np.asarray(evaluations(work, CELLS * CELL_SAMPLES - past, CastPlan(8, 4, 8))) for past in (0, 3))
    np.testing.assert_allclose(all_of_them - fewer, 3 * np.asarray(cells.count)[-1])


@pytest.mark.parametrize("slab_samples", SLAB_SAMPLES)
@settings(max_examples=60)
@given(data=st.data())
def test_cells_merge_at_the_highest_level_that_all_of_a_group_allow(slab_samples, data):
    every = st.sampled_from([SUPER_PIXEL, *range(MAX_LEVEL + 1), MAX_LEVEL, MAX_LEVEL])
    chosen = data.draw(hnp.arrays(np.int32, (CELLS, BUNDLES), elements=every, fill=st.just(MAX_LEVEL)))
    free = data.draw(hnp.arrays(bool, (CELLS, BUNDLES)))
    found = np.asarray(merge(jnp.asarray(chosen), jnp.asarray(free), slab_samples))
    fitting = fits(slab_samples)
    allows = np.where(free, MAX_LEVEL, np.where(chosen == SUPER_PIXEL, 0, chosen))
    for cell, bundle in np.ndindex(chosen.shape):
        own = chosen[cell, bundle]
        wanted = SUPER_PIXEL if own == SUPER_PIXEL else min(own, fitting)
        for level in range(fitting + 1, MAX_LEVEL + 1):
            share = 1 << (level - fitting)
            group = allows[cell // share * share :, bundle][:share]
            if len(group) == share and (group >= level).all():
                wanted = level
        assert found[cell, bundle] == wanted
