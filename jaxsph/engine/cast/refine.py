r"""Shorter segments where a tolerance needs them: slabs of a batch are marched again until their estimated errors are small.

Flow: batch, light -> [refine: fronts -> levels -> march again] -> composite. Only marches that keep a tolerance load it.

All slabs of a batch are marched once with few samples. How wrong each is estimated to be (`Segments.compared`), times what is
left of the light in front of it, is held against its share of the tolerance; slabs with a ray above it are marched again, with as
many more samples as an error that falls with the square of their distance asks for, and compared again, `ROUNDS` times in all: as
$2^k$ slabs of as many samples each.

Errors of slabs are of either sign, as they come from how the field bends here and there: those of a ray add up as independent
ones do, $\epsilon^2 = \sum_k (T_k e_k)^2$. So of n slabs that a bundle has, each may have $\mathrm{REACH} / \sqrt n$ of the
tolerance; most have less. `CAUTION` times the sum, and what rounding may add, is the estimate: it was found on scenes
that no benchmark reports (`benchmarks/calibrate_segments.py`), and is no bound.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.cast.batches import Batch, Batches, by_fullness
from jaxsph.engine.cast.composite import Together, over_layers, rows
from jaxsph.engine.cast.integrator import Integrator, Segment
from jaxsph.model.medium import Medium
from jaxsph.numerics.fusion import fusion_barrier

ROUNDS = 2  # of marching slabs again
FEWER = 2  # halvings of a chunk: of a batch few slabs are marched again at a time
REACH = 1.5  # times an equal share of the tolerance, that each slab may be wrong by
CAUTION = 1.4  # times what slabs may be wrong by, see `segments.smoothed`, what they are taken to be wrong by
STEPS = 32  # roundings of the thickness of a sample, from sums over particles to the mean of its extinction


class Refined(NamedTuple):
    """Slabs of a batch by slot: light, evaluations a ray that more samples took, how often these were doubled, and are to be."""

    light: Segment
    spent: Float[Array, " packets"]
    level: Int[Array, " slots"]
    wanted: Int[Array, " slots"]


@dataclasses.dataclass(frozen=True)
class Refinement:
    """What slabs are marched again by, for a tolerance."""

    batches: Batches
    medium: Medium
    integrator: Integrator
    tolerance: Float[Array, ""]

    def march(
        self, batch: Batch, light: Segment, spent: Float[Array, " packets"], transmittance: Float[Array, "packets rays"]
    ) -> tuple[Segment, Float[Array, " packets"]]:
        """March the slabs of a batch, and again where the errors that rays with `transmittance` see are large.

        All in one loop, such that there is one copy of it in the program: levels one after the other, `ROUNDS` times, after 0.
        """
        batches, doublings = self.batches, self.batches.plan.doublings
        dummy, chunk = batches.schedule.count.size, max(batches.plan.chunk >> FEWER, 1)
        packet, real = batch.marched % batches.num_packets, batch.marched < dummy
        share = jnp.minimum(REACH / jnp.sqrt(jnp.maximum(batches.schedule.filled.sum(0), 1)), 1).astype(self.tolerance.dtype)
        allowed = jnp.where(real, (share * self.tolerance)[packet], jnp.inf)
        count = batches.schedule.count.ravel()[jnp.minimum(batch.marched, dummy - 1)]
        last = light.transmittance.shape[0]

        def judged(state: Refined) -> Array:
            excess = self._seen(batch, state.light, transmittance)[: allowed.shape[0]] / allowed
            more = jnp.clip(jnp.ceil(0.5 * jnp.log2(jnp.maximum(excess, 1))), 1, doublings).astype(jnp.int32)
            return jnp.where(excess > 1, jnp.minimum(state.level + more, doublings), state.level)

        def step(nth: Array, state: Refined) -> Refined:
            level = jnp.where(nth == 0, 0, (nth - 1) % doublings + 1)
            wanted = lax.cond(level == 1, judged, lambda state: state.wanted, state)
            chosen = jnp.where(nth == 0, real, (wanted == level) & (state.level < level))
            order, number = jnp.pad(by_fullness(count, None, chosen), (0, chunk)), chosen.sum(dtype=jnp.int32)

            def march_chunk(nth: Array, light: Segment) -> Segment:
                here = nth * chunk + jnp.arange(chunk, dtype=jnp.int32) < number
                slot = lax.dynamic_slice(order, (nth * chunk,), (chunk,))
                items = jnp.where(here, batch.marched[slot], dummy)
                found, slot = self._with_samples(items, level), jnp.where(here, slot, last)
                return jax.tree.map(lambda old, new: old.at[slot].set(new, mode="drop"), light, found)

            light = lax.fori_loop(0, (number + chunk - 1) // chunk, march_chunk, state.light)
            evaluations = jnp.where(chosen & (nth > 0), count, 0).astype(jnp.float32) * (batches.plan.slab_samples << level)
            done = jnp.where(level == doublings, wanted, state.level)
            return Refined(light, state.spent.at[packet].add(evaluations), done, wanted)

        nothing = jnp.zeros_like(batch.marched)
        return lax.fori_loop(0, 1 + ROUNDS * doublings, step, Refined(light, spent, nothing, nothing))[:2]

    def error(self, square: Float[Array, "packets rows columns"]) -> Float[Array, "packets rows columns"]:
        """How wrong rays are estimated to be, by the squared errors of their slabs; nothing where nothing is marched.

        A slab that is put into a ray rounds colour and transmittance by a half of eps, which are at most 1, and so does its
        product with the light in front. Its thickness is wrong by a half of eps of itself for each sample that is added up, and
        for `STEPS` before: of all slabs together that is as much of the light, as thicknesses take no more of it than there is.
        """
        plan, filled = self.batches.plan, self.batches.schedule.filled.sum(0).astype(square.dtype)
        halves = jnp.where(filled > 0, 2 * filled + (plan.slab_samples << plan.doublings) + STEPS, 0)
        return CAUTION * jnp.sqrt(square) + halves[:, None, None] * (jnp.finfo(square.dtype).eps / 2)

    def _with_samples(self, items: Array, level: Array) -> Segment:
        """Slabs with `2 ** level` times as many samples, and how wrong that may be: errors of parts are independent."""
        task, samples = self.batches.task(items), self.batches.plan.slab_samples

        def march_part(nth: Array, front: Segment) -> Segment:
            part = task.refined(level, nth)
            light = self.integrator.compared(self.medium, self.medium.gather(part), part)
            left, (red, green, blue) = front.transmittance, light.color
            color = tuple(met + left * new for met, new in zip(front.color, (red, green, blue), strict=True))
            sample = (nth * samples + jnp.arange(samples, dtype=jnp.int32)) >> level
            thickness = front.thickness.at[:, sample].add(light.thickness)
            assert front.error is not None and light.error is not None
            error = jnp.hypot(front.error, left * light.error)
            return Segment(color, left * light.transmittance, thickness, error)  # type: ignore[arg-type]

        nothing = jnp.zeros(task.shape[::2], task.depth.dtype)
        start = Segment((nothing,) * 3, jnp.ones_like(nothing), jnp.zeros(task.shape, nothing.dtype), nothing)
        return lax.fori_loop(0, 1 << level, march_part, start)

    def _seen(self, batch: Batch, light: Segment, transmittance: Float[Array, "packets rays"]) -> Float[Array, " slots"]:
        """The largest error of the rays of each slot, as it is seen through what lies in front of it in the batch and before."""
        nothing, error = light.transmittance.shape[0] - 1, light.error
        together = Together.of(self.batches.num_packets, self.batches.plan.tuning)
        assert error is not None

        def put(carry: tuple[Array, Array], place: Array, inside: Array, packet: Array) -> tuple[Array, Array]:
            left, found = carry
            slot = jnp.where(inside, batch.slot[place], nothing)
            here = fusion_barrier(packet >= 0, lambda: rows(left, packet, together.packets))
            worst = (here * error[slot]).max(1)
            left = lax.dynamic_update_slice_in_dim(left, here * light.transmittance[slot], packet, 0)
            return left, found.at[slot].max(jnp.where(slot < nothing, worst, 0))

        found = jnp.zeros(nothing + 1, light.transmittance.dtype)
        return CAUTION * over_layers(put, (transmittance, found), self.batches.compacted.start, batch, together)[1]
