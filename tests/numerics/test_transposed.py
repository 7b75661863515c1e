"""A map with its own transpose is that map in both modes and under vmap, and refuses to be differentiated itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsph.numerics.transposed import linear_map

MATRIX = jnp.asarray([[1.0, 2.0, -1.0], [0.5, 0.0, 3.0]])


def mapped(moves, by=MATRIX):
    """`by @ moves`, through the rules given by hand."""
    (found,) = linear_map(lambda t: (MATRIX @ t[0],), lambda c: [MATRIX.T @ c[0]], [moves], (jnp.zeros(2),), [by], "not twice")
    return found


def test_both_modes_are_the_two_rules():
    moves, cotangent = jnp.asarray([1.0, -2.0, 0.25]), jnp.asarray([0.3, -0.7])
    np.testing.assert_allclose(mapped(moves), MATRIX @ moves, rtol=1e-6)
    np.testing.assert_allclose(jax.jvp(mapped, (moves,), (moves,))[1], MATRIX @ moves, rtol=1e-6)
    np.testing.assert_allclose(jax.vjp(mapped, moves)[1](cotangent)[0], MATRIX.T @ cotangent, rtol=1e-6)


def test_both_modes_are_batched():
    many = jnp.arange(12.0).reshape(4, 3)
    np.testing.assert_allclose(jax.vmap(mapped)(many), many @ MATRIX.T, rtol=1e-6)
    slopes = jax.vmap(jax.grad(lambda moves: mapped(moves).sum()))(many)
    np.testing.assert_allclose(slopes, np.broadcast_to(MATRIX.sum(0), (4, 3)), rtol=1e-6)


def test_what_the_map_depends_on_is_refused():
    with pytest.raises(NotImplementedError, match="not twice"):
        jax.grad(lambda by: mapped(jnp.ones(3), by).sum())(MATRIX)
