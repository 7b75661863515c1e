r"""The light integral: samples that count as far as there is anything, and more of them where a tolerance needs those.

Flow: media -> [segments] -> composite; batch, light -> [segments: fronts -> levels -> march again] -> composite.

As point samples, each in the middle of what it stands for, but media give means from border to border as good as they know them:
particles count samples as far as supports cover them, volumes integrate the transfer function over the range of the quantity
(Engel, Kraus & Ertl 2001), of points there are integrals along their chords. So the borders of what is there lie where they are,
and where the field is smooth the error falls with the square of the samples' length.

**How wrong.** Of a function f that is smooth over three samples of length h the mean over the middle one is its value there and
$h^2 f'' / 24$ more, a 24th of the second difference: that is taken out. Where f has a kink within a sample it may be wrong by
three times as much. Where no three in a row are known (at borders, in what is thin) that is a quarter of the difference to a
neighbour, but an eighth of all there is at least: values may be alike by chance. Means between borders of what is linear there
are wrong by a 12th, and stay as they are. As samples are wrong by either sign here and there, their errors add up as independent
ones do, each as it is seen through what lies in front.

**Refinement.** For a tolerance all slabs of a batch are marched once with few samples. How wrong each is estimated to be, times
what is left of the light in front of it, is held against its share of the tolerance; slabs with a ray above it are marched again,
with as many more samples as an error that falls with the square of their distance asks for, and compared again, `ROUNDS` times in
all: as $2^k$ slabs of as many samples each. Errors of slabs are of either sign: those of a ray add up as independent ones do,
$\epsilon^2 = \sum_k (T_k e_k)^2$. So of n slabs that a bundle has, each may have $\mathrm{REACH} / \sqrt n$ of the tolerance;
most have less. `CAUTION` times the sum, and what rounding may add, is the estimate: it was found on scenes that no benchmark
reports (`benchmarks/calibrate_segments.py`), and is no bound.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from jaxsph.engine.cast.batches import Batch, Batches, by_fullness
from jaxsph.engine.cast.composite import Together, over_layers, rows
from jaxsph.engine.cast.integrator import Integrator, PointSamples, Segment, emitted, in_samples, thickness_of, transmitted
from jaxsph.engine.field.tasks import SlabTask
from jaxsph.model.medium import Medium
from jaxsph.numerics.compiled import apart_of, clamped, fusion_barrier, greater, ratio, side_by_side, together_of

SMOOTH = 0.25  # of a sample, that a second difference may be where the light is taken to be smooth over three
KINK, EDGE = 1 / 8, 1 / 4  # of second differences where it is not (or of all), of differences at borders: how wrong samples are
ROUNDS = 2  # of marching slabs again
FEWER = 2  # halvings of a chunk: of a batch few slabs are marched again at a time
REACH = 1.5  # times an equal share of the tolerance, that each slab may be wrong by
CAUTION = 1.4  # times what slabs may be wrong by, see `segments.smoothed`, what they are taken to be wrong by
STEPS = 32  # roundings of the thickness of a sample, from sums over particles to the mean of its extinction


class Segments(PointSamples):
    """Samples with means from border to border."""

    between = True
    estimates = True

    def colors(self, medium: Medium, samples: Any, task: SlabTask) -> Callable[[slice], list[Array]]:
        """At hand before they are composited: a loop over samples would find them anew for each."""
        always = task.slab[0] >= 0
        red_green = fusion_barrier(always, lambda: together_of(*medium.colors(samples, task, slice(0, 2))))
        blue = fusion_barrier(always, lambda: medium.colors(samples, task, slice(2, 3))[0])
        return [*apart_of(red_green), blue].__getitem__

    def compared(self, medium: Medium, gathered: Any, task: SlabTask) -> Segment:
        """With quadratic errors taken out where the light is smooth, and with an estimate of the error."""
        always = task.slab[0] >= 0
        plain, samples = fusion_barrier(always, thickness_of, medium, gathered, task)
        share = medium.covered(samples, task)
        covered = None if share is None else (share, fusion_barrier(always, ratio, 1.0, share))
        known = functools.partial(smoothed, covered=covered, exact=medium.exact_means)
        colors = self.colors(medium, samples, task)(slice(0, 3))
        thickness = fusion_barrier(always, lambda: side_by_side(known(plain)[0], 1))
        left = fusion_barrier(always, transmitted, thickness)

        def shown(channel: int) -> tuple[Array, list[Array]]:
            """What slabs emit of a colour, and what of its samples may be wrong by."""
            emission, doubts = known(colors[channel] * plain)
            mixed = [clamped(ratio(one, thickness[:, k]), 0, 1) for k, one in enumerate(emission)]
            return emitted([mixed], left)[0], doubts

        def blue_and_error() -> Any:
            (blue, *doubts), of_thickness = shown(2), known(plain)[1]
            several = zip(*doubts, *(shown(channel)[1] for channel in (0, 1)), of_thickness, strict=True)
            square, before = jnp.zeros_like(blue), jnp.ones_like(blue)
            for after, each in zip(in_samples(left), several, strict=True):
                square, before = square + before * after * functools.reduce(greater, each) ** 2, after
            return together_of(blue, jnp.sqrt(square))

        red, green = apart_of(fusion_barrier(always, lambda: together_of(shown(0)[0], shown(1)[0])))
        blue, error = apart_of(fusion_barrier(always, blue_and_error))
        return Segment((red, green, blue), left[:, -1], thickness, error)


def smoothed(
    amount: Float[Array, "tasks samples rays"], covered: tuple[Array, Array] | None, exact: bool
) -> tuple[list[Float[Array, "tasks rays"]], list[Float[Array, "tasks rays"]]]:
    """What samples emit or absorb, with quadratic errors taken out where it is smooth; and how much it may be wrong by.

    Written out sample by sample: nothing between is held.

    Args:
        covered: what share of each sample holds any, which is known in the middle of that, and 1 over it; None: means are given.
        exact: whether these are exact.
    """
    given = in_samples(amount)
    if exact:
        return given, [EDGE * one * one * jnp.exp(-one) for one in given]
    whole = jnp.ones_like(given[0])
    shares, values, curved = [whole] * len(given), given, 1 / 12
    if covered is not None:
        shares, inverse = map(in_samples, covered)
        values, curved = [one * per for one, per in zip(given, inverse, strict=True)], 1 / 24
    both = [before * after > 0 for before, after in itertools.pairwise(shares)]
    rise = [jnp.where(there, after - before, 0) for there, (before, after) in zip(both, itertools.pairwise(values), strict=True)]
    second = [after - before for before, after in itertools.pairwise(rise)]
    inner = [before & after for before, after in itertools.pairwise(both)]
    found, doubts = [], []
    for k in range(len(given)):
        beside = [n for n in (k - 1, k) if 0 <= n < len(rise)]
        doubt = functools.reduce(greater, [EDGE * jnp.abs(rise[n]) for n in beside], KINK * values[k])
        n, more = min(max(k - 1, 0), len(second) - 1), jnp.zeros_like(whole)
        if second:
            smooth = inner[n] & (jnp.abs(second[n]) <= SMOOTH * values[k])
            doubt = jnp.where(inner[n], jnp.where(smooth, curved, KINK) * jnp.abs(second[n]), doubt)
            more = jnp.where(smooth, second[n] / 24, more)
        found.append(given[k] if covered is None else greater(0, given[k] + shares[k] * more))
        doubts.append(shares[k] * doubt)
    return found, doubts


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
