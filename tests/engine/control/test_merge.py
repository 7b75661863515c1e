"""Coarser slabs hold the particles of all that they span, and cost what they are said to; cells merge where all allow it."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivatives import QUICKLY
from examples import examples
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from windows import BUNDLES, CELLS, windows_of

from jaxsph.engine.access.slab_windows import CELL_SAMPLES, MAX_LEVEL, coarser_windows
from jaxsph.engine.control.adapt import coarse_schedule, evaluations_of_levels, merged_levels
from jaxsph.engine.control.errors import SUPER_PIXEL, fits
from jaxsph.engine.field.schedule import evaluations

SLAB_SAMPLES = [4, 8, 16]
merge = jax.jit(merged_levels, static_argnums=2)
unions = jax.jit(coarser_windows, compiler_options=QUICKLY)


@functools.partial(jax.jit, static_argnums=1, compiler_options=QUICKLY)
def costs(windows, slab_samples):
    """Of levels whose cells are merged, and of those whose cells are alone."""
    return [evaluations_of_levels(windows, CELLS, slab_samples, merged) for merged in (True, False)]


@functools.partial(jax.jit, static_argnums=2, compiler_options=QUICKLY)
def evaluated(windows, levels, slab_samples, past):
    shape = windows[0].length.shape[1:]
    schedule = coarse_schedule(windows, levels, (jnp.zeros(shape),), jnp.zeros((4, CELLS, BUNDLES)), slab_samples)
    return evaluations(schedule, CELLS * CELL_SAMPLES - past, slab_samples)


@pytest.mark.parametrize("slab_samples", SLAB_SAMPLES)
def test_a_level_costs_what_a_schedule_of_that_level_evaluates(slab_samples):
    found = unions(windows_of(slab_samples))
    merged, alone = costs(found, slab_samples)
    for level in range(MAX_LEVEL + 1):
        share = 1 << max(level - fits(slab_samples), 0)  # cells that share a slab
        whole = CELLS // share * share
        levels = np.int32(np.where(np.arange(CELLS) < whole, level, SUPER_PIXEL)[:, None] * np.ones(BUNDLES, int))
        spent = evaluated(found, levels, slab_samples, 0)
        np.testing.assert_allclose(np.asarray(merged[level])[:whole].sum(0), spent, rtol=1e-6)
        assert (alone[level] is None) == (share > 1)
        windows = np.asarray(found[level].length).sum(0)[: whole * CELL_SAMPLES // slab_samples >> level]
        np.testing.assert_allclose(spent, windows.sum(0) * slab_samples, rtol=1e-6)  # a slab has as many samples at any level


def test_samples_past_the_last_are_not_evaluated_at_full_rate():
    windows, levels = windows_of(4), np.zeros((CELLS, BUNDLES), np.int32)
    all_of_them, fewer = (np.asarray(evaluated(unions(windows), levels, 4, past)) for past in (0, 3))
    np.testing.assert_allclose(all_of_them - fewer, 3 * np.asarray(windows.count)[-1])


@pytest.mark.parametrize("slab_samples", SLAB_SAMPLES)
@examples(60)
@given(data=st.data())
def test_cells_merge_at_the_highest_level_that_all_of_a_group_allow(slab_samples, data):
    every = st.sampled_from([SUPER_PIXEL, *range(MAX_LEVEL + 1), MAX_LEVEL, MAX_LEVEL])
    chosen = data.draw(hnp.arrays(np.int32, (CELLS, BUNDLES), elements=every, fill=st.just(MAX_LEVEL)))
    free = data.draw(hnp.arrays(bool, (CELLS, BUNDLES)))
    found = np.asarray(merge(chosen, free, slab_samples))
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
