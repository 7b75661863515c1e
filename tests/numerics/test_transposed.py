"""A map with its own transpose is that map in both modes and under vmap, and refuses to be differentiated itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsph.numerics.transposed import linear_map

MATRIX = np.float32([[1.0, 2.0, -1.0], [0.5, 0.0, 3.0]])


def mapped(moves, by=MATRIX):
    """`by @ moves`, through the rules given by hand."""
    (found,) = linear_map(lambda t: (MATRIX @ t[0],), lambda c: [MATRIX.T @ c[0]], [moves], (jnp.zeros(2),), [by], "not twice")
    return found


@jax.jit
def in_both_modes(moves, cotangent):
    return mapped(moves), jax.jvp(mapped, (moves,), (moves,))[1], jax.vjp(mapped, moves)[1](cotangent)[0]


def test_both_modes_are_the_two_rules():
    moves, cotangent = np.float32([1.0, -2.0, 0.25]), np.float32([0.3, -0.7])
    value, pushed, pulled = in_both_modes(moves, cotangent)
    np.testing.assert_allclose(value, MATRIX @ moves, rtol=1e-6)
    np.testing.assert_allclose(pushed, MATRIX @ moves, rtol=1e-6)
    np.testing.assert_allclose(pulled, MATRIX.T @ cotangent, rtol=1e-6)


def test_both_modes_are_batched():
    many, ones = np.arange(12, dtype=np.float32).reshape(4, 3), np.ones((4, 2), np.float32)
    value, _, slopes = jax.jit(jax.vmap(in_both_modes))(many, ones)
    np.testing.assert_allclose(value, many @ MATRIX.T, rtol=1e-6)
    np.testing.assert_allclose(slopes, np.broadcast_to(MATRIX.sum(0), (4, 3)), rtol=1e-6)


def test_what_the_map_depends_on_is_refused():
    with pytest.raises(NotImplementedError, match="not twice"):
        jax.eval_shape(jax.grad(lambda by: mapped(np.ones(3, np.float32), by).sum()), MATRIX)
