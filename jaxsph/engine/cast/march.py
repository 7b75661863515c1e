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

from jaxsph.engine.access.grid import Grid
from jaxsph.engine.cast.batches import CastPlan, batches_of
from jaxsph.engine.cast.composite import RayState, Together, composite, empty_segments, fresh_rays
from jaxsph.engine.cast.integrator import Integrator, Segment
from jaxsph.engine.field.schedule import SlabSchedule, evaluations_of_slabs
from jaxsph.engine.field.tasks import RayPackets
from jaxsph.model.medium import Medium
from jaxsph.numerics.names import found as named
from jaxsph.numerics.trees import tree

# between batches: what rays have met, the light of the last batch by slot, and what of `RayResult` is summed up
Marched = tuple[RayState, Segment, Float[Array, "packets 2"] | None, Array | None]


@tree()
class RayResult:
    """What all rays of a band have met: premultiplied colour, transmittance, depth of half transmittance.

    `error` is what colours and transmittance are estimated to be wrong by; None where nothing is estimated. Kernel evaluations a
    ray of each packet: `refined` is what marching slabs again took, `left_out` what rays that ended would have; None without.
    `cut` is how many slabs they left out, whatever those would have taken. `stop` are the depths at which rays first end at
    something opaque, infinite where they do not, and x, y and z of its normal, in view space until `adjoint.cast` turns them into
    the world; None where nothing is.
    """

    color: Float[Array, "3 packets rows columns"]
    transmittance: Float[Array, "packets rows columns"]
    depth: Float[Array, "packets rows columns"]
    left_out: Float[Array, " packets"] | None = None
    error: Float[Array, "packets rows columns"] | None = None
    refined: Float[Array, " packets"] | None = None
    cut: Float[Array, " packets"] | None = None
    stop: Float[Array, "4 packets rows columns"] | None = None


def march(
    grid: Grid,
    schedule: SlabSchedule,
    packets: RayPackets,
    medium: Medium,
    integrator: Integrator,
    plan: CastPlan,
    perspective: bool,
    min_transmittance: Float[Array, ""] | None = None,
    tolerance: Float[Array, ""] | None = None,
) -> RayResult:
    """March all packets of a band, by a schedule of bundles.

    Packets all of whose rays let less through than `min_transmittance` end between batches; for a tolerance slabs are refined.
    """
    batches = batches_of(grid, schedule, packets, plan, perspective, min_transmittance, integrator.between)
    together, ending = Together.of(batches.num_packets, plan.tuning), min_transmittance is not None
    refining, refinement = tolerance is not None, None
    if refining:
        refinement = named("jaxsph.engine.cast.refine:Refinement")(batches, medium, integrator, tolerance)
    spent = evaluations_of_slabs(batches.schedule, grid.samples, plan.slab_samples) if ending else None
    starts = batches.compacted.start

    def march_batch(nth: Array, state: Marched) -> Marched:
        rays, light, left_out, refined = state
        batch = batches.batch(nth, batches.ended(rays.transmittance))
        if spent is not None and left_out is not None:
            left_out = left_out + batches.left_out(batch, spent)

        def march_chunk(chunk: Array, light: Segment) -> Segment:
            items, begin = batches.chunk(batch, chunk)
            task = batches.task(items)
            gathered = medium.gather(task)
            found = integrator(medium, gathered, task)
            if medium.stops_rays:
                found = dataclasses.replace(found, stop=jnp.stack(medium.stops(gathered, task), 1))
            return jax.tree.map(lambda old, new: lax.dynamic_update_slice_in_dim(old, new, begin, 0), light, found)

        def borders(place: Array) -> Array:
            return batches.depths(batch.items[place], batches.half_steps)[1]

        if refinement is None:
            light = lax.fori_loop(0, batch.chunks, march_chunk, light)
        else:
            light, refined = refinement.march(batch, light, refined, rays.transmittance)
        return composite(rays, light, batch, borders, starts, together), light, left_out, refined

    dtype, nothing = grid.half_steps.dtype, jnp.zeros(batches.num_packets, jnp.float32)
    rays = fresh_rays(batches.num_packets, packets.num_rays, dtype, together, refining, medium.stops_rays)
    light = empty_segments(batches.num_slots + 1, plan.slab_samples, packets.num_rays, dtype, refining, medium.stops_rays)
    start: Marched = rays, light, jnp.stack([nothing, nothing], 1) if ending else None, nothing if refining else None
    rays, _, left_out, refined = lax.fori_loop(0, batches.number, march_batch, start)
    rank, shape = batches.compacted.bundle_rank, packets.shape
    # rays in the order of packets, as rows and columns
    rays = jax.tree.map(lambda field: field[..., rank, :].reshape(*field.shape[:-2], -1, *shape), rays)
    error = None if refinement is None else refinement.error(rays.square)
    left_out, cut = (None, None) if left_out is None else left_out.T
    return RayResult(rays.color, rays.transmittance, rays.depth, left_out, error, refined, cut, rays.stop)
