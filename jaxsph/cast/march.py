"""Marching: from schedule and media to what all rays have met.

Flow: schedule, packets -> batches -> [march: media -> integrator -> composite] -> screen.

What a slab of samples does to light does not depend on what lies in front of it. So a batch of slabs is marched in any order,
chunk by chunk; what they emit and absorb is held, and then put into the rays' state layer by layer.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from jaxsph.access.grid import Grid
from jaxsph.cast.batches import Batches, CastPlan, batches_of
from jaxsph.cast.composite import RayState, Together, composite, empty_segments, fresh_rays
from jaxsph.cast.integrator import Integrator, Segment
from jaxsph.field.schedule import SlabSchedule, evaluations_of_slabs
from jaxsph.field.tasks import RayPackets
from jaxsph.model.medium import Medium


@dataclasses.dataclass(frozen=True)
class RayResult:
    """What all rays of a band have met: premultiplied colour, transmittance, depth of half transmittance.

    `left_out` is what rays that ended would have taken, kernel evaluations a ray of each packet; None where none can end.
    """

    color: Float[Array, "3 packets rows columns"]
    transmittance: Float[Array, "packets rows columns"]
    depth: Float[Array, "packets rows columns"]
    left_out: Float[Array, " packets"] | None = None


def march(
    grid: Grid,
    schedule: SlabSchedule,
    packets: RayPackets,
    medium: Medium,
    integrator: Integrator,
    plan: CastPlan,
    perspective: bool,
    min_transmittance: Float[Array, ""] | None = None,
) -> RayResult:
    """March all packets of a band.

    Args:
        schedule: the slabs of samples to march, by bundle.
        min_transmittance: packets all of whose rays let less through end, between batches; None for none.
    """
    batches = batches_of(grid, schedule, packets, plan, perspective, bool(integrator.halo), min_transmittance, integrator.between)
    together, ending = Together.of(batches.num_packets, plan.tuning), min_transmittance is not None
    spent = evaluations_of_slabs(batches.schedule, grid.samples, plan.slab_samples, integrator.halo) if ending else None

    def march_batch(nth: Array, state: tuple[RayState, Segment, Array | None]) -> tuple[RayState, Segment, Array | None]:
        rays, light, left_out = state
        batch = batches.batch(nth, batches.ended(rays.transmittance))
        if spent is not None and left_out is not None:
            left_out = left_out + batches.left_out(batch, spent)

        def march_chunk(chunk: Array, light: Segment) -> Segment:
            items, begin = batches.chunk(batch, chunk)
            found = segments_of(batches, items, medium, integrator)
            return jax.tree.map(lambda old, new: lax.dynamic_update_slice_in_dim(old, new, begin, 0), light, found)

        def borders(place: Array) -> Array:
            return batches.borders(batch.items[place])

        light = lax.fori_loop(0, batch.chunks, march_chunk, light)
        return composite(rays, light, batch, borders, batches.compacted.start, together), light, left_out

    dtype = grid.half_steps.dtype
    rays = fresh_rays(batches.num_packets, packets.num_rays, dtype, together)
    light = empty_segments(batches.num_slots + 1, plan.slab_samples, packets.num_rays, dtype)
    nothing = jnp.zeros(batches.num_packets, jnp.float32) if ending else None
    rays, _, left_out = lax.fori_loop(0, batches.number, march_batch, (rays, light, nothing))
    return dataclasses.replace(result_of(rays, batches), left_out=left_out)


def segments_of(batches: Batches, items: Array, medium: Medium, integrator: Integrator) -> Segment:
    """What slabs emit and let through."""
    task = batches.task(items)
    return integrator(medium, medium.gather(task), task)


def result_of(rays: RayState, batches: Batches) -> RayResult:
    """Rays in the order of packets, as rows and columns."""
    rank, shape = batches.compacted.bundle_rank, batches.packets.shape
    *color, transmittance, depth = (field[rank].reshape(-1, *shape) for field in (*rays.color, rays.transmittance, rays.depth))
    return RayResult(jnp.stack(color), transmittance, depth)


jax.tree_util.register_dataclass(RayResult, data_fields=["color", "transmittance", "depth", "left_out"], meta_fields=[])
