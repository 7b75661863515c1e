"""Compact what is filled along each bundle, so that empty space costs nothing.

Flow: slab windows -> [compaction] -> control, cast.

Layer n of the compacted slabs holds every bundle's n-th filled item, front to back without gaps. With bundles in order of
height, the bundles of a layer are the first so many of all: the layers, one after the other, are a list of items in which those
that are near in depth are near each other, and any part of it can be put in front of what follows.

Of `lax.associative_scan` XLA makes dozens of kernels, in half a second; its own cumulative sum is up to ten times as slow as
these on CPUs, in groups of `STEP` and of these groups' totals: each level is one kernel that adds a triangle of entries.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int

from jaxsph.numerics.trees import tree

STEP = 8
SIZE_BITS = 5  # of a sort key: how full an item is, in quarters of octaves
Carry = TypeVar("Carry")


def running_sum(value: Int[Array, "*any"], axis: int = -1) -> Int[Array, "*any"]:
    """Sums of the entries up to each along an axis, that included: as `jnp.cumsum`, for integers."""
    axis %= value.ndim
    before_axis, number, behind = value.shape[:axis], value.shape[axis], value.shape[axis + 1 :]
    groups = -(-number // STEP)
    padding = [(0, groups * STEP - number if k == axis else 0) for k in range(value.ndim)]
    grouped = jnp.pad(value, padding).reshape(*before_axis, groups, 1, STEP, *behind)
    up_to = np.tri(STEP, dtype=bool).reshape(STEP, STEP, *(1 for _ in behind))
    sums = jnp.where(up_to, grouped, 0).sum(axis + 2, dtype=value.dtype)
    if groups > 1:
        total = sums[(slice(None),) * (axis + 1) + (-1,)]
        sums += jnp.expand_dims(running_sum(total, axis) - total, axis + 1)
    return sums.reshape(*before_axis, groups * STEP, *behind)[(slice(None),) * axis + (slice(number),)]


@tree()
class CompactedSlabs:
    """The filled items of a band, layer by layer; `slabs * bundles` is a dummy item.

    Attributes:
        item: `slab * bundles + bundle` of each, then dummies.
        start: where each layer begins in `item`, and where the last ends.
        bundle_rank: of each bundle in order of height, tallest first; the n-th item of a layer is that of the n-th bundle.
    """

    item: Int[Array, " items"]
    start: Int[Array, " layers_and_one"]
    bundle_rank: Int[Array, " bundles"]


def compact(filled: Bool[Array, "slabs bundles"]) -> CompactedSlabs:
    """Compact the `filled` items of each bundle."""
    slabs, bundles = filled.shape
    nth = running_sum(filled.astype(jnp.int32), 0)
    height = nth[-1]
    bits = (bundles - 1).bit_length()
    key = lax.sort(((slabs - height).astype(jnp.uint32) << bits) | lax.iota(jnp.uint32, bundles))
    bundle = (key & jnp.uint32((1 << bits) - 1)).astype(jnp.int32)
    bundle_rank = jnp.zeros(bundles, jnp.int32).at[bundle].set(jnp.arange(bundles, dtype=jnp.int32))
    active = (height > jnp.arange(slabs, dtype=jnp.int32)[:, None]).sum(1, dtype=jnp.int32)
    start = jnp.concatenate([jnp.zeros(1, jnp.int32), running_sum(active)])
    # always in bounds, as a dropped entry is a branch mispredicted
    target = jnp.where(filled, start[jnp.maximum(nth - 1, 0)] + bundle_rank, slabs * bundles)
    item = jnp.full(slabs * bundles + 1, slabs * bundles, jnp.int32)
    item = item.at[target.ravel()].set(jnp.arange(slabs * bundles, dtype=jnp.int32))
    return CompactedSlabs(item.at[-1].set(slabs * bundles), start, bundle_rank)


def fullest_first(
    put: Callable[[Carry, Array, Array], Carry], carry: Carry, wanted: Bool[Array, " all"], count: Int[Array, " all"], most: int
) -> Carry:
    """Take the wanted cells, so many at once at most, in an order in which neighbours are about as full.

    Args:
        put: `put(carry, at, real)`: which cells, and whether each is wanted; the last are filled up with others.
    """
    chunk = min(most, -(-wanted.size // 16) * 16)
    size = jnp.clip(4 * jnp.log2(1 + count.astype(jnp.float32) / 4), 0, (1 << SIZE_BITS) - 2).astype(jnp.uint32)
    bits = 32 - SIZE_BITS
    key = (jnp.where(wanted, (1 << SIZE_BITS) - 2 - size, (1 << SIZE_BITS) - 1) << bits) | lax.iota(jnp.uint32, wanted.size)
    order, number = jnp.pad((lax.sort(key) & ((1 << bits) - 1)).astype(jnp.int32), (0, -wanted.size % chunk)), wanted.sum()

    def step(nth: Array, carry: Carry) -> Carry:
        place = nth * chunk + jnp.arange(chunk, dtype=jnp.int32)
        return put(carry, lax.dynamic_slice(order, (nth * chunk,), (chunk,)), place < number)

    return lax.fori_loop(0, (number + chunk - 1) // chunk, step, carry)  # type: ignore[no-any-return]
