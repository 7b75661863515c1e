"""Sums over blocks of particles against dense sums, for any body and both modes of differentiation."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from derivatives import QUICKLY

from jaxsph.analysis.projection.columns import over_blocks

PARTICLES, WINDOWS, PLACES = 30, 6, 3


@dataclasses.dataclass(frozen=True)
class Bells:
    """Two sums of bells at places, of particles that hold two amounts."""

    block: int = 4
    block_back: int = 3

    def prepare(self, rows, each, shared):
        return (rows[:, None, :, 0] - each) * shared, rows[:, None, :, 1], rows[:, None, :, 2]

    def sums(self, part):
        bell = jnp.exp(-(part[0] ** 2))
        return [(part[1] * bell).sum(0), (part[2] * bell).sum(0)]


def of_windows(given, begin, length, rank):
    """The same, window by window."""
    found = np.zeros((2, 2, PLACES, WINDOWS // 2))
    for chunk in range(2):
        for window in range(WINDOWS // 2):
            table, each, shared = given
            rows = table[rank[begin[chunk, window] :][: length[chunk, window]]]
            bell = np.exp(-(((rows[:, :1] - each[chunk, :, window]) * shared) ** 2))
            found[:, chunk, :, window] = (rows[:, 1:, None] * bell[:, None]).sum(0)
    return found


def test_sums_are_those_over_all_windows_and_their_transpose_is_that_of_their_derivative():
    rng = np.random.default_rng(0)
    rank = rng.integers(0, PARTICLES, 50).astype(np.int32)
    begin, length = np.int32([[0, 7, 7], [20, 29, 41]]), np.int32([[7, 0, 13], [9, 12, 9]])
    given, move = (
        tuple(rng.normal(size=shape).astype(np.float32) for shape in ((PARTICLES, 3), (2, PLACES, WINDOWS // 2), ()))
        for _ in range(2)
    )
    cotangent = [rng.normal(size=(2, PLACES, WINDOWS // 2)).astype(np.float32) for _ in range(2)]

    @functools.partial(jax.jit, compiler_options=QUICKLY)
    def looked(given, move, cotangent):
        sums = functools.partial(over_blocks, Bells(), windows=tuple(map(jnp.asarray, (rank, begin, length))))
        found, pull = jax.vjp(sums, given)
        return found, jax.jvp(sums, (given,), (move,))[1], pull(cotangent)[0]

    found, forward, backward = looked(given, move, cotangent)
    np.testing.assert_allclose(found, of_windows(given, begin, length, rank), rtol=1e-5, atol=1e-5)
    ahead = sum((one * other).sum() for one, other in zip(forward, cotangent, strict=True))
    back = sum(np.vdot(one, other) for one, other in zip(jax.tree.leaves(backward), jax.tree.leaves(move), strict=True))
    step, ends = 1e-3, []
    for side in (1, -1):
        moved = jax.tree.map(lambda value, change, side=side: value.astype(np.float64) + side * step * change, given, move)
        ends.append(of_windows(moved, begin, length, rank))
    np.testing.assert_allclose(forward, (ends[0] - ends[1]) / (2 * step), rtol=1e-3, atol=1e-3)
    assert abs(ahead - back) < 1e-4 * abs(ahead) + 1e-4
