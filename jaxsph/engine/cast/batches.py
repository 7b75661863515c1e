"""Batches of slabs: which are marched together, in which order, and where their samples are.

Flow: schedule -> [batches] -> march, adjoint.

The slabs of all packets, compacted front to back (`access.compaction`), are taken `batch_slabs` at a time. Within such a batch
they are marched in chunks, in order of how many particles they have, such that those of a chunk take equally long. Slabs whose
sums are found by another method have chunks of their own, filled up with dummies: mixed ones would take as long as all that they
are mixed of. So have painted entries, which are not marched: those are the last chunks.

Four numbers name a slab here:

    item    in the schedule: `slab * packets + packet`; past the last, a dummy
    rank    its packet's, tallest first: the n-th item of a layer of the compacted slabs is of the packet of rank n
    place   in its batch, front to back: layer by layer, and by rank in each
    slot    in its batch, as it is marched: by method, then fullest first; its light is held there

    batch.items[place] = item        batch.slot[place] = slot        batch.marched[slot] = item
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from jaxsph.engine.access.compaction import CompactedSlabs, compact
from jaxsph.engine.access.grid import Grid
from jaxsph.engine.access.lists import BUNDLE
from jaxsph.engine.field.gather import BLOCK
from jaxsph.engine.field.tasks import DENSE, NUM_METHODS, PAINTED, RayPackets, SlabSchedule, SlabTask
from jaxsph.engine.runtime.tuning import CPU, Tuning
from jaxsph.numerics.checks import require_sizes


@dataclasses.dataclass(frozen=True)
class CastPlan:
    """Static sizes of the march.

    Attributes:
        chunk: slabs marched together.
        slab_samples: samples that share a window of particles.
        batch_slabs: slabs whose light is held before it is composited; a multiple of `chunk`.
        doublings: how often the samples of a slab can be doubled, for a tolerance.
        tuning: for the kind of machine that marches.
    """

    chunk: int
    slab_samples: int
    batch_slabs: int
    tuning: Tuning = CPU
    doublings: int = 0

    def __post_init__(self) -> None:
        require_sizes(self, zero=("doublings",))
        if self.batch_slabs % self.chunk:
            raise ValueError(f"`batch_slabs` must be a multiple of `chunk`, got {self.batch_slabs} and {self.chunk}")

    def of_shard(self, shards: int) -> CastPlan:
        """The plan of one of so many shards: all together they hold as much light as the plan for all does."""
        return dataclasses.replace(self, batch_slabs=max(self.batch_slabs // (shards * self.chunk), 1) * self.chunk)

    def for_rays(self, rays: int) -> CastPlan:
        """The plan of packets of fewer rays than a bundle has: as much light as it holds, of more slabs."""
        times = BUNDLE * BUNDLE // rays
        return dataclasses.replace(self, chunk=times * self.chunk, batch_slabs=times * self.batch_slabs)


@dataclasses.dataclass(frozen=True)
class Batch:
    """Some of the compacted slabs.

    Attributes:
        items: `slab * packets + packet` of each, in the order of the compacted slabs.
        marched: the same, in the order in which they are marched, and dummies such that chunks hold slabs of one method.
        slot: where in that order each of `items` is; past the last where it is not marched, as its rays have ended.
        first, number: where the batch begins in the compacted slabs, and how many of its slabs are real.
        chunks: how many chunks there are.
        unpainted: how many of them are marched; the entries of the others are painted.
    """

    items: Int[Array, " batch"]
    marched: Int[Array, " slots"]
    slot: Int[Array, " batch"]
    first: Int[Array, ""]
    number: Int[Array, ""]
    chunks: Int[Array, ""]
    unpainted: Int[Array, ""]


@dataclasses.dataclass(frozen=True)
class Batches:
    """All batches of a band; a slab past the last of the schedule is a dummy.

    Attributes:
        schedule: by packet.
        half_steps: depths of samples and their borders, see `Grid`, with room for the dummy slab: what lies past the last
            sample has length zero.
        order: the items of `compacted`, and dummies up to a whole batch.
        min_transmittance: rays end below it; None where they go on to their ends.
        between: whether media are asked for means from border to border.
    """

    schedule: SlabSchedule
    half_steps: Float[Array, " two_samples_and_more"]
    compacted: CompactedSlabs
    order: Int[Array, " items"]
    packets: RayPackets
    plan: CastPlan
    perspective: bool
    min_transmittance: Float[Array, ""] | None = None
    between: bool = False

    @property
    def num_packets(self) -> int:
        """How many packets the band has."""
        return self.schedule.count.shape[1]

    @property
    def num_slots(self) -> int:
        """How many slabs and dummies the chunks of a batch can hold."""
        return self.plan.batch_slabs + (self.schedule.num_methods - 1) * self.plan.chunk

    def where(self, asked: Callable[[SlabTask], Bool[Array, " some"]]) -> Bool[Array, "slabs packets"]:
        """Those slabs of which something is so."""
        chunk = self.plan.chunk

        def ask(nth: Array, found: Array) -> Array:
            items = lax.dynamic_slice(self.order, (nth * chunk,), (chunk,))
            return found.at[items].set(asked(self.task(items)), mode="drop")

        nothing = jnp.zeros(self.schedule.filled.size, bool)
        found = lax.fori_loop(0, (self.compacted.start[-1] + chunk - 1) // chunk, ask, nothing)
        return found.reshape(self.schedule.filled.shape)

    @property
    def number(self) -> Array:
        """How many batches there are."""
        return (self.compacted.start[-1] + self.plan.batch_slabs - 1) // self.plan.batch_slabs

    def batch(self, nth: Array, ended: Bool[Array, " packets"] | None = None) -> Batch:
        """The slabs of one batch, in the order of the compacted slabs and by fullness; of packets that have `ended`, none."""
        first = nth * self.plan.batch_slabs
        items = lax.dynamic_slice(self.order, (first,), (self.plan.batch_slabs,))
        dummy = self.schedule.count.size
        inside, real = jnp.minimum(items, dummy - 1), items < dummy
        span, method = self.schedule.span, self.schedule.method
        method = method if span is None else jnp.where(span > 0, PAINTED, DENSE)
        method = None if method is None else method.ravel()[inside]
        number = real.sum(dtype=jnp.int32)
        wanted = real if ended is None else real & ~ended[inside % self.num_packets]
        order = by_fullness(self.schedule.count.ravel()[inside], method, wanted)
        place, end = jnp.arange(self.plan.batch_slabs, dtype=jnp.int32), wanted.sum(dtype=jnp.int32)
        if method is not None:  # one after the other, each from the beginning of a chunk on
            of_methods = wanted & (method == jnp.arange(self.schedule.num_methods - 1, dtype=jnp.int32)[:, None])
            nth, past = place, jnp.int32(0)
            for with_method in of_methods.sum(1, dtype=jnp.int32):
                past, gap = past + with_method, -with_method % self.plan.chunk
                place, end = jnp.where(nth >= past, place + gap, place), end + gap  # of all later methods
        slot = jnp.zeros(self.plan.batch_slabs, jnp.int32).at[order].set(place)
        marched = jnp.full(self.num_slots, dummy, jnp.int32).at[place].set(jnp.where(wanted, items, dummy)[order])
        if ended is not None:
            slot = jnp.where(wanted, slot, self.num_slots)  # where light is that of nothing
        chunks = unpainted = (end + self.plan.chunk - 1) // self.plan.chunk
        if span is not None:
            unpainted = ((wanted & (method == DENSE)).sum(dtype=jnp.int32) + self.plan.chunk - 1) // self.plan.chunk
        return Batch(items, marched, slot, first, number, chunks, unpainted)

    def ended(self, transmittance: Float[Array, "packets_and_room rays"]) -> Bool[Array, " packets"] | None:
        """Packets all of whose rays let too little through for more to be met; given those by height."""
        if self.min_transmittance is None:
            return None
        return (transmittance.max(1) < self.min_transmittance)[self.compacted.bundle_rank]

    def left_out(self, batch: Batch, spent: Float[Array, "slabs packets"]) -> Float[Array, "packets 2"]:
        """Of what is spent on each slab, what a batch leaves out, and how many slabs that is, by packet."""
        out = (batch.items < spent.size) & (batch.slot == self.num_slots)
        each = spent.ravel()[jnp.minimum(batch.items, spent.size - 1)]
        both = jnp.where(out[:, None], jnp.stack([each, jnp.ones_like(each)], 1), 0)
        return jnp.zeros((self.num_packets, 2), both.dtype).at[batch.items % self.num_packets].add(both)

    def chunk(self, batch: Batch, nth: Array) -> tuple[Array, Array]:
        """Items of a chunk of a batch, and the slot of the first."""
        begin = nth * self.plan.chunk
        return lax.dynamic_slice(batch.marched, (begin,), (self.plan.chunk,)), begin

    def task(self, items: Int[Array, " some"]) -> SlabTask:
        """What is to be done for items; a dummy has no particles."""
        entry, slab, packet = self._entry(items)
        depth, border = self._depths(entry, slab, self.half_steps)
        u, v = self.packets.u[:, packet].T, self.packets.v[:, packet].T
        bundle = packet if self.packets.list_id is None else self.packets.list_id[packet]
        return SlabTask(entry, slab, bundle, u, v, depth, border, self.perspective, self.packets.scattered, self.between)

    def depths(self, items: Int[Array, " some"], half_steps: Array) -> tuple[Array, Array]:
        """Depths of items' samples and borders, read from given `half_steps`."""
        entry, slab, _ = self._entry(items)
        return self._depths(entry, slab, half_steps)

    def _entry(self, items: Int[Array, " some"]) -> tuple[SlabSchedule, Array, Array]:
        """What the schedule says of items, their slabs and their packets."""
        slab, packet = items // self.num_packets, items % self.num_packets
        inside = jnp.minimum(slab, self.schedule.count.shape[0] - 1)
        entry = jax.tree.map(lambda leaf: leaf[..., inside, packet], self.schedule)
        real = inside == slab
        length, count = (jnp.where(real, value, 0) for value in (entry.length, entry.count))
        return dataclasses.replace(entry, length=length, count=count), slab, packet

    def _depths(self, entry: SlabSchedule, slab: Int[Array, " some"], half_steps: Array) -> tuple[Array, Array]:
        """View depths of samples, and of the borders of what they stand for.

        A coarse sample sits at the sample-space middle of its window. A painted entry is a single sample as long as its slabs.
        """
        step, slab_samples = (1 << entry.level)[:, None], self.plan.slab_samples
        if entry.span is not None:
            step = jnp.where(entry.span[:, None] > 0, entry.span[:, None] * slab_samples, step)
        first = (slab * slab_samples)[:, None]
        border = first + step * jnp.arange(slab_samples + 1, dtype=jnp.int32)
        sample = 2 * border[:, :-1] + step
        if entry.span is not None:
            border = jnp.where(entry.span[:, None] > 0, jnp.minimum(border, first + step), border)
        last = half_steps.shape[0] - 1
        return half_steps[jnp.minimum(sample, last)], half_steps[jnp.minimum(2 * border, last)]


def batches_of(
    grid: Grid,
    schedule: SlabSchedule,
    packets: RayPackets,
    plan: CastPlan,
    perspective: bool,
    min_transmittance: Float[Array, ""] | None = None,
    between: bool = False,
) -> Batches:
    """The batches that a `schedule` of bundles is marched in, by packets that read the bundles' lists."""
    schedule = packets.schedule_of(schedule)
    slabs, num_packets = schedule.count.shape
    compacted = compact(schedule.filled)
    order = jnp.pad(compacted.item, (0, plan.batch_slabs), constant_values=slabs * num_packets)
    half_steps = with_room(grid.half_steps, grid.samples, slabs, plan)
    return Batches(schedule, half_steps, compacted, order, packets, plan, perspective, min_transmittance, between)


def with_room(half_steps: Array, samples: int, slabs: int, plan: CastPlan) -> Array:
    """Half steps for a slab past the last."""
    return jnp.pad(half_steps, (0, 2 * ((slabs + 1) * plan.slab_samples - samples)), mode="edge")


def by_fullness(
    count: Int[Array, " batch"], method: Int[Array, " batch"] | None, real: Bool[Array, " batch"]
) -> Int[Array, " batch"]:
    """Slabs in order of method if any, then of how many blocks of particles they have; those that are not `real` last.

    By one packed key: method above emptiness above place.
    """
    bits = (count.shape[0] - 1).bit_length()
    bits_of_rank = 32 - bits - NUM_METHODS.bit_length()
    most = (1 << bits_of_rank) - 1
    rank = (most - jnp.minimum((count + BLOCK - 1) // BLOCK, most)).astype(jnp.uint32)
    first = jnp.where(real, 0 if method is None else method, NUM_METHODS).astype(jnp.uint32)
    key = lax.sort((first << (bits_of_rank + bits)) | (rank << bits) | lax.iota(jnp.uint32, count.shape[0]))
    return (key & jnp.uint32((1 << bits) - 1)).astype(jnp.int32)
