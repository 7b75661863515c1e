"""What is taken keeps the budget, and nothing cheaper is left out."""

from __future__ import annotations

import jax
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxsph.engine.control.spacing import select_under_budget

CHOICES, BUNDLES = 12, 5
take = jax.jit(select_under_budget)


@given(seed=st.integers(0, 2**32 - 1), octaves=st.floats(0.1, 20), budget=st.floats(1e-6, 1e3))
def test_the_budget_is_kept_and_dearer_choices_are_the_ones_left(seed, octaves, budget):
    rng = np.random.default_rng(seed)
    variance = np.float32(2.0 ** rng.uniform(-octaves, octaves, (CHOICES, BUNDLES)))
    gain, allowed = np.float32(rng.integers(1, 100, variance.shape)), rng.random(variance.shape) < 0.8
    budgets = np.full(BUNDLES, budget, np.float32)
    taken, total = map(np.asarray, take(variance, gain, allowed, budgets))
    assert not taken[~allowed].any()
    assert (total <= budgets).all()
    np.testing.assert_allclose(np.where(taken, variance, 0).sum(0), total, rtol=1e-5)
    affordable = allowed & (variance <= budgets)
    price = np.log2(variance) - np.log2(gain)
    dearest = np.where(taken, price, -np.inf).max(0)
    assert (price[affordable & ~taken] >= np.broadcast_to(dearest, price.shape)[affordable & ~taken] - 1e-5).all()
    all_fit = np.where(affordable, variance, 0).sum(0) <= 0.999 * budgets
    np.testing.assert_array_equal(taken[:, all_fit], affordable[:, all_fit])


def test_nothing_fits_into_no_budget():
    ones = np.ones((CHOICES, BUNDLES), np.float32)
    taken, total = map(np.asarray, take(ones, ones, ones > 0, np.zeros(BUNDLES, np.float32)))
    assert not taken.any() and not total.any()
