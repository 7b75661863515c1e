r"""Rank particles by support class and depth, so that a slab of samples meets a *window* of ranks.

Flow: view -> [ordering] -> lists -> cells -> cast -> image.

Particles of similar support form a class (a factor of two wide); within a class they are ranked by depth. A particle of class
c can touch a sample at depth s only if $|z - s| < H_c$, the largest support of the class, so the particles that can touch a
slab of samples are at most one contiguous window of ranks a class. With supports spread over 20 000 : 1 a window of all
particles together would hold nearly everything; a window a class is never more than about twice too deep.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.access.resolution import ROUNDING
from jaxsph.engine.access.view import DEPTH_BITS, Columns, Viewed, depth_key
from jaxsph.model.camera.camera import Camera
from jaxsph.numerics.trees import tree

KEY_MARGIN = 8  # keys that a window is wider on either side: a key is at most an ulp of its depth, a logarithm errs by a few


@tree()
class Ordered(Columns):
    """Particles in rank order (class, then depth); those that no sample can meet come last.

    Ranks from `first_rank` up to `last_rank` can touch a sample of the slab; from `first_beside` up to `last_beside` any point
    between the samples before and after it, where samples of wider spacing lie. `index` is each one's place before.
    """

    first_rank: Int[Array, "classes slabs"]
    last_rank: Int[Array, "classes slabs"]
    first_beside: Int[Array, "classes slabs"]
    last_beside: Int[Array, "classes slabs"]
    index: Int[Array, " particles"]


COLUMNS = tuple(field.name for field in dataclasses.fields(Columns))


def rank_particles(
    viewed: Viewed,
    camera: Camera,
    depths: Float[Array, " samples"],
    slab_samples: int,
    order: Int[Array, " particles"] | None = None,
) -> Ordered:
    """Rank particles for the sample `depths` (ascending), in slabs of `slab_samples`; in the `order` of keys, where it is known.

    Windows are conservative: the depth key is monotone but for the rounding of a logarithm, which `KEY_MARGIN` covers.

    Differentiation:
        The columns x, y, z, scale, size and quantities have derivatives; all else is held fixed.
    """
    key, order = _sort_by(viewed.key) if order is None else (viewed.key[order], order)
    columns = {name: getattr(viewed, name) for name in COLUMNS}
    ranked = {name: column[order] for name, column in columns.items() if column is not None}
    begin, end = _windows(key, viewed.widest, camera, depths, slab_samples)
    windows = {"first_rank": begin[0], "last_rank": end[0], "first_beside": begin[1], "last_beside": end[1]}
    return Ordered(**ranked, **windows, index=order)


def _windows(
    key: Int[Array, " particles"], widest: Float[Array, " classes"], camera: Camera, depths: Array, slab_samples: int
) -> tuple[Int[Array, "2 classes slabs"], Int[Array, "2 classes slabs"]]:
    """First rank, and the one past the last, of each class and slab: at its samples, and beside them."""
    number, eps = depths.shape[0], jnp.finfo(widest.dtype).eps * ROUNDING
    slabs = math.ceil(number / slab_samples)
    first = jnp.arange(slabs, dtype=jnp.int32) * slab_samples
    last = jnp.minimum(first + slab_samples, number) - 1
    front = depths[jnp.stack([first, jnp.maximum(first - 1, 0)])][:, None]
    back = depths[jnp.stack([last, jnp.minimum(last + 1, number - 1)])][:, None]
    class_key = (jnp.arange(widest.shape[0], dtype=jnp.uint32) << DEPTH_BITS)[:, None]
    widest = widest[:, None] * (1 + eps)
    lowest, highest = depth_key(camera, front - widest), depth_key(camera, back + widest)
    lowest = class_key | jnp.where(lowest > KEY_MARGIN, lowest - KEY_MARGIN, 0)
    highest = class_key | jnp.minimum(highest + KEY_MARGIN, (1 << DEPTH_BITS) - 1)
    begin, end = jnp.searchsorted(key, jnp.stack([lowest, highest + 1])).astype(jnp.int32)  # past `highest`: at the next key
    return begin, end


def _sort_by(key: Int[Array, " particles"]) -> tuple[Array, Array]:
    """Sorted keys and the permutation, by one packed 64-bit sort: twice as fast as a key-payload sort on a CPU."""
    with jax.enable_x64(True):
        packed = (key.astype(jnp.uint64) << 32) | lax.iota(jnp.uint64, key.shape[0])
        packed = lax.sort(packed)
        return (packed >> 32).astype(jnp.uint32), packed.astype(jnp.uint32).astype(jnp.int32)
