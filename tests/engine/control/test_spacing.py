"""Samples are spaced widely where light does not bend, and the estimate is not less than what that errs by."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from derivatives import QUICKLY

from jaxsph.engine.control.spacing import choose_spacing, second_differences
from jaxsph.engine.field.schedule import MAX_SPACING_LEVEL

NODE_SAMPLES = 2
PLENTY = np.full(1, 1e6, np.float32)

chosen = jax.jit(choose_spacing, static_argnums=3, compiler_options=QUICKLY)
bends = jax.jit(second_differences, compiler_options=QUICKLY)


def test_straight_light_is_spaced_as_widely_as_groups_allow():
    taken = np.ones((14, 1), bool)
    taken[5] = False
    level, spent = chosen(taken, np.zeros((14, 1), np.float32), PLENTY, NODE_SAMPLES)
    assert np.asarray(level)[:, 0].tolist() == [2, 2, 2, 2, 0, 0, 1, 1, 2, 2, 2, 2, 1, 1]
    assert 0 < float(spent[0]) < 1e-8


def test_what_bends_is_spaced_only_as_far_as_the_budget_goes():
    bend = np.float32([[1e-3]] * 4 + [[1.0]] * 4)
    level, spent = chosen(np.ones((8, 1), bool), bend, np.full(1, 0.01, np.float32), NODE_SAMPLES)
    assert np.asarray(level)[:, 0].tolist() == [2] * 4 + [0] * 4
    assert float(spent[0]) <= 0.01
    level, spent = chosen(np.ones((8, 1), bool), bend, np.zeros(1, np.float32), NODE_SAMPLES)
    assert not np.asarray(level).any() and not np.asarray(spent).any()


def test_bands_of_fewer_slabs_than_a_group():
    level, _ = chosen(np.ones((1, 1), bool), np.zeros((1, 1), np.float32), PLENTY, NODE_SAMPLES)
    assert not np.asarray(level).any()


@pytest.mark.parametrize("node_samples", [2, 4])
@pytest.mark.parametrize("level", range(1, MAX_SPACING_LEVEL + 1))
def test_a_bend_is_what_middles_miss_of_a_parabola(level, node_samples, x64):
    """Of light that grows with the square of depth: the mean of the fine samples less that of the wide ones."""
    fine, curve = node_samples << (level + 1), 0.7
    depth = np.arange(fine) + 0.5
    wide = depth.reshape(-1, 1 << level).mean(1)
    missed = curve * ((depth**2).mean() - (wide**2).mean()) * fine
    nodes = np.arange(-node_samples, fine + node_samples, node_samples) + 0.5
    extinction = [np.full(1, curve * node**2) for node in nodes[1:]]
    dark = [[np.zeros(1)] * len(extinction)] * 3
    step = np.full((len(extinction) - 1, 1), float(node_samples))
    previous = np.float64([[0]] * 3 + [[curve * nodes[0] ** 2]])
    # thin: what is in front takes nothing away
    thin = 1e-10
    bend, after = bends(dark, [value * thin for value in extinction], step, np.zeros(1), previous * thin)
    found = (4**level - 1) / (24 * node_samples**2) * float(bend[0]) / thin
    np.testing.assert_allclose(found, missed, rtol=1e-5)
    np.testing.assert_allclose(np.asarray(after)[3] / thin, extinction[-2], rtol=1e-5)


def test_light_behind_thick_slabs_bends_less():
    flat = [np.ones(1)] * 3
    bent = [np.zeros(1), np.ones(1), np.zeros(1)]
    step, previous = np.full((2, 1), 0.1), np.zeros((4, 1))
    near, _ = bends([flat] * 3, bent, step, np.zeros(1), previous)
    far, _ = bends([flat] * 3, bent, step, np.full(1, 5.0), previous)
    np.testing.assert_allclose(far, np.exp(-5) * np.asarray(near), rtol=1e-5)
