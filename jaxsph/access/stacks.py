"""Stack what is filled along each bundle, and decide in which order the stacks are marched.

Flow: cells -> [stacks] -> control, cast.

Layer n of the stacks holds every bundle's n-th group of filled items, front to back without gaps. In a layer, bundles are
ordered by their work and taken `chunk` at a time, so that a chunk's trip counts are nearly their mean and empty space costs
nothing.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int


@dataclasses.dataclass(frozen=True)
class Stacks:
    """Which items are marched when; `bundles` is a dummy bundle, `items` a dummy item.

    Attributes:
        place: place along depth of each bundle's items, front to back; `group` consecutive rows are a layer.
        order: for each layer, the bundles that have an item in it, most work first, padded to whole chunks with the dummy.
        num_chunks: chunks of each layer.
    """

    place: Int[Array, "items bundles_and_one"]
    order: Int[Array, "layers padded_bundles"]
    num_chunks: Int[Array, " layers"]


def stack(filled: Bool[Array, "items bundles"], work: Int[Array, "items bundles"], group: int, chunk: int) -> Stacks:
    """Stack the `filled` items of each bundle in groups; `work` says how much each will take."""
    items, bundles = filled.shape
    layers = -(-items // group)
    position = jnp.where(filled, jnp.cumsum(filled, 0) - 1, layers * group)
    every = jnp.broadcast_to(jnp.arange(bundles), filled.shape)
    place = jnp.full((layers * group, bundles + 1), items, jnp.int32)
    place = place.at[position, every].set(jnp.arange(items, dtype=jnp.int32)[:, None], mode="drop")
    stacked = jnp.zeros((layers * group, bundles), jnp.int32).at[position, every].set(work.astype(jnp.int32) + 1, mode="drop")
    stacked = stacked.reshape(layers, group, bundles).sum(1)
    bits = (bundles + 1).bit_length()
    key = jnp.minimum(stacked, (1 << (32 - bits)) - 1).astype(jnp.uint32) << bits
    key = ~lax.sort(~(key | jnp.arange(bundles, dtype=jnp.uint32)), dimension=1)
    order = (key & jnp.uint32((1 << bits) - 1)).astype(jnp.int32)
    active = (stacked > 0).sum(1)
    order = jnp.where(jnp.arange(bundles) < active[:, None], order, bundles)
    order = jnp.pad(order, ((0, 0), (0, -bundles % chunk)), constant_values=bundles)
    return Stacks(place, order, (active + chunk - 1) // chunk)


jax.tree_util.register_dataclass(Stacks, data_fields=["place", "order", "num_chunks"], meta_fields=[])
