"""A fusion barrier computes what it holds, whatever its witness turns out to be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsph.numerics.compiled import fusion_barrier


def held(witness, x):
    return fusion_barrier(witness > 0, lambda x: (x + 1) ** 2, x)


@pytest.mark.parametrize("witness", [1.0, -1.0, 0.0, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("transformed", [held, jax.jit(held), jax.jit(lambda w, x: jax.vmap(held)(w[None], x[None])[0])])
def test_no_witness_makes_zeros(transformed, witness):
    """NaN fails every comparison, and took the branch that nothing is computed in."""
    np.testing.assert_array_equal(transformed(np.float32(witness), np.arange(3, dtype=np.float32)), [1, 4, 9])


def test_derivatives_go_through():
    slope = jax.jit(jax.grad(lambda x: fusion_barrier(x[0] > np.nan, lambda x: x**2, x).sum()))(np.arange(3, dtype=np.float32))
    np.testing.assert_array_equal(slope, [0, 2, 4])


def test_it_is_still_there_when_compiled():
    """The point of it: a branch, that fusion respects."""
    lowered = jax.jit(lambda w, x: fusion_barrier(w > 0, jnp.sin, x)).lower(np.float32(1), np.ones(5, np.float32))
    assert "conditional" in lowered.compile().as_text()
