"""Sums come back in the order in which they were given, packed in pairs or not, and travel through loops as what they are."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from jaxsph.engine.field.sums import sums_of, with_block
from jaxsph.numerics.fusion import barriers


@pytest.mark.parametrize("in_pairs", [True, False])
@pytest.mark.parametrize("quantities", [1, 2, 3])
def test_sums_come_back_in_order(quantities, in_pairs):
    channels = [jnp.asarray(value, jnp.float32) for value in np.random.default_rng(0).normal(size=(1 + quantities, 2, 5))]
    with barriers(in_pairs):
        sums = sums_of(channels)
    assert len(sums.packed) == ({1: 1, 2: 3, 3: 2}[quantities] if in_pairs else len(channels)), "three are reduced, not carried"
    assert sums.num_quantities == quantities
    for found, given in zip(sums.all, channels, strict=True):
        assert found.dtype == jnp.float32
        np.testing.assert_array_equal(found, given)


@pytest.mark.parametrize("in_pairs", [True, False])
def test_loops_add_to_each_sum_its_own(in_pairs):
    def turn(k, sums):
        return sums_of([value + (k + 1) * 10.0**nth for nth, value in enumerate(sums.all)])

    with barriers(in_pairs):
        sums = jax.jit(lambda: lax.fori_loop(0, 3, turn, sums_of([jnp.zeros(4)] * 3)))()
    np.testing.assert_array_equal(np.stack(sums.all), np.float32([[6], [60], [600]]) * np.ones((3, 4)))


def test_sums_are_rounded_alike_where_they_have_derivatives():
    """Else a sample of particles on a control point has the slope of either side, by the mode that it is asked in."""
    rng = np.random.default_rng(0)
    given = rng.uniform(0, 1, (16, 4, 64)).astype(np.float32), rng.uniform(0, 1, (2, 16, 1, 1)).astype(np.float32)

    def summed(margin, quantities):
        weights = [one * one * one for one in margin]  # a compiler may round a product and what it is added to at once
        block = list(zip(weights, quantities.swapaxes(0, 1), strict=True))
        return lax.fori_loop(0, 2, lambda _, sums: with_block(sums, block), sums_of([jnp.zeros((4, 64))] * 3)).all

    moved = jax.jit(lambda *given: jax.jvp(summed, given, given)[0])(*given)
    np.testing.assert_array_equal(moved, jax.jit(summed)(*given))
