"""Sums over blocks of particles against dense sums, for any body and both modes of differentiation."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from derivatives import QUICKLY

from jaxsph.analysis.projection.columns import over_blocks
from jaxsph.analysis.projection.project import LEAST_PIECE, cut_to_pieces
from jaxsph.engine.access.lists import BundleLists, ListPlan

PARTICLES, WINDOWS, PLACES = 30, 6, 3


@dataclasses.dataclass(frozen=True)
class Bells:
    """Two sums of bells, of particles that hold two amounts: means over places."""

    block: int = 4
    block_back: int = 3

    def prepare(self, rows, each, shared):
        return (rows[:, None, :, 0] - each) * shared, rows[:, None, :, 1], rows[:, None, :, 2]

    def sums(self, part):
        bell = jnp.exp(-(part[0] ** 2))
        return [(part[1] * bell).sum(0), (part[2] * bell).sum(0)]

    def pixels_of(self, sums):
        return sums.mean(0)

    def sums_of(self, pixels):
        return jnp.broadcast_to(pixels / PLACES, (PLACES, *pixels.shape))


def of_windows(given, begin, length, rank):
    """The same, window by window."""
    found = np.zeros((2, 2, WINDOWS // 2))
    for chunk in range(2):
        for window in range(WINDOWS // 2):
            table, each, shared = given
            rows = table[rank[begin[chunk, window] :][: length[chunk, window]]]
            bell = np.exp(-(((rows[:, :1] - each[chunk, :, window]) * shared) ** 2))
            found[:, chunk, window] = (rows[:, 1:, None] * bell[:, None]).sum(0).mean(1)
    return found


def test_sums_are_those_over_all_windows_and_their_transpose_is_that_of_their_derivative():
    rng = np.random.default_rng(0)
    rank = rng.integers(0, PARTICLES, 50).astype(np.int32)
    begin, length = np.int32([[0, 7, 7], [20, 29, 41]]), np.int32([[7, 0, 13], [9, 12, 9]])
    given, move = (
        tuple(rng.normal(size=shape).astype(np.float32) for shape in ((PARTICLES, 3), (2, PLACES, WINDOWS // 2), ()))
        for _ in range(2)
    )
    cotangent = [rng.normal(size=(2, WINDOWS // 2)).astype(np.float32) for _ in range(2)]

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


def test_pieces_are_all_of_each_list_and_none_is_crowded():
    lists, longest = ListPlan(1, 2, 64, 4096), LEAST_PIECE
    length = np.int32([0, 3 * longest, 1, longest, 0, longest + 1, 0, 0])
    start = np.concatenate([[0], np.cumsum(length)[:-1]]).astype(np.int32)
    made = BundleLists(jnp.zeros(4097, jnp.int32), jnp.asarray(start), jnp.asarray(start + length), jnp.uint32(0))
    bundle, begin, size = map(np.asarray, jax.jit(functools.partial(cut_to_pieces, lists))(made))
    assert size.min() == 0 and size.max() == max(length.sum() // 8 + 1, longest) and size[-1] == 0
    for nth in range(8):
        mine = (bundle == nth) & (size > 0)
        met = np.concatenate([np.arange(*ends) for ends in zip(begin[mine], (begin + size)[mine], strict=True)] or [np.arange(0)])
        np.testing.assert_array_equal(met, np.arange(start[nth], start[nth] + length[nth]))
