"""A fusion barrier computes what it holds, whatever its witness turns out to be."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsph.numerics.fusion import fusion_barrier


@pytest.mark.parametrize("witness", [1.0, -1.0, 0.0, np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("transform", [lambda f: f, jax.jit, lambda f: lambda w, x: jax.vmap(f)(w[None], x[None])[0]])
def test_no_witness_makes_zeros(transform, witness):
    """NaN fails every comparison, and took the branch that nothing is computed in."""
    found = transform(lambda w, x: fusion_barrier(w > 0, lambda x: (x + 1) ** 2, x))(jnp.float32(witness), jnp.arange(3.0))
    np.testing.assert_array_equal(found, [1, 4, 9])


def test_derivatives_go_through():
    slope = jax.grad(lambda x: fusion_barrier(x[0] > jnp.nan, lambda x: x**2, x).sum())(jnp.arange(3.0))
    np.testing.assert_array_equal(slope, [0, 2, 4])


def test_it_is_still_there_when_compiled():
    """The point of it: a branch, that fusion respects."""
    text = jax.jit(lambda w, x: fusion_barrier(w > 0, jnp.sin, x)).lower(jnp.float32(1), jnp.ones(5)).compile().as_text()
    assert "conditional" in text
