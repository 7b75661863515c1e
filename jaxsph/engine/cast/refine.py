r"""Shorter segments where a tolerance needs them: slabs of a batch are marched again until their estimated errors are small.

Flow: batch, light -> [refine: fronts -> levels -> march again] -> composite.

All slabs of a batch are marched once with few samples. How wrong each is estimated to be (`Segments.compared`), times what is
left of the light in front of it, is held against its share of the tolerance; slabs with a ray above it are marched again, with as
many more samples as an error that falls with the square of their distance asks for, and compared again, `ROUNDS` times in all: as
$2^k$ slabs of as many samples each.

Errors of slabs are of either sign, as they come from how the field bends here and there: those of a ray add up as independent
ones do, $\epsilon^2 = \sum_k (T_k e_k)^2$. So of n slabs that a bundle has, each may have $\mathrm{REACH} / \sqrt n$ of the
tolerance; most have less. `CAUTION` times the sum, and what rounding may add (`march.rounding_of`), is the estimate: it was
found on scenes that no benchmark reports (`benchmarks/calibrate_segments.py`), and is no bound.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.cast.batches import Batch, Batches, by_fullness
from jaxsph.engine.cast.composite import Together, over_layers, rows
from jaxsph.engine.cast.integrator import Segment
from jaxsph.numerics.fusion import fusion_barrier

ROUNDS = 2  # of marching slabs again
FEWER = 2  # halvings of a chunk: of a batch few slabs are marched again at a time
REACH = 1.5  # times an equal share of the tolerance, that each slab may be wrong by
CAUTION = 1.4  # times what slabs may be wrong by, see `segments.smoothed`, what they are taken to be wrong by


class Refined(NamedTuple):
    """Slabs of a batch by slot: light, evaluations a ray that more samples took, how often these were doubled, and are to be."""

    light: Segment
    spent: Float[Array, " packets"]
    level: Int[Array, " slots"]
    wanted: Int[Array, " slots"]


def shares_of(batches: Batches, tolerance: Float[Array, ""]) -> Float[Array, " packets"]:
    """How wrong each slab of a packet may be, as it is seen."""
    number = batches.schedule.filled.sum(0)
    return jnp.minimum(REACH / jnp.sqrt(jnp.maximum(number, 1)), 1).astype(tolerance.dtype) * tolerance


def refine(
    batches: Batches,
    batch: Batch,
    light: Segment,
    spent: Float[Array, " packets"],
    seen: Callable[[Segment], Float[Array, " slots"]],
    share: Float[Array, " packets"],
    march: Callable[[Array, Array], Segment],
) -> tuple[Segment, Float[Array, " packets"]]:
    """March the slabs of a batch by `march(items, level)`, and again where errors that are `seen` of light, by slot, are large.

    All in one loop, such that there is one copy of it in the program: levels one after the other, `ROUNDS` times, after level 0.
    """
    dummy, doublings = batches.schedule.count.size, batches.plan.doublings
    packet, real = batch.marched % batches.num_packets, batch.marched < dummy
    allowed = jnp.where(real, share[packet], jnp.inf)
    count = batches.schedule.count.ravel()[jnp.minimum(batch.marched, dummy - 1)]

    def judged(state: Refined) -> Array:
        excess = seen(state.light)[: allowed.shape[0]] / allowed
        more = jnp.clip(jnp.ceil(0.5 * jnp.log2(jnp.maximum(excess, 1))), 1, doublings).astype(jnp.int32)
        return jnp.where(excess > 1, jnp.minimum(state.level + more, doublings), state.level)

    def step(nth: Array, state: Refined) -> Refined:
        level = jnp.where(nth == 0, 0, (nth - 1) % doublings + 1)
        wanted = lax.cond(level == 1, judged, lambda state: state.wanted, state)
        chosen = jnp.where(nth == 0, real, (wanted == level) & (state.level < level))
        order, number = by_fullness(count, None, chosen), chosen.sum(dtype=jnp.int32)
        light = _marched(batches, batch, state.light, order, number, march, level)
        evaluations = jnp.where(chosen & (nth > 0), count, 0).astype(jnp.float32) * (batches.plan.slab_samples << level)
        return Refined(light, state.spent.at[packet].add(evaluations), jnp.where(level == doublings, wanted, state.level), wanted)

    nothing = jnp.zeros_like(batch.marched)
    return lax.fori_loop(0, 1 + ROUNDS * doublings, step, Refined(light, spent, nothing, nothing))[:2]


def _marched(
    batches: Batches,
    batch: Batch,
    light: Segment,
    order: Int[Array, " slots"],
    number: Array,
    march: Callable[[Array, Array], Segment],
    level: Array,
) -> Segment:
    """Light with the first so many of an order of slots marched at a level."""
    chunk, dummy = max(batches.plan.chunk >> FEWER, 1), batches.schedule.count.size
    order = jnp.pad(order, (0, chunk))
    last = light.transmittance.shape[0]

    def march_chunk(nth: Array, light: Segment) -> Segment:
        place = nth * chunk + jnp.arange(chunk, dtype=jnp.int32)
        slot = lax.dynamic_slice(order, (nth * chunk,), (chunk,))
        items = jnp.where(place < number, batch.marched[slot], dummy)
        found, slot = march(items, level), jnp.where(place < number, slot, last)
        return jax.tree.map(lambda old, new: old.at[slot].set(new, mode="drop"), light, found)

    return lax.fori_loop(0, (number + chunk - 1) // chunk, march_chunk, light)


def errors_seen(
    batch: Batch, light: Segment, transmittance: Float[Array, "packets rays"], starts: Array, together: Together
) -> Float[Array, " slots"]:
    """The largest error of the rays of each slot, as it is seen through what lies in front of it in the batch and before."""
    nothing, error = light.transmittance.shape[0] - 1, light.error
    assert error is not None

    def put(carry: tuple[Array, Array], place: Array, inside: Array, packet: Array) -> tuple[Array, Array]:
        left, found = carry
        slot = jnp.where(inside, batch.slot[place], nothing)
        here = fusion_barrier(packet >= 0, lambda: rows(left, packet, together.packets))
        worst = (here * error[slot]).max(1)
        left = lax.dynamic_update_slice_in_dim(left, here * light.transmittance[slot], packet, 0)
        return left, found.at[slot].max(jnp.where(slot < nothing, worst, 0))

    found = jnp.zeros(nothing + 1, light.transmittance.dtype)
    return CAUTION * over_layers(put, (transmittance, found), starts, batch, together)[1]
